"""Workers: the queue, what happens when a process, the database or the store goes away, and doing things again."""

import contextlib
import dataclasses
import datetime
import functools
import json
import os
import platform
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pymysql
import pytest
from click.testing import CliRunner

import pbl_pipeline.fit
import pbl_pipeline.video
import pbl_schemas
from pbl_pipeline.errors import CODES, MACHINE, PblError
from pbl_pipeline.fit import METHODS
from pbl_schemas import connection, fit, gait, gdi, keypoints, lab, qc, tracking, video, worker
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.cli.why import why as why_command
from pbl_schemas.jobs import jobs_of
from pbl_schemas.operations import embedded
from pbl_schemas.reading.status import live_workers, machines, pipeline_status
from pbl_schemas.reading.why import why
from pbl_schemas.rows import utc_now
from pbl_workers import heartbeat, loop, queue, recover, refresh, registry, requeue, run_job, supervisor
from pbl_workers.heartbeat import Heartbeat, Silent
from pbl_workers.loop import LEAVE_S, Worker, takes
from pbl_workers.process import Options
from pbl_workers.recover import CRASHES
from pbl_workers.supervisor import BATCH_NICE, Supervisor
from research.benchmarks import worker_replay
from tests import Faults, Limits, ended_process, until
from tests.rows import one_query_at_a_time, register

from . import chain, worker_target
from .jobs import beat, counts, first_job, hold, jobs_left, queued, work


def videos(folder: Path, *names: str) -> list[Path]:
    return [chain.small_video(folder, name) for name in names]


# ------------------------------------------------------------------------------------------------------ the whole chain
def test_what_follows_a_job_is_queued_at_once_and_nothing_is_forgotten(tables: None, tmp_path: Path, limits: Limits):
    register(*videos(tmp_path, "walk1", "walk2"), session_label="1")
    register(*videos(tmp_path, "walk3"), session_label="2")
    limits(loop, REFRESH_EVERY_S=1e9)  # one look at all tables, at the beginning
    done = work()
    expected = {t.__name__: 3 for t in pbl_schemas.computed_tables()}
    of_visits = ("SessionFit", "SessionGdi", "SessionQc", "Kinetics")
    expected |= dict.fromkeys(ON_REQUEST, 0) | dict.fromkeys(of_visits, 2)
    assert counts() == expected
    assert (done.done, done.failed) == (sum(expected.values()), 0)
    assert jobs_left() == {}
    found = refresh.refresh()
    assert found is not None
    assert (found.queued, found.planned, found.swept, found.freed) == ({}, 0, 0, 0)
    # A visit's checks are those of all its trials.
    assert set(qc.SessionQc.Check.to_arrays("qc_stage")) >= {"keypoints", "fit", "gait", "gdi"}


def test_fits_in_batches_are_the_fits_alone(tables: None, tmp_path: Path, stand_in, limits: Limits):
    batches = []

    def fit_sessions(sessions, paramset=None, **_):
        batches.append(len(sessions))
        return [chain.fit_session(s.trials, s.names, paramset, s.camera_motion) for s in sessions]

    stand_in(fit_sessions=fit_sessions)
    for i in range(5):
        register(*videos(tmp_path, f"walk{i}"), session_label=str(i))
    limits(loop, REFRESH_EVERY_S=1e9)
    work(*(t for t in pbl_schemas.computed_tables() if t is not fit.SessionFit))
    assert jobs_left() == {"SessionFit": {"pending": 5}}
    work(batch=2)
    assert batches == [2, 2, 1]
    assert len(fit.SessionFit()) == len(gdi.SessionGdi()) == 5
    assert jobs_left() == {}


def test_a_batch_that_fails_is_computed_one_by_one(tables: None, tmp_path: Path, stand_in):
    def fails(*_, **__):
        raise RuntimeError("out of memory")

    stand_in(fit_sessions=fails)
    for i in range(2):
        register(*videos(tmp_path, f"walk{i}"), session_label=str(i))
    assert work(batch=2).failed == 0
    assert len(fit.SessionFit()) == 2


