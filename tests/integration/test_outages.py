"""A full database, a full store, a clock that goes back, workers that die: nothing is lost, nothing is left behind."""

import contextlib
import errno
import os
import shutil
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pymysql
import pytest

import pbl_pipeline.video
from pbl_pipeline.errors import causes
from pbl_schemas import connection, fit, lab, review, session, tracking, video, worker
from pbl_schemas.connection import LostConnectionError
from pbl_schemas.decisions import review_decisions
from pbl_schemas.job_errors import error_code, of_server, store_full
from pbl_schemas.jobs import jobs_of
from pbl_schemas.operations import catalog
from pbl_schemas.operations.orphans import orphans
from pbl_schemas.reading.status import pipeline_status
from pbl_schemas.store import store_error
from pbl_schemas.stored_files import remove_left_over
from pbl_workers import heartbeat, queue, recover, refresh, run_job
from tests import Faults, Limits
from tests.command import pbl
from tests.rows import register

from . import chain
from .jobs import at_once, first_job, jobs_left, queued, work

FULL = pymysql.err.OperationalError(1114, "The table '__video_info' is full")


@pytest.fixture(autouse=True)
def quick(tables: None, limits: Limits) -> None:
    """Short pauses, and a store that is as empty as the tables."""
    limits(run_job, DATABASE_PAUSE_S=0.01)
    shutil.rmtree(Path(connection.store_backend().spec["location"]) / connection.store_root(), ignore_errors=True)


# ------------------------------------------------------------------------------------------------------------- database
def test_a_result_is_kept_while_the_disk_of_the_database_is_full(tmp_path: Path, faults):
    job = first_job(tmp_path)
    probed = faults(pbl_pipeline.video, "probe")
    inserted = faults(video.VideoInfo, "make_insert", FULL, FULL, FULL)
    announced: list[int] = []
    assert run_job.run(job, waiting=lambda: announced.append(1)).what == run_job.DONE
    assert (len(probed), len(inserted), len(announced)) == (1, 4, 3)
    assert (len(video.VideoInfo()), len(jobs_of(video.VideoInfo))) == (1, 0)
    assert orphans(young_s=0.0).orphans == []


def test_a_database_that_stays_full_makes_no_error_row(tmp_path: Path, faults, limits: Limits):
    job = first_job(tmp_path)
    limits(run_job, DATABASE_WAIT_S=0.05)
    faults(video.VideoInfo, "make_insert", *[FULL] * 1000)
    outcome = run_job.run(job)
    assert (outcome.what, outcome.code) == (run_job.LATER, "DB_REFUSED")
    assert recover.free_dead(video.VideoInfo) == 1  # what it let go
    assert video.VideoInfo.jobs.fetch1("status", "deaths") == ("pending", 0)


def test_a_database_that_stays_away_is_no_unforeseen_error(tmp_path: Path, faults, limits: Limits):
    job = first_job(tmp_path)
    limits(run_job, DATABASE_WAIT_S=0.05)
    away = pymysql.err.OperationalError(2003, "Can't connect to the server")
    faults(video.VideoInfo, "make_insert", *[away] * 1000)
    outcome = run_job.run(job)
    assert (outcome.what, outcome.code) == (run_job.LATER, "DB_NOT_RUNNING")


def test_a_deadlock_that_does_not_end_puts_the_job_back(tmp_path: Path, faults):
    job = first_job(tmp_path)
    deadlock = pymysql.err.OperationalError(1213, "Deadlock found when trying to get lock")
    faults(video.VideoInfo, "make_insert", *[deadlock] * 1000)
    outcome = run_job.run(job)
    assert (outcome.what, outcome.code) == (run_job.LATER, "DB_REFUSED")
    assert video.VideoInfo.jobs.fetch1("status") == "pending"
    assert "Deadlock" in video.VideoInfo.jobs.fetch1("error_message")


