"""Databases of older versions become those of this one, with every row they had."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import schemas
from pbl_pipeline.errors import PblError
from schemas import _base, _differences, _dump, connection, embedded, fit, lab, migrations, video, views
from schemas._base import resolve_method
from schemas.ingest import Visit, ingest
from schemas.migrations import _run
from schemas.migrations._fill import fill
from tests.command import pbl
from tests.database import new_home, remove_home
from workers.populate import populate

from . import chain

OLD = Path(__file__).parent / "data" / "old_database.sql.gz"


@pytest.fixture(scope="module")
def home() -> Iterator[Path]:
    """A server of its own, in use only where `old` says so."""
    path = new_home()
    embedded.start(folder=embedded.Folder(path / "db"))
    yield path
    remove_home(path)


@pytest.fixture
def old(home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The server of its own with nothing but a database that commit 28e5ab3 made (see data/old_rows.py)."""
    with monkeypatch.context() as patch:
        patch.setenv("PBL_HOME", str(home))
        patch.setattr(connection.dj_instance, "_singleton_connection", None)
        _unbind(patch)
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            cursor.execute("SET foreign_key_checks = 0")
            for schema in _dump.schemas_of(server, "pbl"):
                cursor.execute(f"DROP DATABASE {_dump.quote(schema)}")
            for statement in _dump.read_lines(OLD):
                cursor.execute(statement)
        yield


def _unbind(patch: pytest.MonkeyPatch) -> None:
    """The classes as a new process has them: what they know of another server's tables must not count here."""
    from schemas.table_map import tables

    patch.setattr(_base, "_jobs", {})
    patch.setattr(schemas._activate, "_methods_done", set())
    for module in schemas._activate.modules():
        patch.setattr(module.schema, "database", None)
        patch.setattr(module.schema, "connection", None)
    for cls in tables().values():
        for name in ("database", "_connection", "_heading", "_support", "_jobs"):
            patch.setattr(cls, name, None, raising=False)


def rows() -> dict[str, list[str]]:
    """Key columns of every row of the old tables that the present ones have as well."""
    with closing(connection.plain_connection(conv={})) as server:
        return {
            f"{schema}.{table}": sorted(r[0] for r in _dump.rows_of(server, schema, table, columns[:1]))
            for schema, table in _dump.tables_of(server, "pbl")
            if not table.startswith("~") and (columns := _dump.columns_of(server, schema, table))
        }