def test_a_job_asks_the_database_for_rows_only_and_for_few(tables: None, tmp_path: Path, monkeypatch):
    """Not for columns of tables, which do not change while a worker runs."""
    monkeypatch.setitem(registry.STAGES, "VideoInfo", dataclasses.replace(registry.STAGES["VideoInfo"], batch=4))
    register(*videos(tmp_path, *(f"walk{i}" for i in range(8))))
    refresh.refresh()
    _, *steps = worker_replay.record([video.VideoInfo])
    asked = [text for step in steps for text, _ in step]
    assert not [text for text in asked if "information_schema" in text or "SHOW " in text]
    assert len(asked) / 4 <= 11  # four jobs a step, the server's clock among them


# ------------------------------------------------------------------------------------------------- one job, one result
def test_two_processes_with_the_same_job_leave_one_row(tables: None, tmp_path: Path):
    job = first_job(tmp_path)
    # Somebody took us for dead and gave the job to another process.
    video.VideoInfo.jobs.update1({**job.key, "host": "another-host", "pid": 7, "connection_id": 99})
    outcome = run_job.run(job)
    assert outcome.what == run_job.LOST
    assert len(video.VideoInfo()) == 0
    assert len(video.VideoInfo.jobs.reserved) == 1  # still the other's
    other = queue.Claim(video.VideoInfo, job.key, 5, "another-host", 7, 99)
    assert run_job.run(other).what == run_job.DONE
    assert len(video.VideoInfo()) == 1
    assert jobs_left() == {}


def test_nobody_takes_a_job_over_while_its_result_is_inserted(tables: None, tmp_path: Path):
    job, jobs = first_job(tmp_path), video.VideoInfo.jobs
    with contextlib.closing(connection.plain_connection()) as other, other.cursor() as cursor:
        cursor.execute("SET SESSION innodb_lock_wait_timeout = 1")
        take = f"UPDATE {jobs.full_table_name} SET host = 'another-host'"
        with jobs.connection.transaction:
            queue.lock_reservation(job)
            with pytest.raises(pymysql.err.OperationalError) as waited:
                cursor.execute(take)
            assert waited.value.args[0] == 1205  # waited for the lock in vain
        assert cursor.execute(take) == 1


@pytest.mark.parametrize(
    "end", [queue.finish, queue.put_back, lambda job: queue.fail(job, "PblError: VIDEO_DAMAGED: x")]
)
def test_who_lost_a_job_cannot_end_it_for_its_new_holder(tables: None, tmp_path: Path, end):
    job, jobs = first_job(tmp_path), video.VideoInfo.jobs
    jobs.update1({**job.key, "host": "another-host", "pid": 7, "connection_id": 99})
    end(job)
    assert jobs.fetch1("status", "host", "pid") == ("reserved", "another-host", 7)


def test_a_job_that_is_done_already_is_ended(tables: None, tmp_path: Path):
    job = first_job(tmp_path)
    video.VideoInfo.populate(job.key)
    assert run_job.run(job).what == run_job.ALREADY
    assert (len(video.VideoInfo()), jobs_left()) == (1, {})


def test_claims_are_by_priority_and_never_shared(tables: None, tmp_path: Path):
    ids = register(*videos(tmp_path, *(f"walk{i}" for i in range(6))))
    refresh.refresh()
    jobs = video.VideoInfo.jobs
    for i in ids[:3]:
        jobs.update1({"video_id": i, "priority": registry.AGAIN})
    assert queue.most_urgent({video.VideoInfo: None}) == {video.VideoInfo: registry.NEW}
    first = queue.claim(video.VideoInfo, 3)
    assert {c.key["video_id"] for c in first} == set(ids[3:])
    second = queue.claim(video.VideoInfo, 10)
    assert {c.key["video_id"] for c in second} == set(ids[:3])
    assert queue.claim(video.VideoInfo, 1) == []
    for job in first + second:
        queue.put_back(job)
    assert jobs_left() == {"VideoInfo": {"pending": 6}}