@pytest.mark.parametrize("number", [1205, 1213])
def test_a_decision_that_meets_a_deadlock_is_made_once(tmp_path: Path, faults, number: int):
    (one,) = register(chain.small_video(tmp_path, "walk"))
    broken_off = pymysql.err.OperationalError(number, "try restarting transaction")
    tried = faults(review_decisions, "record", broken_off, broken_off)
    review_decisions.mark_not_usable(one, "other", "dark", by="A. First")
    assert len(tried) == 3
    assert (len(video.NotUsable()), len(review.Decision())) == (1, 1)
    faults(review_decisions, "record", pymysql.err.OperationalError(1366, "Incorrect value"))
    with pytest.raises(pymysql.err.OperationalError):  # another error is not tried again
        review_decisions.take_back(one, by="A. First")
    assert len(video.NotUsable()) == 1


def test_two_decisions_that_lock_each_other_out_are_both_made(tmp_path: Path, faults: Faults):
    """A deadlock of the server's own: another connection holds the row that the decision locks second, and asks for the
    one that it locked first."""
    one, two = register(chain.small_video(tmp_path, "a"), chain.small_video(tmp_path, "b"))
    other, waiting = connection.plain_connection(), []
    videos, sessions = video.Video.full_table_name, session.Session.full_table_name

    def locks(*_, **__):
        if not waiting:
            cursor = other.cursor()
            other.begin()
            cursor.execute(f"UPDATE {videos} SET video_size = video_size + 1 WHERE video_id = {two}")
            # It has more to undo, so the server breaks the decision off.
            rows = [(f"X{i}", "unknown", "2026-01-01") for i in range(300)]
            columns = "subject, population, subject_created"
            cursor.executemany(f"INSERT INTO {lab.Subject.full_table_name} ({columns}) VALUES (%s, %s, %s)", rows)
            waiting.append(threading.Thread(target=cursor.execute, args=(f"SELECT * FROM {sessions} FOR UPDATE",)))
            waiting[0].start()
            time.sleep(0.5)
            try:
                connection.connect().query(f"SELECT * FROM {videos} WHERE video_id = {two} FOR UPDATE")
                pytest.fail("the server broke the other one off")
            finally:
                waiting[0].join()
                other.rollback()

    faults(review_decisions, "record", before=locks)
    review_decisions.mark_not_usable(one, "other", "dark", by="A. First")
    assert len(waiting) == 1
    assert (len(video.NotUsable()), len(review.Decision())) == (1, 1)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (pymysql.err.OperationalError(2013, "Lost connection"), "DB_NOT_RUNNING"),
        (pymysql.err.OperationalError(1213, "Deadlock found"), "DB_REFUSED"),
        (FULL, "DB_REFUSED"),
        (pymysql.err.DataError(1406, "Data too long"), "DB_REFUSED"),
    ],
)
def test_only_a_database_that_is_away_is_an_outage(error: Exception, code: str):
    said = of_server(error)
    assert said.code == code
    assert str(error.args[-1]) in said.found
    assert code == "DB_NOT_RUNNING" or str(error.args[0]) in said.found


def test_a_deadlock_while_jobs_are_swept_is_tried_again(tmp_path: Path, faults):
    queued(tmp_path, video.VideoInfo)
    deadlock = pymysql.err.OperationalError(1213, "Deadlock found when trying to get lock")
    tried = faults(type(jobs_of(video.VideoInfo)), "delete_quick", deadlock, deadlock)
    assert queue.sweep(video.VideoInfo) == 0  # the one job is still wanted
    assert len(tried) == 4  # two refused, then one for each of the two kinds that nobody needs


@pytest.mark.parametrize("place", [(refresh, "refresh"), (queue, "most_urgent"), (queue, "finish"), (refresh, "after")])
def test_no_statement_beside_a_job_ends_the_worker(tmp_path: Path, faults, place):
    register(chain.small_video(tmp_path, "walk"))
    locked = pymysql.err.OperationalError(1205, "Lock wait timeout exceeded")
    write = pymysql.err.InternalError(3, "Error writing file (Errcode: 28 No space left on device)")
    faults(*place, FULL, locked, write)
    assert work(video.VideoInfo).failed == 0
    assert (len(video.VideoInfo()), len(jobs_of(video.VideoInfo))) == (1, 0)


