"""Accounts of the roles: each can do its work and nothing more."""

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pymysql
import pytest
import yaml

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_schemas import connection, gdi, kinetics, lab, methods, session, video, worker
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.operations import roles
from pbl_schemas.operations.declare import declare_all
from pbl_schemas.reading import frames
from pbl_workers import queue, refresh, run_job
from pbl_workers.populate import populate
from tests import Environment
from tests.command import pbl
from tests.rows import remove_all

from . import chain

Login = Callable[[str], None]

#: The accounts as the embedded server's are, also on another one.
ROLES = ("db", "roles", "--from", "127.0.0.1")
LOGIN = ("HOST", "PORT", "USER", "PASS", "PASS_FILE")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def secrets(database: Path, tmp_path: Path) -> Path:
    """The three accounts, with their password files."""
    declare_all()
    done = pbl(*ROLES, "--secrets", tmp_path / "secrets")
    assert done.code == 0, done.err
    return tmp_path / "secrets"


@pytest.fixture
def server_before(database: Path) -> dict[str, str]:
    """The login before a role is taken: nothing for the embedded server, else that of the server's administrator."""
    return {name: value for name, value in os.environ.items() if name.startswith("DJ_") and name[3:] in LOGIN}


@pytest.fixture
def login(secrets: Path, server_before: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Login]:
    """Go on as the account of a role, in this process, as a worker does that is told so by its environment."""
    port = connection.connect().conn_info["port"]
    with monkeypatch.context() as patch:

        def become(role: str) -> None:
            user = roles.default_account(role, "127.0.0.1").user if role in roles.ROLES else role
            patch.delenv("DJ_PASS", raising=False)
            for name, value in (("HOST", "127.0.0.1"), ("PORT", port), ("USER", user), ("PASS_FILE", secrets / user)):
                patch.setenv(f"DJ_{name}", str(value))
            connection.connect()

        yield become
    # What a connection knows of tables below tables may be of a schema that is gone now.
    connection.connect().dependencies.clear()
    remove_all()


def refused(sql: str) -> bool:
    """Whether the server denies the statement (and not something else about it)."""
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        try:
            cursor.execute(sql)
        except pymysql.err.Error as error:
            if error.args[0] in (1044, 1142, 1227, 1410):
                return True
            raise
    return False


def test_a_worker_fills_every_table_and_changes_none(login: Login, tmp_path: Path, stand_ins: None):
    login("worker")
    pbl_schemas.activate()
    ingest([chain.small_video(tmp_path, "walk")], VisitRecord(subject="P001"))
    run = populate()
    assert all(t.done == 1 for t in run.tables if t.table not in ON_REQUEST), run
    assert not any(t.errors for t in run.tables)
    assert refused("DROP TABLE pbl_lab.subject")
    assert refused("CREATE TABLE pbl_lab.more (i INT)")
    assert refused("ALTER TABLE pbl_lab.subject ADD COLUMN name VARCHAR(9)")
    assert refused("CREATE DATABASE pbl_more")
    assert refused("SELECT * FROM mysql.user")
    assert refused("CREATE USER 'x'@'%' IDENTIFIED BY 'long-enough-1'")
    login("analyst")
    pbl_schemas.activate(methods=False)
    assert frames.session_summary()["subject"].tolist() == ["P001"]
    assert lab.Subject.to_arrays("subject").tolist() == ["P001"]
    for sql in (
        "INSERT INTO pbl_lab.project (project) VALUES ('x')",
        "UPDATE pbl_lab.subject SET subject_height = 1",
        "DELETE FROM pbl_lab.subject",
        "DROP TABLE pbl_lab.subject",
        "CREATE TABLE pbl_lab.more (i INT)",
    ):
        assert refused(sql), sql
    assert len(lab.Subject()) == 1
    login("admin")
    assert not refused("CREATE DATABASE pbl_more")
    assert not refused("CREATE TABLE pbl_more.t (i INT)")
    assert not refused("ALTER TABLE pbl_more.t ADD COLUMN j INT")
    assert not refused("DROP DATABASE pbl_more")
    assert refused("CREATE DATABASE elsewhere")
    assert refused("CREATE USER 'x'@'%' IDENTIFIED BY 'long-enough-1'")