def test_a_more_urgent_job_waits_no_longer_than_candidates_are_kept(tables: None, tmp_path: Path):
    ids = {*register(*videos(tmp_path, *(f"walk{i}" for i in range(6))))}
    refresh.refresh()
    for look in (lambda: queue.most_urgent({video.VideoInfo: None}), lambda: time.sleep(queue.KEPT_S)):
        ids -= {job.key["video_id"] for job in queue.claim(video.VideoInfo)}
        urgent = ids.pop()
        video.VideoInfo.jobs.update1({"video_id": urgent, "priority": registry.FIRST})
        look()
        assert [job.key["video_id"] for job in queue.claim(video.VideoInfo)] == [urgent]
    # Others took what was read: the rest of the queue is still found.
    queue.most_urgent({video.VideoInfo: None})
    video.VideoInfo.jobs.delete_quick()
    assert queue.fill(video.VideoInfo) == 6
    for one in ids:
        video.VideoInfo.jobs.reserve({"video_id": one})
    assert len(queue.claim(video.VideoInfo, 6)) == 6 - len(ids)


@pytest.mark.parametrize("priority", [registry.NEW, registry.FIRST])
def test_who_has_the_pictures_takes_all_that_needs_them_unless_another_job_is_more_urgent(
    tables: None, tmp_path: Path, priority: int
):
    taken: list[queue.Claim] = []
    one = Worker(pbl_schemas.computed_tables(), Silent(), report=lambda job, end: taken.extend([] if end else [job]))
    other = queued(tmp_path, keypoints.Keypoints, "other")
    held = queue.claim(keypoints.Keypoints)[0]  # by another worker
    mine = queued(tmp_path, video.VideoInfo, "mine")
    one.step()
    queue.put_back(held)
    keypoints.Keypoints.jobs.update1({**held.key, "priority": priority})
    while not order_of("Keypoints", taken)[1:]:
        one.step()
    expected = [("VideoInfo", mine), ("Tracking", mine), ("SubjectChoice", mine), ("Keypoints", mine)]
    expected.insert(1 if priority == registry.FIRST else 4, ("Keypoints", other))
    of_pictures = [name for name, _ in expected]
    assert [(j.table.__name__, j.key["video_id"]) for j in taken if j.table.__name__ in of_pictures] == expected


@pytest.fixture
def of_lengths(tables: None, tmp_path: Path, limits: Limits) -> dict[str, int]:
    """Recordings by name, the long ones first; all wait to be read."""
    limits(queue, LONG_FRAMES=chain.N_FRAMES)
    hours = [chain.small_video(tmp_path, name, chain.N_FRAMES + 1) for name in ("hour", "hour_filmed")]
    ids = register(*hours, *videos(tmp_path, "walk", "again", "filmed"))
    named: dict[str, int] = dict(zip(("hour", "hour_filmed", "walk", "again", "filmed"), ids, strict=True))
    priorities = {"again": registry.AGAIN, "filmed": registry.FIRST, "hour_filmed": registry.FIRST}
    refresh.refresh()
    for name, priority in priorities.items():
        video.VideoInfo.jobs.update1({"video_id": named[name], "priority": priority})
    return named


def order_of(table: str, taken: list[queue.Claim]) -> list[int]:
    """The recordings whose jobs of a table were taken, in their order."""
    return list(dict.fromkeys(job.key["video_id"] for job in taken if job.table.__name__ == table))


def test_a_long_recording_waits_behind_the_short_ones_of_its_kind(of_lengths: dict[str, int]):
    taken: list[queue.Claim] = []
    work(report=lambda job, _: taken.append(job))
    expected = [of_lengths[name] for name in ("filmed", "hour_filmed", "walk", "hour", "again")]
    assert order_of("Tracking", taken) == order_of("Keypoints", taken) == expected
    stages = (tracking.Tracking, tracking.SubjectChoice, keypoints.Keypoints, fit.TrialInput)
    hour = {j.table: j.priority for j in taken if j.table in stages and j.key["video_id"] == of_lengths["hour"]}
    assert hour == dict.fromkeys(stages, registry.LONG[registry.NEW])
    assert {job.priority for job in taken if job.table is fit.SessionFit} <= {*registry.LONG.values()}  # the set's
    assert jobs_left() == {}


def test_long_recordings_never_hold_all_processes_of_a_worker(of_lengths: dict[str, int]):
    first, last = (Options(processes=2).of_process(number) for number in (0, 1))
    taken: list[queue.Claim] = []
    work(report=lambda job, _: taken.append(job), takes=takes(last.short, phones=False, phone=False))
    assert order_of("Tracking", taken) == [of_lengths[name] for name in ("filmed", "walk", "again")]
    assert jobs_left() == {"Tracking": {"pending": 2}}
    work(takes=takes(first.short, phones=False, phone=False))
    assert jobs_left() == {}
    assert not Options(processes=1, once=True).of_process(0).short  # it does everything