def test_a_worker_starts_while_the_database_takes_nothing(faults: Faults, limits: Limits):
    limits(heartbeat, PERIOD_S=0.02)
    faults(connection, "another", FULL)
    with heartbeat.Heartbeat("cpu") as beats:
        beats.count("VideoInfo", 1, 0, 0.1)
    assert worker.Worker.fetch1("worker") == beats.worker


def test_tables_are_bound_after_a_database_that_went_away_while_they_were(faults):
    schema, stage = connection.dj.Schema(), "outage"

    class Thing(connection.dj.Manual):
        definition = "thing : int32"

    schema(Thing)
    server = connection.connect()
    try:
        faults(server, "register", FULL)  # after the schema has its name, before its tables
        with pytest.raises(pymysql.err.OperationalError):
            connection.bind(stage, schema)
        connection.bind(stage, schema)
        Thing.insert1({"thing": 1})
        assert len(Thing()) == 1
    finally:
        schema.drop(prompt=False)


# ---------------------------------------------------------------------------------------------------------------- store
def test_a_full_store_keeps_no_half_a_file(tmp_path: Path, faults: Faults):
    job = first_job(tmp_path)
    write = Path.write_bytes

    def half(path: Path, content: bytes) -> None:
        write(path, content[: len(content) // 2])

    with faults(Path, "write_bytes", OSError(errno.ENOSPC, "No space left on device"), before=half):
        outcome = run_job.run(job)
    assert (outcome.what, outcome.code) == (run_job.LATER, "STORE_FULL")
    assert left_in_the_store(video.VideoInfo) == []


@pytest.mark.parametrize("where", [(video.VideoInfo, "make_insert"), (pbl_pipeline.video, "probe")])
def test_a_full_store_delays_the_job_and_says_why(tmp_path: Path, faults, where: tuple[Any, str]):
    job = first_job(tmp_path)
    faults(*where, OSError(errno.ENOSPC, "No space left on device"))
    outcome = run_job.run(job)
    assert (outcome.what, outcome.code) == (run_job.LATER, "STORE_FULL")
    assert jobs_left() == {"VideoInfo": {"pending": 1}}
    assert queue.claim(video.VideoInfo, 1) == []  # not before a minute is over
    state = next(t for t in pipeline_status().tables if t.table == "VideoInfo")
    assert "No space left on device" in state.delayed
    at_once(job)
    assert work(video.VideoInfo).done == 1


def test_a_bucket_without_room_has_its_code():
    refused = OSError(errno.EIO, "An error occurred (XMinioStorageFull) when calling the PutObject operation")
    assert store_error(refused).code == "STORE_FULL"
    assert store_error(OSError(errno.EIO, "no route to host")).code == "STORE_UNAVAILABLE"


@pytest.mark.parametrize("circle", [False, True])
@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, "STORE_FULL"), (errno.EIO, None)])
def test_a_store_is_found_among_the_causes_of_an_error(number: int, code: str | None, circle: bool):
    first, last = ValueError("no array"), OSError(number, "the disk")
    first.__cause__ = last
    last.__cause__ = first if circle else None
    assert list(causes(first)) == [first, last]
    assert getattr(store_full(first), "code", None) == code
    assert run_job.cause_outside(first) == f"STORE: OSError: {last}"


class Killed(BaseException):
    """In place of SIGKILL."""


def run_and_die(job: queue.Claim, faults: Faults) -> None:
    """Leave what a process leaves that is killed after its insert's last statement: a reservation and files, no row."""
    faults(run_job, "remove_left_over", None, Killed())
    with faults(job.table, "make_insert", Killed(), after=True), pytest.raises(Killed):
        run_job.run(job)
    queue.release_all()