@pytest.mark.parametrize(
    ("command", "account"),
    [
        (("retry",), "pbl_worker"),
        (("choose", "1", "--not-usable", "other", "--note", "dark"), "pbl_worker"),
        (("reprocess", "--table", "VideoInfo", "--yes"), "pbl_worker"),
        (("populate",), "pbl_worker"),
        (("forget", "P001", "--yes"), "pbl_owner"),
        (("db", "init"), "pbl_owner"),
    ],
)
def test_without_the_right_the_account_that_has_it_is_named(
    login: Login, tmp_path: Path, environment: Environment, command: tuple[str, ...], account: str
):
    login("worker")
    pbl_schemas.activate()
    ingest([chain.small_video(tmp_path, "walk")], VisitRecord(subject="P001"))
    refresh.refresh()
    (job,) = queue.claim(video.VideoInfo, 1)
    if command[0] == "reprocess":
        assert run_job.run(job).what == run_job.DONE
    else:
        queue.fail(job, "PblError: VIDEO_MISSING: gone")
    if command[0] == "db":
        environment(PBL_DB_PREFIX="pbl_other")  # no schema of this prefix is there
        account = "pbl_other_owner"
    else:
        login("analyst")
    done = pbl(*command)
    assert (done.code, done.error_code) == (1, "DB_REFUSED"), done.err
    assert f"DJ_USER={account} " in done.err
    assert "denied" in done.err
    assert "Traceback" not in done.err


def test_an_analyst_before_there_are_methods(login: Login, monkeypatch: pytest.MonkeyPatch):
    """Tables without method rows are read as before; the first account that may insert inserts them."""
    remove_all()
    kinetics.KineticsMethod().delete_quick()
    monkeypatch.setattr(methods, "_done", set())
    login("analyst")
    pbl_schemas.activate(methods=False)
    assert len(kinetics.KineticsMethod()) == len(lab.Subject()) == 0
    login("worker")
    pbl_schemas.activate(methods=False)
    assert len(kinetics.KineticsMethod()) > 0


def test_an_analyst_cannot_hold_what_a_refresh_needs(login: Login):
    login("analyst")
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        login("worker")
        pbl_schemas.activate()
        worker.Turn.insert1({"work": "refresh", "turn_lock": "of one that was killed", "turn_connection": 1})
        for name in ("pbl_refresh", "refresh", "of one that was killed"):
            cursor.execute("SELECT GET_LOCK(%s, 0)", (name,))
            assert cursor.fetchone() == (1,)
        assert refresh.refresh() is not None
        login("analyst")
        assert refused("UPDATE pbl_worker.turn SET turn_connection = CONNECTION_ID()")


def test_the_queries_that_scale_workers_count_the_queues(login: Login):
    """What KEDA asks the database in workers/deploy/kubernetes/scale.yaml."""
    login("worker")
    objects = yaml.safe_load_all((ROOT / "workers" / "deploy" / "kubernetes" / "scale.yaml").read_text())
    queries = [d["spec"]["triggers"][0]["metadata"]["query"] for d in objects if d["kind"] == "ScaledObject"]
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        for query in queries:
            cursor.execute(query)
            assert cursor.fetchall() == ((0,),)
        jobs = "INSERT INTO pbl_video.`~~video_info` (video_id, status, priority) VALUES (%s, %s, 5)"
        cursor.executemany(jobs, [(1, "pending"), (2, "reserved"), (3, "error")])
        counted = [cursor.execute(query) and cursor.fetchall()[0][0] for query in queries]
    assert sorted(counted) == [0, 2]


def test_it_can_be_repeated_and_takes_excess_rights_back(secrets: Path, login: Login):
    analyst = roles.default_account("analyst", "127.0.0.1")
    before = {p.name: p.read_text() for p in secrets.iterdir()}
    assert set(before) == {"pbl_owner", "pbl_worker", "pbl_analyst"}
    assert {stat.S_IMODE(p.stat().st_mode) for p in secrets.iterdir()} == {0o600}
    roles._run([rf"GRANT ALL PRIVILEGES ON `pbl\_%`.* TO {analyst.name}"])
    done = pbl(*ROLES, "--secrets", secrets)
    assert done.code == 0, done.err
    assert {p.name: p.read_text() for p in secrets.iterdir()} == before
    assert not any(password in done.out + done.err for password in before.values())
    login("analyst")
    assert refused("DELETE FROM pbl_lab.subject")
    # An analyst cannot make accounts, and is told who can; the password in the statement is not repeated.
    denied = pbl(*ROLES, "--secrets", secrets)
    assert denied.error_code == "DB_REFUSED"
    assert "DJ_USER=root" in denied.err
    assert not any(password in denied.out + denied.err for password in before.values())