def test_an_old_database_keeps_its_rows_and_works(old: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    before = rows()
    assert len(before["pbl_fit.__session_fit__trial"]) == 2
    dry = pbl("db", "migrate", "--dry-run")
    assert dry.code == 0, dry.out + dry.err
    assert "ADD COLUMN `fit_converged`" in dry.out
    assert "pbl_validation: the schema is created" in dry.out
    assert rows() == before
    assert migrations.applied() == []
    done = pbl("db", "migrate")
    assert done.code == 0, done.err
    after = rows()
    lookups = {t for t in before if ".#" in t}
    assert {t: after[t] for t in before if t not in lookups} == {t: before[t] for t in before if t not in lookups}
    assert {t: sorted(set(before[t]) - set(after[t])) for t in lookups} == {t: [] for t in lookups}
    # A method that had changed under its name is put aside; its name means the present one.
    aside = [m for m in after["pbl_fit.#fit_method"] if m.startswith("paper-2025-v1-")]
    assert len(aside) == 1
    assert resolve_method(fit.FitMethod, "fit", "paper-2025") == "paper-2025-v1"
    assert not _differences.differences()
    assert [a.name for a in migrations.applied()][:1] == ["what_is_declared"]
    # Again there is nothing to do.
    assert not any(s for _, s in migrations.migrate().steps)
    assert len(migrations.applied()) == len(migrations.available())
    # What was unknown then is null, and the old visit is in the views.
    assert fit.SessionFit.fetch1("fit_iterations", "fit_converged") == (None, None)
    visit = views.session_summary().to_dict("records")[0]
    assert (visit["subject"], visit["session_label"], visit["fit_set_n"]) == ("P001", "2026-03-01", 2)
    # A new visit goes through the whole chain beside it.
    chain.install(monkeypatch)
    ingest([chain.small_video(tmp_path, "new")], Visit(subject="P002"))
    run = populate([t.__name__ for t in schemas.computed_tables() if t.__name__ != "KinematicError"])
    assert not {t.table: t.errors for t in run.tables if t.errors}
    assert set(views.session_summary()["subject"]) == {"P001", "P002"}


def test_what_a_migration_cannot_do_safely_it_names(old: None):
    pbl("db", "migrate")
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("ALTER TABLE pbl_video.video DROP COLUMN video_size")  # had no default, and there are rows
        cursor.execute("ALTER TABLE pbl_lab.subject MODIFY COLUMN subject_height VARCHAR(9) NULL COMMENT ':float32:x'")
        cursor.execute("ALTER TABLE pbl_lab.project MODIFY COLUMN project_title VARCHAR(20) NOT NULL DEFAULT ''")
        cursor.execute(
            "ALTER TABLE pbl_video.video ADD COLUMN forgotten INT NOT NULL, MODIFY COLUMN forgotten INT NOT NULL"
        )
    said = {(d.table, d.column): d.statement for d in _differences.differences()}
    assert said[("`pbl_video`.`video`", "video_size")] is None
    assert said[("`pbl_lab`.`subject`", "subject_height")] is None
    assert "varchar(200)" in (said[("`pbl_lab`.`project`", "project_title")] or "")
    assert (said[("`pbl_video`.`video`", "forgotten")] or "").endswith("`forgotten` int(11) NULL")
    dry = pbl("db", "migrate", "--dry-run")
    assert dry.code == 1
    assert "video_size: the column is new, without a default, and there are rows" in dry.out
    with pytest.raises(PblError) as error:
        migrations.migrate()
    assert error.value.code == "DB_MIGRATION"
    # What could be done is done all the same.
    assert {d.column for d in _differences.differences()} == {"video_size", "subject_height"}
    # A migration of its own knows what is true of the rows that are there; broken off, it goes on.
    conn = connection.connect()
    steps = fill(conn, video.Video(), "video_size", "7")
    assert len(steps) == 3
    conn.query(steps[0])
    assert fill(conn, video.Video(), "video_size", "7") == steps[1:]
    for step in steps[1:]:
        conn.query(step)
    assert fill(conn, video.Video(), "video_size", "7") == []
    assert {d.column for d in _differences.differences()} == {"subject_height"}
    assert conn.query("SELECT DISTINCT video_size FROM pbl_video.video").fetchall() == ((7,),)


def test_a_migration_that_was_broken_off_goes_on(old: None, monkeypatch: pytest.MonkeyPatch):
    statements = _run.available()[0].statements(_bound())
    assert len(statements) > 2

    class Killed(BaseException):
        pass

    def say(line: str) -> None:
        if line.strip() == statements[2]:
            raise Killed

    with pytest.raises(Killed):
        migrations.migrate(say=say)
    left = _run.available()[0].statements(connection.connect())
    assert left == statements[2:]
    assert migrations.applied() == []
    migrations.migrate()
    assert not _differences.differences()


def _bound() -> Any:
    _differences.bind_all(create=False)
    return connection.connect()


def test_a_database_of_a_newer_version_is_left_alone(old: None):
    migrations.migrate()
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute(
            "INSERT INTO pbl_lab.`~migrations` (number, name, code_version, applied) VALUES (999, 'x', '9.9', NOW())"
        )
    with pytest.raises(PblError, match=r"pbl-pipeline 9\.9") as error:
        migrations.migrate(dry_run=True)
    assert error.value.code == "DB_MIGRATION"


def test_one_process_migrates_at_a_time(database: Path):
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SELECT GET_LOCK(%s, 0)", (f"{connection.prefix()}_migrate",))
        assert cursor.fetchone() == (1,)
        with pytest.raises(PblError, match="another process is migrating") as error:
            migrations.migrate()
        assert error.value.code == "DB_MIGRATION"


def test_a_new_database_needs_nothing(database: Path):
    schemas.activate()
    outcome = migrations.migrate()
    assert [s for _, statements in outcome.steps for s in statements] == []
    assert len(lab.Subject()) == len(video.Video()) == 0


@pytest.mark.parametrize(
    ("sql", "type_", "nullable", "default", "comment"),
    [
        ('`fps` float DEFAULT NULL COMMENT ":float32:(1/s) rate"', "float", True, None, ":float32:(1/s) rate"),
        ("`e` enum('a', 'it''s (b)') NOT NULL COMMENT \":x:\"", "enum('a', 'it''s (b)')", False, None, ":x:"),
        ("`v` varchar(64) NOT NULL DEFAULT '' COMMENT \":varchar(64):\"", "varchar(64)", False, "''", ":varchar(64):"),
        ("`session_id` int NOT NULL", "int", False, None, ""),
        ("`camera_id` int", "int", True, None, ""),
    ],
)
def test_columns_are_read_as_they_are_declared(sql: str, type_: str, nullable: bool, default: str | None, comment: str):
    assert _differences.parse(sql) == _differences._Column(type_, nullable, default, comment)


@pytest.mark.parametrize(
    ("have", "wanted", "is_wider"),
    [
        ("int(11)", "bigint", True),
        ("bigint(20)", "int", False),
        ("smallint(6)", "tinyint", False),
        ("varchar(32)", "varchar(64)", True),
        ("varchar(64)", "varchar(32)", False),
        ("float", "double", True),
        ("double", "float", False),
        ("enum('a','b')", "enum('b', 'a', 'c')", True),
        ("enum('a','b')", "enum('a', 'c')", False),
        ("varchar(9)", "float", False),
        ("datetime(3)", "datetime", False),
    ],
)
def test_wider_types(have: str, wanted: str, is_wider: bool):
    assert _differences.wider(have, wanted) is is_wider
    assert _differences.plain_type(have) != _differences.plain_type(wanted)


def test_spellings_of_one_type():
    for one, other in (
        ("int(11)", "int"),
        ("json", "longtext"),
        ("enum('a', 'b')", "enum('a','b')"),
        ("TINYINT(4)", "tinyint"),
    ):
        assert _differences.plain_type(one) == _differences.plain_type(other)
    assert _differences.plain_type("enum('A')") != _differences.plain_type("enum('a')")