def run_until(boss: Supervisor, done: Callable[[], None]) -> int:
    with one_query_at_a_time():
        return ended_process.run_until(boss, done)


def test_nothing_waits_behind_a_long_recording_for_a_lone_process(of_lengths: dict[str, int], tmp_path: Path):
    work(*registry.tables_of("decode"))
    boss = Supervisor(Options("cpu", selftest=False, grace_s=0.0), target=worker_target.work)
    of_hours = tracking.Tracking.jobs & [{"video_id": of_lengths[name]} for name in ("hour", "hour_filmed")]
    seen: list[int] = []

    def come() -> None:
        until(lambda: len(keypoints.Keypoints()) == 3 and len(of_hours & "status = 'reserved'") == 1, 120)
        register(*videos(tmp_path, "late"), session_label="late")
        refresh.refresh()
        until(lambda: len(keypoints.Keypoints()) == 4, 120)
        seen.extend([len(of_hours), len(live_workers())])
        for name in ("hour", "hour_filmed"):
            (tmp_path / f"{name}.mp4.go").touch()
        until(lambda: jobs_left() == {"SessionFit": {"pending": 2}} and len(live_workers()) == 1, 120)
        seen.append(len(keypoints.Keypoints()))

    assert run_until(boss, come) == 0
    assert seen == [2, 2, 6]  # neither long one was done; their process ended after them


def test_one_process_takes_recordings_of_phones_alone_and_the_others_leave_them_to_it(of_lengths: dict[str, int]):
    def queued(seconds_ago: int) -> None:
        now = f"CURRENT_TIMESTAMP(3) - INTERVAL {seconds_ago} SECOND"
        jobs.connection.query(f"UPDATE {jobs.full_table_name} SET scheduled_time={now}")

    jobs, others = video.VideoInfo.jobs, takes(short=False, phones=True, phone=False)
    queued(0)
    urgent = [queue.most_urgent({video.VideoInfo: where}) for where in (None, others)]
    assert urgent == [{video.VideoInfo: registry.FIRST}, {video.VideoInfo: registry.NEW}]
    queued(LEAVE_S + 1)  # the process has another one in hand
    assert queue.most_urgent({video.VideoInfo: others}) == {video.VideoInfo: registry.FIRST}
    taken: list[queue.Claim] = []
    one = work(report=lambda job, _: taken.append(job), takes=takes(False, True, phone=True), phone=True)
    assert {*order_of("VideoInfo", taken)} == {of_lengths["filmed"], of_lengths["hour_filmed"]}
    assert order_of("Tracking", taken) == order_of("Keypoints", taken) == [of_lengths["filmed"]]  # the other is long
    assert {job.priority for job in taken} == {registry.FIRST}
    assert one.failed == 0
    assert jobs_left() == {"VideoInfo": {"pending": 3}, "Tracking": {"pending": 1}}


@pytest.mark.parametrize("when", ["while it is computed", "before its insert", "after its insert"])
def test_the_result_survives_a_database_that_goes_away(
    tables: None, tmp_path: Path, stand_in, database: Path, when: str, limits: Limits, faults: Faults
):
    job = first_job(tmp_path)
    ends = [when]
    server = embedded.Folder(database / "db")

    def reached(moment: str) -> None:
        if moment in ends:
            ends.remove(moment)
            os.kill(server.state()["pid"], signal.SIGKILL)
            threading.Timer(1.5, lambda: embedded.start(folder=server)).start()

    computed = faults(pbl_pipeline.video, "probe", before=lambda _: reached("while it is computed"))
    inserted = faults(
        video.VideoInfo,
        "make_insert",
        before=lambda *_: reached("before its insert"),
        then=lambda *_: reached("after its insert"),
    )
    limits(run_job, DATABASE_PAUSE_S=0.2)
    outcome = run_job.run(job)
    assert outcome.what == run_job.DONE
    assert outcome.seconds > 1.0
    assert len(computed) == 1  # and written when the database was back
    assert len(inserted) == (1 if when == "while it is computed" else 2)
    assert (len(video.VideoInfo()), jobs_left()) == (1, {})


