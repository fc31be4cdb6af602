"""Databases of older releases become those of this one, with every row they had.

Beside the package's own migrations the tests write some into a folder that the runner reads as well.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import datajoint
import pytest

import pbl_schemas
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_schemas import (
    connection,
    fit,
    gait,
    gdi,
    jobs,
    lab,
    methods,
    migrations,
    qc,
    session,
    stages,
    study,
    tables_version,
    validation,
    video,
    worker,
)
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.decisions import event_corrections, review_decisions
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.reading import frames
from pbl_schemas.reading.visits import load_visit
from pbl_schemas.studies import slices
from pbl_workers import heartbeat, loop
from pbl_workers.populate import populate
from tests import Limits, mysql, not_none
from tests.command import pbl
from tests.database import keep, new_home, put_back, remove_home, server
from tests.rows import everything, register

from . import chain, older_tables

pytestmark = pytest.mark.database

#: Number of the first migration that is not the package's own.
OWN = len(migrations.available()) + 1
#: A column that may not be null, for a table that has rows: added, filled with what is true of them, then closed.
SIZES = '''
"""The size of a video's file, which older versions did not record."""

from pbl_schemas import connection


def statements(conn):
    schema = connection.schema_name("video")
    column = conn.query(
        "SELECT is_nullable FROM information_schema.columns "
        "WHERE table_schema = %s AND table_name = 'video' AND column_name = 'video_size'", args=(schema,)
    ).fetchone()
    if column and column[0] == "NO":
        return []
    table = f"`{schema}`.`video`"
    added = [] if column else [f"ALTER TABLE {table} ADD COLUMN video_size BIGINT NULL AFTER video_sha256"]
    comment = ":int64:(byte) length of the file"
    return [
        *added,
        f"UPDATE {table} SET video_size = 7 WHERE video_size IS NULL",
        f"ALTER TABLE {table} MODIFY COLUMN video_size BIGINT NOT NULL COMMENT '{comment}'",
    ]