def test_an_analyst_has_tables_of_a_labs_own_below_ours(
    login: Login,
    secrets: Path,
    server_before: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stand_ins: None,
):
    own = (*ROLES, "--role", "analyst", "--user", "maria", "--schema", "mylab", "--secrets", secrets)
    done = pbl(*own)
    assert done.code == 0, done.err
    assert "maria from 127.0.0.1: select, show view on pbl_*, all on pbl_mylab" in done.out
    login("worker")
    pbl_schemas.activate()
    for subject in ("P001", "P002"):
        ingest([chain.small_video(tmp_path, subject)], VisitRecord(subject, "2026-03-01"))
    populate()

    login("maria")
    pbl_schemas.activate(methods=False)
    schema = dj.Schema(connection.schema_name("mylab"), context={"gdi": gdi})

    @schema
    class CycleSpread(dj.Computed):
        definition = """
        # spread of the index over the cycles of a visit
        -> gdi.SessionGdi
        ---
        spread_range=null : float64    # (-) highest minus lowest
        """

        def make(self, key):
            index = (gdi.GDI.Cycle & key).to_arrays("cycle_gdi")
            self.insert1({**key, "spread_range": float(index.max() - index.min())})

    CycleSpread.populate(reserve_jobs=True)
    assert len(CycleSpread * gdi.SessionGdi * session.Session * lab.Subject) == 2
    assert not refused("CREATE DATABASE pbl_mylab_more")
    assert not refused("DROP DATABASE pbl_mylab_more")
    assert refused("CREATE DATABASE pbl_theirs")
    assert refused("CREATE DATABASE mylab")
    assert refused("CREATE TABLE pbl_lab.more (i INT)")
    assert refused("DELETE FROM pbl_gdi.__session_gdi")

    def spreads() -> int:
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            cursor.execute("SELECT COUNT(*) FROM pbl_mylab.__cycle_spread")
            return int(cursor.fetchall()[0][0])

    # Who computes a result anew, and who forgets a person, takes the rows below with it.
    login("worker")
    assert ingest([tmp_path / "P001.mp4"], VisitRecord("P001", "2026-03-01", pace="fast"))[0].status != "failed"
    assert spreads() == 1
    login("admin")
    forgotten = pbl("forget", "P002", "--yes")
    assert forgotten.code == 0, forgotten.err
    assert spreads() == 0
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("DROP DATABASE pbl_mylab")
    with monkeypatch.context() as as_before:
        for name in LOGIN:
            as_before.delenv(f"DJ_{name}", raising=False)
        for name, value in server_before.items():
            as_before.setenv(name, value)
        roles.drop(roles.Account("analyst", "maria", "127.0.0.1"))


@pytest.mark.parametrize("name", ["gdi", "lab_more", "My", "a-b", "1a", "x" * 41])
def test_schemas_that_an_analyst_cannot_have(name: str):
    with pytest.raises(PblError, match=r"^USAGE: "):
        roles.Account("analyst", "maria", "%", (name,))


def test_another_account_of_a_role_and_its_end(secrets: Path):
    assert pbl(*ROLES, "--role", "analyst", "--user", "maria", "--secrets", secrets).code == 0
    names = "SELECT User FROM mysql.user WHERE User = 'maria'"
    with closing(roles._server_admin()) as server, server.cursor() as cursor:
        assert cursor.execute(names) == 1
    assert pbl(*ROLES, "--role", "analyst", "--user", "maria", "--drop").code == 0
    with closing(roles._server_admin()) as server, server.cursor() as cursor:
        assert cursor.execute(names) == 0


@pytest.mark.parametrize("user", ["pbl", "pbl_admin", "root", "a'b", "x" * 33])
def test_accounts_that_the_server_needs_are_left_alone(user: str):
    with pytest.raises(PblError, match=r"^USAGE: "):
        roles.Account("worker", user, "%")


def test_the_dry_run_prints_what_would_be_done_and_no_password(database: Path, tmp_path: Path):
    done = pbl(*ROLES, "--dry-run", "--require-tls", "--secrets", tmp_path / "secrets")
    assert done.code == 0
    assert not (tmp_path / "secrets").exists()
    assert done.out.count("REQUIRE SSL") == 3
    assert r"GRANT SELECT, INSERT, UPDATE, DELETE ON `pbl\_%`.* TO 'pbl_worker'@'127.0.0.1';" in done.out