def test_inputs_that_changed_meanwhile_are_read_again(tables: None, tmp_path: Path, faults: Faults):
    job = first_job(tmp_path)
    moves = {**job.key, "video_path": str(tmp_path / "elsewhere.mp4")}
    with faults(pbl_pipeline.video, "probe", before=lambda _: video.Video.update1(moves)):
        assert run_job.run(job).what == run_job.LATER
    assert jobs_left() == {"VideoInfo": {"pending": 1}}
    assert len(video.VideoInfo()) == 0


def test_a_result_of_other_inputs_is_not_used(tables: None, tmp_path: Path):
    """As of a batch that was computed before its inputs changed."""
    stale = run_job.Computed(("the inputs of then",), ("their result",))
    assert run_job.run(first_job(tmp_path), stale).what == run_job.DONE
    assert video.VideoInfo.fetch1("n_frames") == chain.N_FRAMES


# ----------------------------------------------------------------------------------------------- processes that go away
@pytest.mark.parametrize("table", [tracking.SubjectChoice, fit.SessionFit])
def test_a_worker_that_is_told_to_end_at_once_puts_back_all_it_holds(
    tables, tmp_path: Path, stand_in, table, faults: Faults
):
    """The job in hand and those that were taken with it, one after the other or in batches."""
    for i in range(3):
        register(*videos(tmp_path, f"walk{i}"), session_label=str(i))
    stand_in(fit_sessions=lambda sessions, *_, **__: [chain.fit_session(s.trials, s.names) for s in sessions])
    work(*(t for t in pbl_schemas.computed_tables() if t is not table))
    refresh.refresh()

    def ends(*_: object) -> None:
        assert len(table.jobs.reserved) == 3

    faults(table, "make_insert", SystemExit(0), before=ends)
    with pytest.raises(SystemExit):
        Worker([table], Silent(), batch=3).run()
    assert jobs_left()[table.__name__] == {"pending": 3}


def supervise(**options) -> int:
    """A worker as it runs in production, behind stand-ins."""
    boss = Supervisor(Options(once=True, selftest=False, **options), target=worker_target.work)
    watchdog = threading.Timer(1200, boss.stop)  # one that never ends fails, too
    watchdog.start()
    try:
        return boss.run()
    finally:
        watchdog.cancel()


@pytest.fixture
def quick(limits: Limits) -> None:
    limits(supervisor, RESTART_S=(0.05, 0.1))


def test_a_job_that_kills_its_process_becomes_an_error_and_the_others_are_done(tables, tmp_path: Path, quick: None):
    register(*videos(tmp_path, "walk1", "kills", "walk2"))
    assert supervise() == 0
    (error,) = pipeline_status().errors
    assert (error.table, error.code, error.about) == ("VideoInfo", "WORKER_CRASH", "kills.mp4")
    assert f"died {CRASHES} times" in error.found
    assert "SIGKILL" in error.found
    assert len(fit.SessionFit()) == 1
    assert len(fit.SessionFit.Trial()) == 2


def test_one_gpu_that_fails_is_said_and_the_work_goes_on(tables, tmp_path: Path, quick: None, limits: Limits):
    register(*videos(tmp_path, "walk1", "walk2"))
    limits(heartbeat, PERIOD_S=0.2)
    limits(supervisor, RESTART_S=(0.5, 2.0))
    boss = Supervisor(Options("decode", 2, selftest=False, gpus=("free", "full")), target=worker_target.work)

    def seen() -> bool:
        told = [text for machine in machines() for text in machine.resting]
        return len(video.VideoInfo()) == 2 and any("GPU full" in t and "times in a row" in t for t in told)

    assert run_until(boss, functools.partial(until, seen)) == 0
    assert "VideoInfo" not in jobs_left()


def test_a_job_beyond_its_time_limit_is_ended(tables, tmp_path: Path, quick: None):
    ids = register(*videos(tmp_path, "walk1", "hangs", "walk2"))
    factor = 4.0 / registry.stage_of("VideoInfo").limit_s
    assert supervise(resource="decode", limit_factor=factor) == 0
    (error,) = pipeline_status().errors
    assert (error.code, error.about) == ("TIME_LIMIT", "hangs.mp4")
    assert "time limit of 4 s" in error.found
    assert sorted(video.VideoInfo.to_arrays("video_id")) == [ids[0], ids[2]]
    assert jobs_left()["VideoInfo"] == {"error": 1}