'''

#: Makes the database what a builder makes of an empty one; returns what the builder returns.
Put = Callable[[Callable[[Path], Any]], Any]


class Home:
    """A server of this module, and the databases that were built on it."""

    def __init__(self, path: Path, variables: dict[str, str]) -> None:
        self.path, self.variables = path, variables
        self.built: dict[str, Any] = {}

    def put(self, build: Callable[[Path], Any]) -> Any:
        """Make the database what `build` makes of an empty one, or of its base, which is there, given a folder for
        videos; return what it returns.

        It is built once; after that its files are put back. On MySQL it is built each time.
        """
        name = build.__name__
        if name in self.built:
            put_back(self.path, name)
            return self.built[name]
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            cursor.execute("SET foreign_key_checks = 0")
            cursor.execute("SELECT schema_name FROM information_schema.schemata WHERE schema_name LIKE 'pbl\\_%'")
            for (schema,) in cursor.fetchall() if build not in BASES else ():
                cursor.execute(f"DROP DATABASE {schema}")
        result = build(self.path)
        if not mysql.chosen():
            self.built[name] = result
            keep(self.path, name)
        return result


@pytest.fixture(scope="module")
def home() -> Iterator[Home]:
    """The server, in use only where a test asks for `put`."""
    path = new_home()
    with server(path) as variables:
        yield Home(path, variables)
    remove_home(path)


@pytest.fixture
def forget(home: Home, monkeypatch: pytest.MonkeyPatch, stand_ins: None) -> Iterator[Callable[[], None]]:
    """The server of this module, in use. Calling it makes the classes forget the server, as in a new process."""
    with monkeypatch.context() as patch:
        for name, value in home.variables.items():
            patch.setenv(name, value)

        def forgotten() -> None:
            patch.setattr(connection, "_current", None)
            patch.setattr(datajoint.instance, "_singleton_connection", None)
            _unbind(patch)

        yield forgotten


@pytest.fixture
def put(home: Home, forget: Callable[[], None]) -> Put:
    """`Home.put`, in a process that knows nothing of the database before and after."""

    def done(build: Callable[[Path], Any]) -> Any:
        if build in BASES and build.__name__ not in home.built:
            done(BASES[build])
        forget()
        result = home.put(build)
        forget()
        return result

    return done


def no_table(folder: Path) -> None:
    """Leave the database empty."""


def new(folder: Path) -> None:
    """Declare the tables."""
    pbl_schemas.activate()


def one_visit(folder: Path, day: str = "2026-03-01") -> dict[str, list[tuple]]:
    """Compute a visit."""
    pbl_schemas.activate()
    register(chain.small_video(folder, day), session_label=day)
    _compute()
    return everything()


def two_visits(folder: Path) -> None:
    """Compute another one."""
    one_visit(folder, "2026-06-01")


def without_sizes(folder: Path) -> None:
    """A visit in tables from before videos had a size and before there was a schema for validation."""

    def undo_sizes(cursor: Any) -> None:
        cursor.execute("ALTER TABLE pbl_video.video DROP COLUMN video_size")
        cursor.execute("DROP DATABASE pbl_validation")

    _undo(undo_sizes, older_tables.undo_0013, older_tables.undo_0003, older_tables.undo_0002)


def without_session(folder: Path) -> dict[str, list[tuple]]:
    """Take migration 0001 back; return the rows of before that, as all builders below."""
    rows = everything()
    _undo(older_tables.undo_0001)
    return rows


def without_instruments(folder: Path) -> dict[str, list[tuple]]:
    """Take the migrations from 0006 back."""
    rows = everything()
    _undo(*(getattr(older_tables, f"undo_{n:04}") for n in (17, 16, 15, 14, 13, 12, 10, 9, 8, 7, 6)))
    return rows


def corrected_by_a_method(folder: Path) -> dict[str, list[tuple]]:
    """Correct the events of the visit, and take migration 0004 back."""
    pbl_schemas.activate()
    found = not_none(event_corrections.shown_events(1))
    (time, side, kind, _), *others = found.events
    event_corrections.save(1, [(time + 0.02, side, kind), *(e[:3] for e in others)], "A. First", found.state)
    _compute()
    study.Visit.insert1({"session_id": 1, "visit_role": "pre"})
    slices.freeze("of detected events")
    slices.freeze("of corrected events")
    of_slice = {"study_slice": "of detected events", "session_id": 1}
    study.StudySliceVisit.update1({**of_slice, "slice_visit_hash": "0" * 16})  # of other numbers than after the upgrade
    key = gdi.SessionGdi.fetch1("KEY")
    check = dict((qc.SessionQc.Check & key).to_dicts()[0])
    qc.SessionQc.Check.update1({**{k: check[k] for k in qc.SessionQc.Check.primary_key}, "qc_check_outcome": "WARN"})
    computed = str((qc.SessionQc & key).fetch1("qc_computed"))
    about = {**key, "check": check["qc_check"], "qc_no": int(check["qc_no"])}
    for then, by in (("2020-01-01 00:00:00", "B. Second"), (computed, "C. Third")):
        review_decisions.record("check", by, {**about, "computed": then}, {}, {}, session_id=1)
    rows = everything()

    def by_hand(cursor: Any) -> None:
        slice_ = "WHERE study_slice = 'of corrected events'"
        cursor.execute(f"UPDATE pbl_study.study_slice SET gait_method = 'by-hand-v1' {slice_}")
        cursor.execute(
            "UPDATE pbl_review.decision SET decision_about = JSON_SET(decision_about, '$.gait_method', 'by-hand-v1')"
            " WHERE decision_by = 'C. Third'"
        )

    _undo(older_tables.undo_0004, by_hand)
    return rows


def tracked_without_video_info(folder: Path) -> dict[str, list[tuple]]:
    """Take migration 0005 back, for the first visit."""
    rows = everything()
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        older_tables.undo_0005(cursor, 1)
        cursor.execute("DELETE FROM pbl_lab.`~migrations` WHERE number = 5")
    return rows


def stated_in_words(folder: Path) -> dict[str, list[tuple]]:
    """Freeze three visits, about two of which something was stated in words, and take migration 0011 back."""
    rows = one_visit(folder, "2026-09-01")
    for number, aid in enumerate(("Keine", "Gehstock", "my own"), 1):
        study.Visit.insert1({"session_id": number, "visit_role": "pre", "assistive_device": aid})
    slices.freeze("of words")
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("DELETE FROM pbl_lab.`~migrations` WHERE number = 11")
    return rows


#: The older database on which each of these is built; the others begin with an empty one.
BASES: dict[Callable[[Path], Any], Callable[[Path], Any]] = {without_instruments: new, one_visit: new}
BASES |= dict.fromkeys((two_visits, without_sizes, corrected_by_a_method), one_visit)
BASES |= dict.fromkeys((without_session, tracked_without_video_info, stated_in_words), two_visits)


def _compute() -> None:
    assert not {t.table: t.errors for t in populate(_chain()).tables if t.errors}


def _undo(*migrations: Callable[[Any], None]) -> None:
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        for undo in migrations:
            undo(cursor)
        cursor.execute(older_tables.NOT_RECORDED)


@pytest.fixture
def older(put: Put, add: Callable[[str, str], None]) -> None:
    """A database of an older release (`without_sizes`), and its migration."""
    put(without_sizes)
    add(f"{OWN:04}_sizes", SIZES)


@pytest.fixture
def add(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str, str], None]]:
    """A call that writes a migration where the runner finds it."""
    folder = tmp_path_factory.mktemp("migrations")
    monkeypatch.setattr(migrations, "__path__", [*migrations.__path__, str(folder)])
    monkeypatch.setattr(tables_version, "FOLDERS", [*tables_version.FOLDERS, str(folder)])
    names = []

    def write(name: str, text: str) -> None:
        (folder / f"{name}.py").write_text(text)
        names.append(f"{migrations.__name__}.{name}")

    yield write
    for name in names:
        sys.modules.pop(name, None)


def _unbind(patch: pytest.MonkeyPatch) -> None:
    """The classes as a new process has them: what they know of another server's tables must not count here."""
    from pbl_schemas.chain import tables

    patch.setattr(jobs.jobs_of, "made", {})
    patch.setattr(methods, "_done", set())
    for module in stages.modules():
        patch.setattr(module.schema, "database", None)
        patch.setattr(module.schema, "connection", None)
    for cls in tables().values():
        for name in ("database", "_connection", "_heading", "_support", "_jobs"):
            patch.setattr(cls, name, None, raising=False)


class Killed(BaseException):
    """The end of a migration in the middle."""


def migrate_until(line: int | str | None) -> list[str]:
    """Migrate, killed at that line of what it says, by its number or text (None: to the end); return what it said."""
    done: list[str] = []

    def say(text: str) -> None:
        done.append(text)
        if line in (len(done), text.strip()):
            raise Killed

    with contextlib.suppress(Killed):
        migrations.migrate(say=say)
    return done


def _chain() -> list[str]:
    return [t.__name__ for t in pbl_schemas.computed_tables() if t.__name__ not in ON_REQUEST]


def test_an_older_database_keeps_its_rows_and_works(older: None, tmp_path: Path):
    before = everything()
    dry = pbl("db", "migrate", "--dry-run")
    assert dry.code == 0, dry.out + dry.err
    assert "ADD COLUMN video_size" in dry.out
    assert "pbl_validation: the schema is created" in dry.out
    assert everything() == before
    assert migrations.applied() == []
    done = pbl("db", "migrate")
    assert done.code == 0, done.err
    after = everything()
    with_size = "pbl_video.video"
    assert len(after[with_size]) == len(before[with_size]) == 1
    assert "7" in after[with_size][0]
    assert migrations.migrate(dry_run=True).open == []
    # The schemas' own bookkeeping (~lineage, ~log) may grow.
    with_height = "pbl_fit.__session_fit"
    assert len(after[with_height]) == len(before[with_height]) == 1
    kept = [t for t in before if t not in (with_size, with_height) and not t.split(".")[1].startswith("~")]
    assert "pbl_fit.__session_fit__trial" in kept
    assert {t: after[t] for t in kept} == {t: before[t] for t in kept}
    assert [a.name for a in migrations.applied()] == [*(m.name for m in migrations.available()[: OWN - 1]), "sizes"]
    # Again there is nothing to do.
    assert migrations.migrate().steps == []
    assert len(migrations.applied()) == OWN
    # A new visit goes through the whole chain beside it.
    assert frames.session_summary()["subject"].tolist() == ["P001"]
    ingest([chain.small_video(tmp_path, "new")], VisitRecord(subject="P002"))
    _compute()
    assert set(frames.session_summary()["subject"]) == {"P001", "P002"}
    assert set(video.Video.to_arrays("video_size")) > {7}
    # Why a solver ended is not known of earlier fits.
    assert fit.SessionFit.to_arrays("fit_result", order_by="session_id").tolist() == [None, "small_step"]
    solutions = [load_visit({"subject": subject}, measures=False).solution for subject in ("P001", "P002")]
    assert [(s.result, s.converged) for s in map(not_none, solutions)] == [(None, True), ("small_step", True)]


def test_results_from_before_they_had_their_session_get_it(put: Put):
    rows = put(without_session)
    dry = migrations.migrate(dry_run=True)
    assert (len(dict(dry.steps)["0001 session_of_results"]), dry.open) == (4 * len(older_tables.WITHOUT_SESSION), [])
    migrations.migrate()
    after = everything()
    assert {t for t in rows if after[t] != rows[t] and not t.split(".")[1].startswith("~")} == set()
    assert len(gdi.SessionGdi * session.Session) == len(session.Session()) == 2
    assert len(gait.Spatiotemporal * session.Session * video.Video) == 2
    assert migrations.migrate().steps == []


def test_instruments_and_errors_of_before_get_their_columns(put: Put):
    rows = put(without_instruments)["pbl_study.#clinical_instrument"]
    killed = [migrate_until(line) for line in (1, 2, 2)]  # before each of the first three statements
    assert killed[0] == killed[1][:1]
    assert killed[1][1:] == killed[2][:1]
    migrations.migrate()
    assert everything()["pbl_study.#clinical_instrument"] == rows
    assert "joint_normal_p" in validation.KinematicError.Joint.heading.names
    assert gdi.SessionGdi.Measure.heading.names[-2:] == ["session_measure_error", "session_measure_minimal_change"]
    assert {"gdi_unshrunk", "gdi_unshrunk_sd"} < set(gdi.GDI.heading.names)
    assert {"session_gdi_unshrunk", "session_gdi_unshrunk_sd"} < set(gdi.SessionGdi.heading.names)
    assert "cycle_length_unproven" in gait.GaitCycle.Cycle.heading.names
    assert {"imu_segments", "imu_rate", "imu_mounts"} < set(video.WearableImu.heading.names)
    assert {"depth_read", "depth_scale"} < set(video.DepthVideo.heading.names)
    assert "worker_gpus" in worker.Worker.heading.names
    assert "varchar(1000)" in gait.Spatiotemporal.Measure.heading["measure_missing"].original_type
    assert migrations.migrate().steps == []


def test_a_running_worker_of_another_version_is_named_and_refused(put: Put):
    put(without_instruments)
    add = "INSERT INTO pbl_worker.worker (worker, worker_host, worker_pid, worker_resource, worker_version,"
    add += " worker_started, worker_seen, worker_stopped, worker_doing) VALUES (%s, %s, 7, 'any', %s, NOW(3),"
    add += " NOW(3) - INTERVAL %s SECOND, NULL, '')"
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        for name, version, ago in (("a", "0.1.0", 5), ("b", code_version()[:64], 5), ("c", "0.1.0", 500)):
            cursor.execute(add, (name * 16, f"host-{name}", version, ago))
    dry = pbl("db", "migrate", "--dry-run")
    assert [line for line in dry.out.splitlines() if "running" in line] == [
        "  still running: process 7 on host-a, pbl-pipeline 0.1.0"
    ]
    refused = pbl("db", "migrate")
    assert (refused.error_code, "host-a" in refused.err, "--force" in refused.err) == ("DB_MIGRATION", True, True)
    assert "joint_normal_p" not in columns_of("pbl_validation", "__kinematic_error__joint")
    assert pbl("db", "migrate", "--force").code == 0
    assert "joint_normal_p" in columns_of("pbl_validation", "__kinematic_error__joint")
    assert pbl("db", "migrate").code == 0  # nothing is left to do


def columns_of(schema: str, table: str) -> set[str]:
    """Columns of a table on the server."""
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        asked = "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s"
        cursor.execute(asked, (schema, table))
        return {str(row[0]) for row in cursor.fetchall()}


def test_corrections_by_a_method_become_rows(put: Put):
    rows = put(corrected_by_a_method)
    assert len(everything()["pbl_gdi.__session_gdi"]) == 2
    refused = pbl("populate")
    assert (refused.code, "__session_gdi.session_corrected" in refused.err) == (1, True)
    dry = migrations.migrate(dry_run=True)
    assert (len(dict(dry.steps)["0004 corrections_as_rows"]) > 60, dry.open) == (True, [])
    # Results that will have other numbers are named before anything is done.
    visit = "visit 2026-03-01 of P001"
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute(
            "SELECT JSON_VALUE(decision_about, '$.check'), JSON_VALUE(decision_about, '$.gait_method')"
            " FROM pbl_review.decision WHERE decision_by = 'B. Second'"
        )
        ((check, method),) = cursor.fetchall()
    touched = [
        f"changes: the results of {visit} by {method}",
        f"changes: the check {check} of {visit}, which B. Second accepted, is to be accepted again",
        "changes: 1 visits of the slice of detected events; a backup of before has its numbers",
    ]
    assert dry.touched == touched
    said = pbl("db", "migrate", "--dry-run").out.splitlines()
    assert [line.strip() for line in said if "changes:" in line] == touched
    for killed_before in (4, 57, "DROP TABLE `pbl_gait`.`hand_events`"):  # each goes on where the last was killed
        assert killed_before in (len(said := migrate_until(killed_before)), said[-1].strip())
        assert migrations.applied()[-1].number < OWN - 1
    migrations.migrate()
    assert migrations.applied()[-1].number == OWN - 1
    after = everything()
    assert {t for t in rows if after[t] != rows[t] and not t.split(".")[1].startswith("~")} == set()
    assert not [t for t in after if "hand_events" in t]
    assert migrations.migrate().steps == []
    # The slice of corrected events has its numbers, and what was accepted of them stays accepted.
    assert slices.changes("of corrected events") == []
    assert slices.changes("of detected events") == [f"{visit} has other rows"]
    kept = review_decisions.accepted(gdi.SessionGdi.fetch1("KEY"))
    assert [d.by for d in kept.values()] == ["C. Third"]
    # Nothing is pending; going back to the detected events computes theirs again.
    assert not populate(_chain()).did_something
    event_corrections.take_back(1, "B. Second", not_none(event_corrections.shown_events(1)).state)
    assert {t.table: t.done for t in populate(_chain()).tables if t.done}["SessionGdi"] == 1


def test_slices_of_visits_whose_words_become_codes_are_named(put: Put):
    put(stated_in_words)
    said = "changes: 2 visits of the slice of words; a backup of before has its numbers"
    assert migrations.migrate(dry_run=True).touched == [said]
    migrations.migrate()
    assert study.Visit.to_arrays("assistive_device", order_by="session_id").tolist() == ["none", "cane", "my own"]
    assert slices.changes("of words") == [f"visit 2026-0{n}-01 of P001 has other rows" for n in (3, 6)]


def test_tracking_without_the_video_info_that_it_read_goes(put: Put):
    rows = put(tracked_without_video_info)
    dry = migrations.migrate(dry_run=True)
    statements = dict(dry.steps)["0005 tracking_of_videos_that_were_read"]
    assert (statements[0], len(statements) > 20, dry.open) == ("START TRANSACTION", True, [])
    assert len(migrate_until(5)) == 5
    assert dry.touched == ["changes: the results of visit 2026-03-01 of P001"]
    assert len(migrate_until(None)) == 1 + len(statements)  # all over again: it was one transaction
    after = everything()
    left = {t: len(found) for t, found in after.items() if t.split(".")[1].startswith("__") or "fit_set" in t}
    assert left == {t: len(rows[t]) // 2 for t in left}
    assert set(map(str, video.VideoInfo.to_arrays("video_id"))) == {"2"}
    assert migrations.migrate().steps == []
    # What was asked for is computed again.
    _compute()
    after = everything()
    assert {t: len(after[t]) for t in left} == {t: len(rows[t]) for t in left}


def test_commands_over_tables_of_an_older_version_name_the_migration(older: None, forget: Callable[[], None]):
    before = everything()
    commands = (("populate",), ("list", "videos"), ("worker", "--once"), ("db", "init"), ("web", "--port", "0"))
    for command in commands:
        refused = pbl(*command)
        assert (refused.code, refused.err.split(":")[0]) == (1, "DB_MIGRATION"), command
        assert "http" not in refused.out  # no address of a page that does not come
        for part in ("0003 height_of_fits", "video.video_size", "pbl db migrate --dry-run"):
            assert part in refused.err, refused.err
        assert everything() == before
        forget()
    migrations.migrate()
    assert pbl("list", "videos").code == 0


def test_what_no_migration_removes_is_named(put: Put, add: Callable[[str, str], None]):
    put(new)
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("ALTER TABLE pbl_video.video DROP COLUMN video_size")
        cursor.execute(
            "ALTER TABLE pbl_lab.subject MODIFY COLUMN subject_height VARCHAR(9) NULL COMMENT ':varchar(9):x'"
        )
        cursor.execute("ALTER TABLE pbl_lab.project MODIFY COLUMN project_title VARCHAR(20) NOT NULL DEFAULT ''")
        cursor.execute("ALTER TABLE pbl_session.session ADD COLUMN forgotten INT NOT NULL")
        cursor.execute("ALTER TABLE pbl_keypoints.__keypoints DROP INDEX camera_kind")
    named = _named()
    altered = ("video`.`video", "lab`.`subject", "lab`.`project", "session`.`session", "keypoints`.`__keypoints")
    assert {n.split(":")[0] for n in named} == {f"`pbl_{t}`" for t in altered}
    for part in ("ADD `video_size` bigint", "MODIFY `subject_height` double", "varchar(200)", "`forgotten`", "indexes"):
        assert any(part in n for n in named), part
    # Refused before the first statement, also of a migration that could be applied; one difference a line.
    add(f"{OWN:04}_wanted", 'def statements(conn):\n    return ["CREATE TABLE pbl_lab.wanted (a INT PRIMARY KEY)"]\n')
    refused = pbl("db", "migrate")
    assert (refused.code, refused.error_code) == (1, "DB_MIGRATION")
    assert [line[4:] for line in refused.err.splitlines() if line.startswith("    ")] == named
    assert "pbl_lab.wanted" not in everything()
    assert [a.number for a in migrations.applied()] == [*range(1, OWN)]
    # Nothing was altered by itself.
    assert _named() == named


def _named() -> list[str]:
    """What a dry run finds that no migration removes."""
    dry = pbl("db", "migrate", "--dry-run")
    assert dry.code == 1
    start = "  needs its own migration: "
    return [line.removeprefix(start) for line in dry.out.splitlines() if line.startswith(start)]


def test_a_migration_that_was_broken_off_goes_on(older: None):
    statements = dict(migrations.migrate(dry_run=True).steps)[f"{OWN:04} sizes"]
    assert len(statements) == 3
    assert migrate_until(statements[2])[-1].strip() == statements[2]
    assert [a.number for a in migrations.applied()] == [*range(1, OWN)]
    assert [line.strip() for line in migrate_until(None)] == statements[1:]  # the column is there already
    assert [a.number for a in migrations.applied()] == [*range(1, OWN + 1)]
    assert video.Video.fetch1("video_size") == 7


def test_a_statement_that_the_server_refuses_is_named_and_not_recorded(older: None, add: Callable[[str, str], None]):
    add(f"{OWN + 1:04}_wrong", 'def statements(conn):\n    return ["ALTER TABLE pbl_video.nothing DROP COLUMN x"]\n')
    with pytest.raises(PblError, match=f"{OWN + 1:04} wrong") as error:
        migrations.migrate()
    assert error.value.code == "DB_REFUSED"
    assert [a.number for a in migrations.applied()] == [*range(1, OWN + 1)]


def test_migrations_without_a_gap(add: Callable[[str, str], None]):
    nothing = "def statements(conn):\n    return []\n"
    add(f"{OWN:04}_next", nothing)
    add(f"{OWN + 2:04}_after_a_gap", nothing)
    with pytest.raises(ValueError, match=f"{OWN}, {OWN + 2}]"):
        migrations.available()


STARTS = (
    ("status",), ("populate",), ("worker", "--once"), ("web", "--port", "0"), ("db", "config"), ("db", "init"),
    ("db", "migrate"), ("db", "migrate", "--dry-run"), ("list", "videos"), ("cron", "refresh"),
)  # fmt: skip


@pytest.mark.parametrize(("number", "name"), [(999, "x"), (1, "another_of_this_number")])
def test_a_database_of_a_newer_version_is_left_alone(
    put: Put, forget: Callable[[], None], in_empty_folder: Path, number: int, name: str
):
    put(new)
    assert [(a.number, a.name) for a in migrations.applied()] == [(m.number, m.name) for m in migrations.available()]
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        insert = "INSERT INTO pbl_lab.`~migrations` (number, name, code_version, applied) VALUES (%s, %s, %s, NOW())"
        cursor.execute(insert, (number, name, "9.9+gabc"))
    before = everything()
    for command in STARTS:
        forget()
        refused = pbl(*command)
        assert (refused.code, refused.error_code) == (1, "DB_MIGRATION"), command
        for part in (f"{number:04} {name}", "9.9+gabc", code_version()):
            assert part in refused.err, command
    assert everything() == before
    assert not list(in_empty_folder.iterdir())
    # Also a worker that runs while the tables are migrated stops at its next look.
    forget()
    pbl_schemas.stages.modules()
    with pytest.raises(PblError, match=r"9\.9") as error:
        loop.Worker((), heartbeat.Silent()).run(once=True)
    assert error.value.code == "DB_MIGRATION"


def test_a_database_that_lacks_a_migration_is_refused_although_no_column_is_missing(
    put: Put, forget: Callable[[], None]
):
    put(new)
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("DELETE FROM pbl_lab.`~migrations` WHERE number = %s", (OWN - 1,))
    last = migrations.available()[-1]
    for command in STARTS:
        if command[:2] != ("db", "migrate"):
            forget()
            refused = pbl(*command)
            assert (refused.code, refused.error_code) == (1, "DB_MIGRATION"), command
            assert f"without migration {last.title}" in refused.err
    assert migrations.migrate().steps == [(last.title, [])]
    assert pbl("status").code == 0


def test_one_process_migrates_at_a_time(database: Path, limits: Limits):
    limits("pbl_schemas.migrations._run", LOCK_S=1)
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SELECT GET_LOCK(%s, 0)", (f"{connection.prefix()}_migrate",))
        assert cursor.fetchone() == (1,)
        with pytest.raises(PblError, match="another process is migrating") as error:
            migrations.migrate()
        assert error.value.code == "DB_MIGRATION"


def test_an_empty_server_gets_the_tables_as_they_are_defined(put: Put, add: Callable[[str, str], None]):
    put(no_table)
    add(f"{OWN:04}_sizes", SIZES)
    planned = migrations.migrate(dry_run=True)
    assert "pbl_lab: the schema is created" in planned.created
    assert planned.open == []
    assert everything() == {}
    outcome = migrations.migrate()
    assert "`pbl_lab`.`subject`: the table is created" in outcome.created
    assert [a.number for a in migrations.applied()] == [*range(1, OWN + 1)]  # with nothing to do
    assert len(lab.Subject()) == len(video.Video()) == 0
    assert migrations.migrate() == migrations.Migrated([], [], [])


def test_a_new_database_needs_nothing(database: Path):
    pbl_schemas.activate()
    outcome = migrations.migrate()
    assert [s for _, statements in outcome.steps for s in statements] == []
