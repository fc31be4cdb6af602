"""Cost of the queue. Failures that it survives: `research.benchmarks.chaos`.

    python -m research.benchmarks.workers scale              # 300,000 videos: register, status, refresh, cost per job
    python -m research.benchmarks.workers speed              # jobs a second of 1 to 4 workers on 5,000 keys
    python -m research.benchmarks.workers take               # a job taken against DataJoint's reserve
    python -m research.benchmarks.workers method             # a new parameter set over 10,000 fitted sessions
    python -m research.benchmarks.workers memory             # a worker's memory over 500 jobs
    python -m research.benchmarks.workers long               # 300 videos with one of two hours among them
    python -m research.benchmarks.workers kills              # kill -9 ten times in every stage

Heavy stages return a recorded result: the subject is the queue. Each command starts a separate database in a temporary
folder and removes it.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from pbl_workers.queue import Claim
from pbl_workers.run_job import Outcome
from research.benchmarks import worker_replay, worker_standins
from tests import database
from tests.integration import chain

#: What a worker reports of a job (see `pbl_workers.loop.Worker`), and when.
Report = tuple[float, Claim, Outcome | None]
#: Videos of a session.
EACH = 6
#: The command `pbl` of this interpreter.
_PBL = "from pbl_pipeline.cli import main; main()"
#: Jobs that follow from a session: nine for each video, three for all.
_JOBS_OF_A_SESSION = 9 * EACH + 3


@contextlib.contextmanager
def installation() -> Iterator[Path]:
    """Yield the folder of a separate database and store, with the recorded stages also in this process."""
    import pbl_schemas

    with database.installation() as home, pytest.MonkeyPatch.context() as patch:
        pbl_schemas.activate()
        patch.setenv(worker_standins.RECORDED, str(chain.small_video(home, "recorded")))
        worker_standins.install(patch)
        yield home


def recordings(first: int, n: int) -> Iterator[Any]:
    """Numbered recordings, `EACH` of a session, one session of a subject."""
    from pbl_schemas.intake import VisitRecord
    from research.benchmarks.many_recordings import archived

    for i in range(first, first + n):
        sha256 = hashlib.sha256(str(i).encode()).hexdigest()
        yield archived(f"/recordings/{i:07d}.mp4", sha256, 1000 + i, VisitRecord(f"S{i // EACH:07d}", "1"))


def say(what: str, value: float, unit: str, bar: str = "") -> None:
    """One line of the table."""
    click.echo(f"{what:<66}{value:>10.3g} {unit:<10}{bar}")


def work(processes: int, heard: list[Report] | None = None, **options: Any) -> float:
    """Work until nothing is left; return the seconds from the first report to the last one. `heard` gets all
    reports."""
    from pbl_workers.metrics import KeptReports
    from pbl_workers.process import Options
    from pbl_workers.supervisor import Supervisor

    once = {"once": True, "selftest": False, "processes": processes, **options}
    metrics = KeptReports()
    assert Supervisor(Options(**once), metrics, worker_standins.work).run() == 0
    if heard is not None:
        heard += metrics.reports
    return metrics.reports[-1][0] - metrics.reports[0][0]


# --------------------------------------------------------------------------------------------------------------- scale
@click.group()
def main() -> None:
    """Benchmarks of the queue."""


@main.command()
@click.option("--videos", default=300_000, show_default=True)
def scale(videos: int) -> None:
    """Register, look, refresh, work, with as many videos."""
    from pbl_schemas import computed_tables, video
    from pbl_schemas.reading.status import pipeline_status
    from pbl_workers import refresh
    from research.benchmarks.many_recordings import register_many

    with installation():
        small = 3000
        register_many(recordings(0, EACH))
        work(1)  # the session whose rows are copied
        register_many(recordings(EACH, small - EACH))
        copy_results(0, small // EACH)
        few = _cost_per_job(small, sessions=40)
        begin = small + 40 * EACH
        t = time.monotonic()
        registered = register_many(recordings(begin, videos - begin))["registered"]
        seconds = time.monotonic() - t
        say(f"{videos:,} videos registered", seconds * videos / max(registered, 1), "s", "bar 300")
        copy_results(begin // EACH, videos // EACH)
        t = time.monotonic()
        state = pipeline_status()
        say("what pbl status asks the database", time.monotonic() - t, "s")
        assert {s.table: s.done for s in state.tables} == {t.__name__: len(t()) for t in computed_tables()}
        t = time.monotonic()
        subprocess.run([sys.executable, "-c", _PBL, "status"], check=True, capture_output=True)
        say("pbl status, the whole command", time.monotonic() - t, "s", "bar 3")
        click.echo("".join(f"  {s.table} {s.done}" for s in state.tables))
        t = time.monotonic()
        assert refresh.refresh(True) is not None
        say("a look at everything (once an hour)", time.monotonic() - t, "s")
        video.Video.connection.query(f"UPDATE {video.Video.full_table_name} SET video_created = '2026-01-01'")
        register_many(recordings(videos, 1002))
        t = time.monotonic()
        found = refresh.refresh()
        assert found is not None
        say(f"refresh with 1,002 new videos ({found.queued})", time.monotonic() - t, "s", "bar 10")
        many = _cost_per_job(videos + 1002, sessions=40)
        say("cost of a job beside its work, 2 workers, 3,000 videos", 1000 * few, "ms", "bar 25")
        say(f"cost of a job beside its work, 2 workers, {videos:,} videos", 1000 * many, "ms", "bar 25")
        say("ratio of the two", many / few, "", "bar 1.5")


def _cost_per_job(first: int, sessions: int) -> float:
    """Seconds a job of two workers costs beside make_compute, over a whole chain of new sessions."""
    from pbl_schemas import computed_tables
    from research.benchmarks.many_recordings import register_many

    before = {t.__name__: _computed(t) for t in computed_tables()}
    register_many(recordings(first, sessions * EACH))
    seconds = work(2)
    n, compute = 0, 0.0
    for table in computed_tables():
        rows, total = _computed(table)
        n += rows - before[table.__name__][0]
        compute += total - before[table.__name__][1]
    return (2 * seconds - compute) / n


def _computed(table: Any) -> tuple[int, float]:
    """Rows of a table and the seconds their computation took."""
    column = next(n for n in table.heading.names if n.endswith("_seconds") and n != "compile_seconds")
    n, total = table.connection.query(f"SELECT COUNT(*), SUM({column}) FROM {table.full_table_name}").fetchone()
    return int(n), float(total or 0.0)


def copy_results(first_session: int, last_session: int, parts: bool = False) -> None:
    """Give sessions the rows of session 1, in the tables that the queue reads. `parts`: also in those that lists of
    visits read, of cycles, measures and checks."""
    from pbl_schemas import fit, gait, gdi, keypoints, qc, tracking, video

    copied = (
        video.VideoInfo,
        tracking.Tracking,
        tracking.SubjectChoice,
        keypoints.Keypoints,
        fit.TrialInput,
        fit.FitSet,
        fit.FitSet.Video,
        fit.FitSelection,
        fit.SessionFit,
        fit.SessionFit.Trial,
        gait.GaitEvents,
        gait.GaitCycle,
        gait.Spatiotemporal,
        gdi.GDI,
        gdi.SessionGdi,
        qc.SessionQc,
        *((gait.GaitCycle.Cycle, gdi.SessionGdi.Measure, qc.SessionQc.Check) if parts else ()),
    )
    first = max(first_session, 1)
    template = _first_set()
    names_of_sets = _names_of_sets(first, last_session)
    for table in copied:
        names = [f"`{n}`" for n in table.heading.names]
        values = {
            "`video_id`": f"t.video_id + {EACH} * s.seq",
            "`session_id`": "t.session_id + s.seq",
            "`fit_set`": "s.name",
        }
        of_first = f"t.video_id < {_first(video.Video, 'video_id') + EACH} AND %s != ''"
        where = "t.fit_set = %s" if "fit_set" in table.heading.names else of_first
        table.connection.query(
            f"INSERT INTO {table.full_table_name} ({','.join(names)})"
            f" SELECT {','.join(values.get(n, f't.{n}') for n in names)} FROM {table.full_table_name} AS t"
            f" JOIN {names_of_sets} AS s WHERE {where}",
            args=(template,),
        )


def _names_of_sets(first: int, last: int) -> str:
    """A temporary table of the sessions `range(first, last)` and the names that planning would give their sets."""
    from pbl_schemas import fit, session
    from pbl_schemas.plan import fit_set_hash

    methods = (fit.FitSet.Video & {"fit_set": _first_set()}).to_dicts(limit=1)[0]
    number = _first(session.Session, "session_id")
    name = f"`{fit.FitSet.database}`.`names_of_sets`"
    query = fit.FitSet.connection.query
    query(f"CREATE OR REPLACE TEMPORARY TABLE {name} (seq INT PRIMARY KEY, name CHAR(16))")
    for start in range(first, last, 1000):
        values = []
        for i in range(start, min(start + 1000, last)):
            rows = [{"video_sha256": r.files[0].sha256, "keypoints_person_id": 1} for r in recordings(i * EACH, EACH)]
            values += [i, fit_set_hash({**methods, "session_id": number + i}, rows)]
        query(f"INSERT INTO {name} VALUES {','.join(['(%s,%s)'] * (len(values) // 2))}", args=values)
    return name


def _first(table: Any, column: str) -> int:
    """The smallest number of a table."""
    return int(table.connection.query(f"SELECT MIN({column}) FROM {table.full_table_name}").fetchone()[0])


def _first_set() -> str:
    from pbl_schemas import fit, session

    of_first = {"session_id": _first(session.Session, "session_id")}
    (name,) = (fit.FitSet & of_first).to_arrays("fit_set", order_by="fit_set_created", limit=1)
    return str(name)


# --------------------------------------------------------------------------------------------------------------- speed
@main.command()
@click.option("--keys", default=5000, show_default=True)
@click.option(
    "--work-ms", default=0.0, show_default=True, help="What a job takes that needs no processor of this machine."
)
def speed(keys: int, work_ms: float) -> None:
    """Jobs a second of one table (VideoInfo) by 1 to 4 workers, each key exactly once; what the database could do."""
    from pbl_schemas import tracking, video
    from pbl_schemas.operations import embedded
    from pbl_workers import queue
    from research.benchmarks.many_recordings import register_many

    def begin() -> None:
        """Let all keys wait, with nothing done."""
        for rows in (video.VideoInfo, tracking.Tracking.jobs, video.VideoInfo.jobs):
            rows.delete_quick()
        assert queue.fill(video.VideoInfo) == keys

    with installation() as home:
        server = embedded.Folder(home / "db").state()["pid"]
        register_many(recordings(0, keys))
        os.environ[worker_standins.SLEEP] = str(work_ms / 1000)
        click.echo(
            f"{keys} keys, {work_ms:g} ms of work each, {os.cpu_count()} cores for workers and database together"
        )
        alone = 0.0
        for processes in (1, 2, 3, 4):
            begin()
            heard: list[Report] = []
            before = _processor_s(server)
            work(processes, heard, resource="decode")
            ended = [(t, outcome) for t, _, outcome in heard if outcome is not None]
            once = {outcome.job.hash: outcome.what for _, outcome in ended}
            assert len(ended) == len(once) == len(video.VideoInfo()) == keys
            assert set(once.values()) == {"done"}
            # Workers start one after the other: counted from when all of them had begun.
            begun = max(min(t for t, job, _ in heard if job.connection_id == c) for c in _connections(heard, processes))
            rate = sum(t > begun for t, _ in ended) / (ended[-1][0] - begun)
            alone = alone or rate
            say(f"{processes} workers, each key done once", rate, "jobs/s", f"{rate / alone:.2f} times one")
            say("  processor time of the database", 1000 * (_processor_s(server) - before) / keys, "ms a job")
        begin()
        steps = worker_replay.record([video.VideoInfo])
        for n in (1, 2, 4, 8):
            begin()
            seconds, repeated = worker_replay.replay(steps, n)
            assert len(video.VideoInfo()) == keys
            again = f"{repeated} steps again after a deadlock" if repeated else ""
            say(f"the same statements without the workers, {n} connections", keys / seconds, "jobs/s", again)
        say("statements of a job", sum(map(len, steps)) / keys, "")


@main.command()
@click.option("--keys", default=2000, show_default=True)
@click.option("--repeats", default=5, show_default=True)
def take(keys: int, repeats: int) -> None:
    """Time to take a job of a table (VideoInfo) against DataJoint's `jobs.reserve` of a known key, on the same rows."""
    from pbl_schemas import tracking, video
    from pbl_schemas.jobs import jobs_of
    from pbl_workers import queue
    from research.benchmarks.many_recordings import register_many

    def ms(call: Callable[[], int]) -> float:
        """Fastest time of a job (ms)."""
        out = []
        for _ in range(repeats):
            jobs.delete_quick()
            assert queue.fill(video.VideoInfo) == keys
            t = time.perf_counter()
            n = call()
            out.append(1000 * (time.perf_counter() - t) / n)
        return min(out)

    with installation():
        register_many(recordings(0, keys))
        jobs = jobs_of(video.VideoInfo)
        known = [{"video_id": int(v)} for v in video.Video.to_arrays("video_id")]
        some = known[: keys // 4]
        alone = ms(lambda: sum(jobs.reserve(key) for key in some))
        say("jobs.reserve of a known key", alone, "ms")
        for n in (1, 8):
            taken = ms(lambda n=n: sum(len(queue.claim(video.VideoInfo, n)) for _ in range(len(some) // n)))
            say(f"a job taken, {n} at a time", taken, "ms", f"{taken / alone:.2f} times, bar 1.3")
        assert not len(tracking.Tracking.jobs)


def _connections(heard: list[Report], n: int) -> set[int]:
    """The workers' connections, from their reports; all of them must have worked."""
    found = {job.connection_id for _, job, _ in heard}
    assert len(found) == n, found
    return found


def _processor_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# -------------------------------------------------------------------------------------------------------------- method
@main.command()
@click.option("--sessions", default=10_000, show_default=True)
@click.option("--worked", default=20, show_default=True, help="Sessions whose new fits are computed then.")
def method(sessions: int, worked: int) -> None:
    """A new parameter set of the fit over fitted sessions: what becomes pending, and that no old row changes."""
    from pbl_schemas import computed_tables, fit
    from pbl_workers import refresh, requeue
    from research.benchmarks.many_recordings import register_many

    with installation():
        register_many(recordings(0, EACH))
        work(1)  # the session whose rows are copied
        register_many(recordings(EACH, (sessions - 1) * EACH))
        copy_results(0, sessions)
        refresh.refresh(True)
        tables = computed_tables()
        assert not any(_pending(tables).values()), "the copied sessions are not complete"
        old = {t.__name__: _contents(t) for t in tables}
        t = time.monotonic()
        plan = requeue.plan_new_method("SessionFit", "paper-2025")
        say("planned", time.monotonic() - t, "s", f"{len(plan.add)} selections")
        t = time.monotonic()
        for _ in requeue.carry_out(plan):
            pass
        say("queued", time.monotonic() - t, "s")
        refresh.refresh(True)
        pending = {name: n for name, n in _pending(tables).items() if n}
        click.echo(f"pending: {pending}")
        assert pending == {"TrialInput": sessions * EACH}  # from which the fits are planned
        assert {t.__name__: _contents(t) for t in tables} == old
        jobs = fit.TrialInput.jobs
        jobs.connection.query(f"UPDATE {jobs.full_table_name} SET priority = 1 WHERE video_id <= {worked * EACH}")
        work(2, resource="light", max_jobs=worked * EACH // 2)
        work(2, resource="fit")
        made = len(fit.SessionFit()) - sessions
        click.echo(f"{made} new fits; pending: { {name: n for name, n in _pending(tables).items() if n} }")
        assert made == worked
        new = plan.chosen["fit_method"]
        for table in tables:
            assert _contents(table, new) == old[table.__name__], table.__name__
        click.echo(f"old rows of {len(tables)} tables unchanged (number and sum over every column of every row)")


def _pending(tables: list[Any]) -> dict[str, int]:
    return {t.__name__: len(t.jobs.pending) for t in tables}


def _contents(table: Any, but: str = "") -> tuple[int, int]:
    """Number of rows, and a sum over a hash of every column of each; those of the fit method `but` left out."""
    columns = ",".join(f"COALESCE(`{n}`,'')" for n in table.heading.names)
    query = f"SELECT COUNT(*), COALESCE(SUM(CRC32(CONCAT_WS('|',{columns}))),0) FROM {table.full_table_name}"
    if "fit_method" in table.heading.names:
        query += " WHERE fit_method <> %s"
        n, total = table.connection.query(query, args=(but,)).fetchone()
    else:
        n, total = table.connection.query(query).fetchone()
    return int(n), int(total)


# -------------------------------------------------------------------------------------------------------------- memory
@main.command()
@click.option("--jobs", default=500, show_default=True)
def memory(jobs: int) -> None:
    """Resident memory of one worker, started as in production: after 20 jobs, after all, after as many again."""
    from pbl_workers.metrics import Metrics
    from pbl_workers.process import Options
    from pbl_workers.supervisor import Supervisor
    from research.benchmarks.many_recordings import register_many

    with installation():
        register_many(recordings(0, EACH * math.ceil(2 * jobs / _JOBS_OF_A_SESSION)))
        sizes: list[tuple[str, float]] = []

        class Watch(Metrics):
            def heard(self, job: Claim, outcome: Outcome | None) -> None:
                if outcome is not None:
                    (child,) = [c.process.pid for c in boss._children]
                    pages = int(Path(f"/proc/{child}/statm").read_text().split()[1])
                    sizes.append((job.table.__name__, pages * os.sysconf("SC_PAGE_SIZE") / 2**20))

        boss = Supervisor(Options(once=True), Watch(), worker_standins.work)
        assert boss.run() == 0
        mib = [size for _, size in sizes]
        assert len(mib) >= 2 * jobs
        first = {name: i for i, (name, _) in reversed([*enumerate(sizes)])}
        for name, i in sorted(first.items(), key=lambda f: f[1]):
            say(f"job {i + 1}, the first of {name}", mib[i], "MiB", f"{mib[i] - mib[max(i - 1, 0)]:+.1f}")
        say("memory after 20 jobs", mib[19], "MiB")
        say(
            f"memory after {jobs} jobs", mib[jobs - 1], "MiB", f"{100 * (mib[jobs - 1] / mib[19] - 1):+.1f} %, bar +5 %"
        )
        again = 100 * (mib[2 * jobs - 1] / mib[jobs - 1] - 1)
        say(f"memory after {2 * jobs} jobs", mib[2 * jobs - 1], "MiB", f"{again:+.1f} % since then")


# ---------------------------------------------------------------------------------------------------------------- long
@main.command()
@click.option("--videos", default=300, show_default=True, help="Short recordings that wait.")
@click.option("--minutes", default=120.0, show_default=True, help="Length of the long one, registered before them.")
@click.option("--late", default=10, show_default=True, help="Recordings that come while it is detected, half by phone.")
@click.option("--processes", default=1, show_default=True)
@click.option("--faster", default=100.0, show_default=True, help="Detection takes 1/N of the time that it would.")
def long(videos: int, minutes: float, late: int, processes: int, faster: float) -> None:
    """Waiting time of a recording behind another video: the longest time in which no process took any job."""
    from pbl_schemas import tracking, video
    from pbl_schemas.intake import VisitRecord
    from pbl_workers import queue, refresh
    from pbl_workers.heartbeat import Silent
    from pbl_workers.loop import Worker
    from pbl_workers.metrics import Metrics
    from pbl_workers.process import Options
    from pbl_workers.registry import FIRST, tables_of
    from pbl_workers.supervisor import Supervisor
    from research.benchmarks.many_recordings import archived, register_many

    frames = round(minutes * 60 * 30)
    begun: list[tuple[float, int]] = []  # when a job was taken, and of which recording
    detected: dict[int, float] = {}
    registered: dict[int, float] = {}
    phones: set[int] = set()

    def register(i: int, path: str) -> int:
        visit = VisitRecord(f"S{i // EACH:07d}", "1") if i >= 0 else VisitRecord("LONG", "1")
        register_many([archived(path, hashlib.sha256(path.encode()).hexdigest(), 1000 + i, visit)])
        (video_id,) = (video.Video & {"video_path": path}).to_arrays("video_id")
        registered[int(video_id)] = time.monotonic()
        return int(video_id)

    class Heard(Metrics):
        def heard(self, job: Claim, outcome: Outcome | None) -> None:
            one = int(job.key.get("video_id", 0))
            if outcome is None:
                begun.append((time.monotonic(), one))
            elif job.table.__name__ == "Keypoints":
                assert outcome.what == "done", outcome
                detected[one] = time.monotonic()

    class Visitors(Supervisor):
        """Registers recordings while the long one is detected, and ends when all are."""

        def _settle(self) -> None:
            super()._settle()
            n = len(registered) - videos - 1
            if n < late and any(one == hour for _, one in begun):
                share = (n + 0.5) / late * 2 * frames / (worker_standins.REAL_RATE * faster)
                if time.monotonic() - next(t for t, one in begun if one == hour and t > read) > share:
                    one = register(videos + n, f"/recordings/{videos + n:07d}.mp4")
                    if n % 2:
                        phones.add(one)
                        queue.fill(video.VideoInfo, [{"video_id": one}], FIRST)
                    else:
                        refresh.refresh()
            if len(detected) == videos + 1 + late and not self._stopping:
                self.stop()

    with installation():
        os.environ[worker_standins.RATE] = str(worker_standins.REAL_RATE * faster)
        hour = register(-1, f"/recordings/long_{frames}frames.mp4")
        register_many(recordings(0, videos))
        registered.update(dict.fromkeys(map(int, video.Video.to_arrays("video_id")), time.monotonic()))
        Worker(tables_of("decode"), Silent()).run(once=True)  # all are read
        read = time.monotonic()
        assert len(tracking.Tracking.jobs.pending) == videos + 1
        options = Options("cpu", processes, selftest=False)  # the fit is left out
        assert Visitors(options, Heard(), worker_standins.work).run() == 0
        del os.environ[worker_standins.RATE]
    taken = [one for _, one in begun]
    gaps = [(after - before, after) for (before, _), (after, _) in itertools.pairwise(begun)]

    def longest(one: int) -> float:
        """Seconds, as long as they would be, in which this recording waited and no process took a job."""
        since = max(registered[one], read)
        waits = [min(gap, after - since) for gap, after in gaps if since < after <= detected[one]]
        return faster * max(waits)

    queued = [one for one in registered if one <= videos + 1 and one != hour]
    others = [one for one in registered if one > videos + 1]
    click.echo(f"{processes} processes, detection {worker_standins.REAL_RATE:g} frames/s, {faster:g} times as fast")
    say("recordings taken before the long one", len(set(taken[: taken.index(hour)])), "", f"of {videos} that waited")
    say("one that waited: longest behind another's video", max(map(longest, queued)) / 60, "min", "bar 10")
    say("one that came meanwhile: longest behind another's video", max(map(longest, others)) / 60, "min", "bar 10")
    for name, group in (("phone", phones), ("other", {*others} - phones)):
        times = sorted(faster * (detected[one] - registered[one]) / 60 for one in group)
        say(f"one that came meanwhile, by {name}: keypoints after, median", times[len(times) // 2], "min")


# --------------------------------------------------------------------------------------------------------------- kills
#: Folder in which each kill of `kills` has a file, named by its table, moment and key; and how many a table gets.
_KILLS, _EACH = "PBL_BENCH_KILLS", "PBL_BENCH_KILLS_EACH"
#: While it computes; before its insert; after its last statement and file; after the commit, before the job ends.
_MOMENTS = ("computing", "before the insert", "before the commit", "after the commit")


def killed(options: Any, pipe: Any) -> None:
    """A working process that kills itself, at a random moment of a job; twice a job, which gets three attempts."""
    from pbl_schemas import computed_tables
    from pbl_workers import queue, run_job

    folder, draw = Path(os.environ[_KILLS]), random.Random(os.getpid())
    moments: dict[str, str] = {}

    def at(name: str, moment: str, key: dict[str, Any]) -> None:
        job = queue.key_hash(key)
        drawn = moments.setdefault(name + job, draw.choice(_MOMENTS))
        before = [f.name for f in folder.glob(f"{name}.*")]
        if drawn == moment and len(before) < int(os.environ[_EACH]) and sum(job in b for b in before) < 2:
            (folder / f"{name}.{moment}.{job}.{os.getpid()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)

    def watched(table: Any, compute: Any, insert: Any) -> None:
        def make_compute(self: Any, key: dict[str, Any], *fetched: Any) -> Any:
            at(table.__name__, _MOMENTS[0], key)
            return compute(self, key, *fetched)

        def make_insert(self: Any, key: dict[str, Any], *computed: Any) -> None:
            at(table.__name__, _MOMENTS[1], key)
            insert(self, key, *computed)
            at(table.__name__, _MOMENTS[2], key)

        table.make_compute, table.make_insert = make_compute, make_insert

    for table in computed_tables():
        watched(table, table.make_compute, table.make_insert)
    finish = queue.finish

    def finished(job: Claim) -> None:
        at(job.table.__name__, _MOMENTS[3], job.key)
        finish(job)

    run_job.queue.finish = finished
    worker_standins.work(options, pipe)


@main.command()
@click.option("--each", default=10, show_default=True, help="Kills in each stage.")
def kills(each: int) -> None:
    """Kill the working process in every stage, at four moments of a job: every row is there once, nothing is left."""
    from pbl_schemas import chain as tables_chain
    from pbl_schemas import computed_tables
    from pbl_schemas.operations.orphans import orphans
    from pbl_schemas.reading.status import queue_counts
    from pbl_schemas.video import Video
    from pbl_workers import refresh, supervisor
    from pbl_workers.process import Options
    from research.benchmarks.many_recordings import register_many

    with installation() as home, pytest.MonkeyPatch.context() as patch:
        (home / "kills").mkdir()
        patch.setenv(_KILLS, str(home / "kills"))
        patch.setenv(_EACH, str(each))
        patch.setattr(supervisor, "RESTART_S", (0.1, 0.1))
        visits = each // 2 + 3
        for i in range(visits):  # each a visit
            register_many(recordings(i * EACH, 1))
        while True:
            refresh.refresh(True)
            counts = queue_counts(Video.connection)
            if not sum(c["pending"] + c["reserved"] for c in counts.values()):
                break
            options = Options(once=True, selftest=False, processes=2)
            assert supervisor.Supervisor(options, target=killed).run() == 0
        errors = {t: c["error"] for t, c in counts.items() if c["error"]}
        found, wrong = orphans(young_s=0.0), bool(errors)
        for table in computed_tables():
            if table.__name__ not in tables_chain.ON_REQUEST or len(table()):
                names = [f.name.split(".")[1] for f in (home / "kills").glob(f"{table.__name__}.*")]
                by = ", ".join(f"{names.count(m)} {m}" for m in _MOMENTS)
                click.echo(f"{table.__name__:16} {len(names):3} kills ({by}): {len(table())} of {visits} rows")
                wrong |= len(table()) != visits or len(names) < each
        click.echo(f"error rows {errors}; {found.n_files} files, without a row {found.orphans}, lost {found.lost}")
        if wrong or found.orphans or found.lost:
            raise SystemExit(1)


if __name__ == "__main__":
    main()