def test_sigterm_lets_the_job_in_hand_end_or_puts_it_back(tables, tmp_path: Path, quick: None):
    for grace_s, done in ((120.0, 1), (0.0, 0)):
        (path,) = videos(tmp_path, f"slow{int(grace_s)}")
        register(path, session_label=path.stem)
        boss = Supervisor(Options(resource="decode", selftest=False, grace_s=grace_s), target=worker_target.work)
        start = time.monotonic()
        assert run_until(boss, functools.partial(until, Path(f"{path}.begun").exists, 1200)) == 0
        assert len(video.VideoInfo()) == done
        assert time.monotonic() - start < 120.0
        if done:
            lab.Subject.delete(prompt=False, part_integrity="cascade")
    assert jobs_left() == {"VideoInfo": {"pending": 1}}
    assert all(w["worker_stopped"] for w in worker.Worker.to_dicts())


def test_processes_that_are_to_end_at_once_get_one_signal_and_not_two_together(monkeypatch):
    sent: list[int] = []
    monkeypatch.setattr(os, "kill", lambda _, signum: sent.append(signum))
    for grace_s, expected in ((0.0, [signal.SIGUSR1]), (60.0, [signal.SIGTERM])):
        boss = Supervisor(Options(grace_s=grace_s))
        child: Any = SimpleNamespace(process=SimpleNamespace(is_alive=lambda: True, pid=1))
        boss._children = [child]
        boss.stop()
        boss._send_due()
        boss._send_due()
        assert sent == expected
        sent.clear()
    boss.stop()  # again: no longer wait for the jobs
    boss._send_due()
    assert sent == [signal.SIGUSR1]


def test_a_phone_does_not_wait_for_the_job_in_hand(tables: None, tmp_path: Path, quick: None):
    """The only other process of the worker never ends its job; it has a lower priority on the cores."""
    register(*videos(tmp_path, "hangs"))
    boss = Supervisor(Options(resource="decode", selftest=False, grace_s=0.0, phones=True), target=worker_target.work)
    seen: dict[str, int] = {}
    jobs = jobs_of(video.VideoInfo)

    def film() -> None:
        until(lambda: bool(len(jobs.reserved)) and len(live_workers()) == 2, 120)
        (filmed,) = register(*videos(tmp_path, "filmed"), session_label="filmed")
        queue.fill(video.VideoInfo, [{"video_id": filmed}], registry.FIRST)
        until(lambda: len(video.VideoInfo()) == 1, 120)
        until(lambda: any(w["worker_doing"].startswith("waits") for w in live_workers()), 120)
        seen.update({w["worker_doing"]: os.getpriority(os.PRIO_PROCESS, w["worker_pid"]) for w in live_workers()})

    assert run_until(boss, film) == 0
    assert len(seen) == 2
    phone = seen.pop("waits for a recording of a phone")
    assert phone == os.getpriority(os.PRIO_PROCESS, 0)
    assert [*seen.values()] == [min(phone + BATCH_NICE, 19)]
    assert all(w["worker_stopped"] for w in worker.Worker.to_dicts())  # neither had to be killed


def test_the_process_for_phones_ends_with_the_others(tables: None, tmp_path: Path):
    register(*videos(tmp_path, "walk"))
    assert Supervisor(Options("decode", max_jobs=1, selftest=False, phones=True), target=worker_target.work).run() == 0
    assert len(video.VideoInfo()) == 1
    ended = f"worker_stopped IS NOT NULL AND worker_resource != '{worker.SUPERVISOR}'"
    assert len(worker.Worker & ended) >= 1  # it may be told to end before it has its row
    assert len(worker.Worker & "worker_stopped IS NULL") == 0