@pytest.mark.parametrize("table", [tracking.Tracking, fit.SessionFit])
def test_who_does_the_job_of_a_dead_process_removes_its_files(tmp_path: Path, table: Any, faults: Faults):
    """Also those of its parts."""
    queued(tmp_path, table)
    run_and_die(queue.claim(table, 1)[0], faults)
    left = left_in_the_store(table)
    assert left
    recover.free_dead(table)
    work(table)
    assert orphans(young_s=0.0).orphans == []
    assert len(left_in_the_store(table)) == len(left)


def left_in_the_store(table: Any) -> list[Path]:
    """Files of a table and its parts."""
    root = Path(connection.store_backend().spec["location"]) / connection.store_root() / table.database
    return [f for folder in root.glob(f"{table.table_name}*") for f in folder.rglob("*") if f.is_file()]


def test_only_files_of_this_key_and_this_time_are_removed(tmp_path: Path):
    ids = register(*(chain.small_video(tmp_path, name) for name in ("walk1", "walk2")))
    work(video.VideoInfo)
    before = left_in_the_store(video.VideoInfo)
    for number in ids:  # they have rows
        remove_left_over(video.VideoInfo(), {"video_id": number}, 0.0)
    assert left_in_the_store(video.VideoInfo) == before
    (video.VideoInfo & {"video_id": ids[0]}).delete(prompt=False)
    # Files of a row that was deleted are older than its new job: they stay for a backup that is being made.
    remove_left_over(video.VideoInfo(), {"video_id": ids[0]}, before[0].stat().st_mtime + 3600)
    assert left_in_the_store(video.VideoInfo) == before
    remove_left_over(video.VideoInfo(), {"video_id": ids[0]}, 0.0)
    assert [f"video_id={ids[1]}" in str(f) for f in left_in_the_store(video.VideoInfo)] == [True]


# ---------------------------------------------------------------------------------------------------------------- clock
def test_jobs_do_not_wait_for_a_clock_that_was_set_back(tmp_path: Path):
    job = first_job(tmp_path)
    queue.put_back(job, "the store was full", run_job.STORE_WAIT_S)
    assert work(video.VideoInfo).done == 0  # it waits, as long as it should
    connection.connect().query("SET SESSION timestamp = UNIX_TIMESTAMP() - 3600")
    try:
        assert work(video.VideoInfo).done == 1
    finally:
        connection.connect().query("SET SESSION timestamp = DEFAULT")


def test_every_row_has_the_time_of_the_servers_clock(tmp_path: Path):
    """The server's clock stands in 2001 for this connection; a machine's own clock is in no row."""
    connection.connect().query("SET SESSION timestamp = 1000000000")
    try:
        (one, two) = register(chain.small_video(tmp_path, "walk"), chain.small_video(tmp_path, "again"))
        review_decisions.mark_not_usable(two, "other", "dark", by="A. First")
        assert work().failed == 0
        review_decisions.decide_person(one, 1, by="A. First")
    finally:
        connection.connect().query("SET SESSION timestamp = DEFAULT")
    times = {}
    for (schema, table), columns in catalog.tables().items():
        for column in (c.name for c in columns if c.type == "datetime" and not table.startswith(("#", "~"))):
            found = connection.connect().query(f"SELECT `{column}` FROM `{schema}`.`{table}`").fetchall()
            times |= {f"{table}.{column}": {str(t)[:10] for (t,) in found if t is not None}} if found else {}
    assert {"video.video_created", "__session_gdi.session_gdi_computed", "decision.decision_at"} <= set(times)
    assert {t for found in times.values() for t in found} == {"2001-09-09"}, times


def test_no_hour_comes_twice_in_autumn():
    """The server counts in the zone of its machine; every connection of ours in UTC."""
    with contextlib.closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SELECT CURRENT_TIMESTAMP = UTC_TIMESTAMP")
        assert cursor.fetchone() == (1,)
    assert connection.connect().query("SELECT CURRENT_TIMESTAMP = UTC_TIMESTAMP").fetchone() == (1,)
    assert connection.connect().query("SELECT @@session.time_zone").fetchone() == ("+00:00",)