def test_jobs_of_dead_workers_elsewhere_are_freed(tables: None, tmp_path: Path):
    """One whose heart stopped, or beat for the last time before the clock was set back, or that said goodbye. A
    populate by hand has no heart: only the time limit of its table ends its reservation."""
    ages = {"alive": 10.0, "dead": recover.DEAD_AFTER_S + 10, "ahead": -3600.0, "hand": None}
    ids = register(*videos(tmp_path, *ages))
    refresh.refresh()
    for number, (host, age) in zip(ids, ages.items(), strict=True):
        hold(number, host)
        if age is not None:
            beat(host, age)
    alive, dead, ahead, hand = ids
    assert recover.free_dead(video.VideoInfo) == 2
    assert {*video.VideoInfo.jobs.pending.to_arrays("video_id")} == {dead, ahead}
    hold(hand, "hand", seconds_ago=3600.0)
    assert recover.free_dead(video.VideoInfo) == 1
    assert video.VideoInfo.jobs.reserved.to_arrays("video_id").tolist() == [alive]
    worker.Worker.update1({"worker": "alive", "worker_stopped": utc_now()})
    assert recover.free_dead(video.VideoInfo) == 1


def test_the_heartbeat_says_what_is_done(tables: None, limits: Limits):
    limits(heartbeat, PERIOD_S=0.05)
    with Heartbeat("cpu") as beats:
        beats.doing("VideoInfo video_id=3")
        beats.count("VideoInfo", 2, 1, 0.5)
        until(lambda: [w["worker_doing"] for w in live_workers()] == ["VideoInfo video_id=3"], 120)
        assert [w["worker_pid"] for w in live_workers()] == [os.getpid()]
    assert live_workers() == []
    rows = worker.Throughput.to_dicts()
    assert (sum(r["n_done"] for r in rows), sum(r["n_failed"] for r in rows)) == (2, 1)


def test_a_number_that_a_younger_process_has_by_now_is_a_dead_ones(tables: None, tmp_path: Path):
    number = queued(tmp_path, video.VideoInfo)
    freed = []
    with subprocess.Popen(["sleep", "600"]) as young:
        for reserved_s in (0, 3600):
            hold(number, platform.node(), young.pid, reserved_s)
            freed.append(recover.free_dead(video.VideoInfo))
        young.kill()
    assert freed == [0, 1]


# ---------------------------------------------------------------------------------------------------- looking, redoing
def test_why_says_where_a_video_stands(tables: None, tmp_path: Path):
    (tmp_path / "bad.mp4").write_text("not a video")
    good, bad = register(*videos(tmp_path, "walk"), tmp_path / "bad.mp4")
    assert "not queued" in why(good).verdict
    refresh.refresh()
    assert why(good).verdict.startswith("reading of the video waits for a worker")
    work()
    assert why(good).verdict == "everything is computed"
    assert {s.table for s in why(good).steps if s.what == "done"} >= {"VideoInfo", "SessionFit", "SessionQc"}
    assert why(bad).verdict.startswith("reading of the video failed (VIDEO_NOT_A_VIDEO")
    alike = chain.small_video(tmp_path, "two", people="two alike")
    (waiting,) = register(alike, session_label="2")
    work()
    assert "pbl choose" in why(waiting).verdict
    result = CliRunner().invoke(why_command, [str(good), "--json"])
    assert json.loads(result.output)["verdict"] == "everything is computed"
    with pytest.raises(PblError, match="DB_NOT_FOUND"):
        why(999)


def test_few_and_many_videos_are_counted_alike(tables: None, tmp_path: Path, limits: Limits):
    (tmp_path / "bad.mp4").write_text("not a video")
    register(*videos(tmp_path, "walk"), tmp_path / "bad.mp4", session_label="1")
    register(chain.small_video(tmp_path, "two", people="two alike"), session_label="2")
    register(chain.small_video(tmp_path, "none", people="nobody"), session_label="3")
    work()
    few = pipeline_status(exact=False)
    done = {t.table: t.done for t in few.tables}
    assert done == counts()
    assert {t.table: t.error for t in few.tables if t.error} == {"VideoInfo": 1}
    found = {t.table: (t.empty, t.waiting) for t in few.tables if t.empty or t.waiting}
    assert found == {"SubjectChoice": (1, 1), "Kinetics": (1, 0)}
    assert few.cameras == {"guess": done["Keypoints"]}
    limits("pbl_schemas.reading.status", SMALL=0)  # through connections side by side
    many = pipeline_status(exact=False)
    assert [(t.table, t.done, t.empty, t.pending, t.error, t.waiting) for t in many.tables] == [
        (t.table, t.done, t.empty, t.pending, t.error, t.waiting) for t in few.tables
    ]
    assert (many.cameras, many.errors, many.empty, many.waiting) == (few.cameras, few.errors, few.empty, few.waiting)