# -------------------------------------------------------------------------------------------------------------- crashes
def test_crashes_do_not_outlive_success(tmp_path: Path):
    job = first_job(tmp_path)
    recover.crashed(job, "signal SIGKILL")
    assert video.VideoInfo.jobs.fetch1("attempts") == 1
    assert "SIGKILL" in video.VideoInfo.jobs.fetch1("error_message")
    at_once(job)
    assert work(video.VideoInfo).done == 1
    video.VideoInfo.delete(prompt=False)
    refresh.refresh()
    (again,) = queue.claim(video.VideoInfo, 1)
    assert again.attempts == 0
    for _ in range(recover.CRASHES - 1):
        assert recover.crashed(again, "signal SIGKILL")
        assert video.VideoInfo.jobs.fetch1("status") == "pending"
        at_once(job)
        (again,) = queue.claim(video.VideoInfo, 1)
    assert recover.crashed(again, "signal SIGKILL")
    assert error_code(video.VideoInfo.jobs.errors.fetch1("error_message")) == "WORKER_CRASH"


def test_a_job_that_takes_its_whole_worker_down_is_not_tried_for_ever(tmp_path: Path):
    """As where a container is ended for its memory: no supervisor is left that could count."""
    job = first_job(tmp_path)
    queue.release_all()
    with subprocess.Popen(["true"]) as dead:
        pass
    held = {"status": "reserved", "host": job.host, "pid": dead.pid, "connection_id": 0}
    for n in range(1, recover.DEATHS):
        video.VideoInfo.jobs.update1({**job.key, **held})
        assert recover.free_dead(video.VideoInfo) == 1
        assert video.VideoInfo.jobs.fetch1("status", "deaths") == ("pending", n)
    video.VideoInfo.jobs.update1({**job.key, **held})
    assert recover.free_dead(video.VideoInfo) == 1
    assert error_code(video.VideoInfo.jobs.errors.fetch1("error_message")) == "WORKER_CRASH"


# -------------------------------------------------------------------------------------------------------------- numbers
def test_a_number_is_never_given_twice(tmp_path: Path):
    """The next video had the number of the last one that was deleted, and with it its error row."""
    bad = tmp_path / "bad.mp4"
    bad.write_bytes(os.urandom(4096))
    (first,) = register(bad)
    visit = session.Session.fetch1("session_id")
    assert work(video.VideoInfo).failed == 1
    session.Session.delete(prompt=False)
    (second,) = register(chain.small_video(tmp_path, "walk"))
    assert second > first
    assert session.Session.fetch1("session_id") > visit
    assert work(video.VideoInfo).done == 1
    assert len(jobs_of(video.VideoInfo)) == 0


def test_jobs_of_a_deleted_key_go_whatever_a_refresh_looks_at(tmp_path: Path, limits: Limits):
    limits(refresh, FEW=0)  # as with very many videos
    job = first_job(tmp_path)
    queue.fail(job, "PblError: VIDEO_DAMAGED: x")
    refresh.refresh(everything=False)
    assert len(jobs_of(video.VideoInfo).errors) == 1
    video.Video.delete(prompt=False)
    found = refresh.refresh(everything=False)
    assert found is not None
    assert (found.swept, len(jobs_of(video.VideoInfo))) == (1, 0)


def test_people_who_use_datajoint_are_asked_before_rows_go():
    assert connection.dj.config["safemode"]


@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize("error", [
    pymysql.err.OperationalError(2013, "Lost connection to MySQL server during query"),
    LostConnectionError("Connection was lost"),
])  # fmt: skip
def test_a_database_that_goes_away_in_the_middle_of_any_command_is_named(
    monkeypatch: pytest.MonkeyPatch, error: Exception
):
    """Wherever it happens: the command line asks the tables what the error means."""

    def lost(*_: object, **__: object) -> None:
        raise ValueError("while rows were read") from error

    monkeypatch.setattr("pbl_workers.recover.free_dead", lost)
    monkeypatch.setattr("pbl_workers.requeue.error_counts", lost)
    for command in ("release", "reprocess"):
        done = pbl("cron", command)
        assert (done.code, done.error_code) == (1, "DB_NOT_RUNNING"), done.err