def test_errors_are_tried_again_by_code_table_and_video(tables: None, tmp_path: Path):
    (tmp_path / "bad.mp4").write_text("not a video")
    gone = videos(tmp_path, "gone")[0]
    bad, lost = register(tmp_path / "bad.mp4", gone)
    gone.unlink()
    assert work().failed == 2
    assert requeue.retry(code="VIDEO_DAMAGED") == {}
    assert requeue.retry(table="Tracking") == {}
    assert requeue.retry(code="VIDEO_MISSING") == {"VideoInfo": 1}
    assert video.VideoInfo.jobs.pending.to_arrays("video_id").tolist() == [lost]
    assert requeue.retry(video_id=bad) == {"VideoInfo": 1}
    assert work().failed == 2
    with pytest.raises(PblError, match="USAGE"):
        requeue.retry(table="Tables")


def test_the_cause_of_a_code_decides_what_is_tried_again_every_night(tables: None):
    own = {"status": "error", "priority": 5}
    failed = [{"video_id": i, "error_message": f"{code}: why", **own} for i, code in enumerate(CODES)]
    jobs_of(video.VideoInfo).insert(failed)
    again = {code for code, one in CODES.items() if one.cause == MACHINE} - {"INTERNAL", "TIME_LIMIT"}
    assert {"FILE_UNWRITABLE", "STORE_FULL", "PACKAGE_MISSING", "WORKER_CRASH"} < again
    assert requeue.retry_outside() == dict.fromkeys(again, 1)
    assert len(video.VideoInfo.jobs.pending) == len(again)


def test_a_new_method_adds_rows_and_touches_no_old_one(tables: None, tmp_path: Path):
    register(*videos(tmp_path, "walk1", "walk2"))
    work()
    before = {
        t.__name__: t.to_dicts(order_by="KEY")
        for t in (video.VideoInfo, tracking.Tracking, fit.SessionFit, gait.GaitEvents)
    }
    plan = requeue.plan_new_method("SessionFit", "paper-2025")
    assert (len(plan.add), len(plan.outdated)) == (1, 0)
    list(requeue.carry_out(plan))
    pending = {t: c["pending"] for t, c in jobs_left().items()}
    assert pending == {"TrialInput": 2}  # nothing above the fit
    assert set(fit.TrialInput.jobs.to_arrays("priority")) == {registry.AGAIN}
    work()
    assert len(fit.SessionFit()) == 2
    assert len(gait.GaitEvents()) == 4
    for table, prefix in ((video.VideoInfo, "video_info"), (tracking.Tracking, "tracking")):
        stamps = [r[f"{prefix}_computed"] for r in before[table.__name__]]
        assert table.to_arrays(f"{prefix}_computed", order_by="KEY").tolist() == stamps
    key = {"fit_method": before["SessionFit"][0]["fit_method"]}
    assert [r["fit_computed"] for r in (fit.SessionFit & key).to_dicts(order_by="KEY")] == [
        r["fit_computed"] for r in before["SessionFit"]
    ]
    assert not requeue.plan_new_method("SessionFit", "paper-2025").add
    assert METHODS["paper-2025"].name == "paper-2025"
    with pytest.raises(PblError, match="USAGE"):
        requeue.plan_new_method("VideoInfo", "paper-2025")


def test_results_are_computed_again_behind_new_work(tables: None, tmp_path: Path):
    register(*videos(tmp_path, "walk1"), session_label="1")
    work()
    plan = requeue.plan_again("GaitEvents", before=datetime.datetime(2000, 1, 1))
    assert not plan.outdated
    plan = requeue.plan_again("GaitEvents", since=datetime.datetime(2000, 1, 1))
    assert len(plan.outdated) == 1
    assert any("gait_cycle" in name for name in plan.below)
    assert len(gait.GaitEvents()) == 1  # a plan changes nothing
    list(requeue.carry_out(plan))
    assert len(gait.GaitEvents()) == 0
    assert set(gait.GaitEvents.jobs.to_arrays("priority")) == {registry.AGAIN}
    work()
    assert len(gait.GaitEvents()) == len(gdi.SessionGdi()) == 1
