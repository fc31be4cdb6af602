"""State of the tables: counts, errors with their next step, videos that wait for a choice."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import queue
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from .. import computed_tables, connection, keypoints, tracking, video, worker
from ..decisions import not_usable
from ..job_errors import error_code, stored_error
from ..jobs import jobs_of
from ..operations.archive import archive_dir, disks, unfinished
from ..operations.catalog import quote
from ..rows import grouped, rows_inside

#: With fewer videos than this, keys that are not queued yet are also counted.
SMALL = 5000
#: Age of a heartbeat (s) after which its worker counts as lost.
LOST_S = 180.0

#: Columns that mean "ran well, nothing to produce": table -> (status, values, column of the reason or None).
EMPTY_COLUMNS: dict[str, tuple[str, tuple[str, ...], str | None]] = {
    "SubjectChoice": ("choice_status", ("NO_PERSON",), "choice_reason"),
    "GaitEvents": ("events_status", ("EMPTY",), "events_reason"),
    "Spatiotemporal": ("measures_status", ("EMPTY",), "measures_reason"),
    "GDI": ("gdi_status", ("EMPTY",), None),
    "SessionGdi": ("session_status", ("EMPTY",), None),
    "Kinetics": ("forces_status", ("EMPTY",), "forces_reason"),
    "Deidentified": ("deidentified_status", ("NO_HEAD",), "deidentified_reason"),
}


@dataclasses.dataclass(frozen=True)
class TableStatus:
    """One computed table. pending: keys without a result, a reservation or an error; empty is part of done.

    oldest_s: age of the oldest queued job. per_hour: done in the last hour. left_s: pending at that rate. delayed: why
    jobs that were put back wait, such as a full store.
    """

    table: str
    done: int
    empty: int
    pending: int
    reserved: int
    error: int
    waiting: int
    oldest_s: float | None = None
    per_hour: float = 0.0
    left_s: float | None = None
    delayed: str = ""


@dataclasses.dataclass(frozen=True)
class ErrorRow:
    """One error row. `about`: file name where the key has a video."""

    table: str
    key: dict[str, Any]
    about: str
    code: str
    found: str
    next_step: str
    stack: str


@dataclasses.dataclass(frozen=True)
class Running:
    """A job in a worker's hands. since: by the server's clock."""

    table: str
    key: dict[str, Any]
    about: str
    host: str
    pid: int
    since: datetime.datetime | None


@dataclasses.dataclass(frozen=True)
class EmptyRow:
    """A video for which a stage ended without an error and without a result."""

    table: str
    video_id: int
    about: str
    reason: str


@dataclasses.dataclass(frozen=True)
class Waiting:
    """A video whose person has to be chosen. next_step: the command that chooses; look: the command that writes a
    picture of the numbered people."""

    video_id: int
    about: str
    reason: str
    persons: list[int]
    next_step: str
    look: str


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """A video that is marked as not usable."""

    video_id: int
    about: str
    reason: str
    by: str


@dataclasses.dataclass(frozen=True)
class Cron:
    """The regular work `pbl cron NAME`. Ages (s) by the server's clock: of its last sign of life and of the last pass
    that succeeded, None: none yet. failed: code or exit status of the last pass if it did not succeed."""

    name: str
    seen_s: float
    good_s: float | None
    failed: str

    def text(self) -> str:
        """State for people."""
        good = "never succeeded" if self.good_s is None else f"succeeded {span(self.good_s)} ago"
        return f"{good}; failed {span(self.seen_s)} ago ({self.failed}, see its log)" if self.failed else good


@dataclasses.dataclass(frozen=True)
class Machine:
    """A machine with live workers. gpus: its GPUs, as `resources.gpu_use` has them, None: not known. resting: of each
    worker, which of its processes wait after they died."""

    host: str
    gpus: list[dict[str, Any]] | None = None
    resting: list[str] = dataclasses.field(default_factory=list)

    def rows(self) -> list[tuple[str, str]]:
        """For people: what it is about, and its state."""
        out = [(f"worker {self.host}", text) for text in self.resting]
        if self.gpus is None:
            return [*out, (f"GPUs of {self.host}", "unknown")]
        for gpu in self.gpus:
            use = [f"{gpu['busy']:.0%} busy"] if "busy" in gpu else []
            if {"used", "size"} <= gpu.keys():
                use.append(f"{gpu['used'] / 1e9:.1f} of {gpu['size'] / 1e9:.1f} GB used")
            out.append((f"GPU {gpu['gpu']} of {self.host}", ", ".join(use) or "unknown"))
        return out


@dataclasses.dataclass(frozen=True)
class Status:
    """The whole state."""

    videos: int
    tables: list[TableStatus]
    errors: list[ErrorRow]
    empty: list[EmptyRow]
    waiting: list[Waiting]
    workers: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    exact: bool = True
    #: Source of the focal length (file, measured, metadata, preset, guess) -> number of keypoints with it.
    cameras: dict[str, int] = dataclasses.field(default_factory=dict)
    not_usable: list[LeftOut] = dataclasses.field(default_factory=list)
    workers_lost: int = 0
    cron: list[Cron] = dataclasses.field(default_factory=list)
    #: Name, free and total GB of each disk of this machine.
    disks: list[tuple[str, float, float]] = dataclasses.field(default_factory=list)
    #: Ages (s) and lengths (byte) of what lies in the archive of this machine without being registered.
    unfinished: list[tuple[float, int]] = dataclasses.field(default_factory=list)
    machines: list[Machine] = dataclasses.field(default_factory=list)


def pipeline_status(exact: bool | None = None, most: int = 200) -> Status:
    """Query the state of all computed tables. `pbl_schemas.activate()` must have been called.

    `exact`: also count keys that no worker has queued yet; that compares whole tables (seconds each with 300,000
    videos). None: where there are fewer than `SMALL` videos. `most`: errors, empty, waiting and not usable rows that
    are listed, each; the counts are of all.
    """
    n_videos = int(video.Video.connection.query(f"SELECT COUNT(*) FROM {video.Video.full_table_name}").fetchone()[0])  # noqa: S608
    exact = n_videos < SMALL if exact is None else exact
    server = video.Video.connection
    queues, rates, chain = queue_counts(server), throughput(server), computed_tables()
    # The longest first: the sources of cameras are long texts, keys grow along the chain.
    counts = [camera_kinds, *(functools.partial(_rows, t) for t in reversed(chain))]
    cameras, *rows = [c(server) for c in counts] if n_videos < SMALL else _side_by_side(counts)
    rows.reverse()
    states = zip(chain, rows, strict=True)
    tables = [_table_status(t, n, queues[t.__name__], rates, exact) for t, n in states]
    errors = [e for t, s in zip(chain, tables, strict=True) if s.error for e in _errors(t, most)]
    empty = {t.table for t in tables if t.empty}
    waiting = _waiting(most) if any(t.waiting for t in tables) else []
    marks = not_usable.all_unusable(most)
    names = _names(m.video_id for m in marks)
    marked = [LeftOut(m.video_id, names.get(m.video_id, ""), m.text, m.by) for m in marks]
    return Status(
        n_videos,
        tables,
        errors,
        _empty(empty, most),
        waiting,
        live_workers(),
        exact,
        cameras,
        marked,
        worker_counts(server)[1],
        cron_passes(server),
        disks(),
        [(time.time() - one.last_s, one.n_bytes) for one in unfinished(archive_dir())],
        machines(),
    )


def _table_status(
    table: Any, rows: tuple[int, int, int], counts: dict[str, int], rates: dict[str, float], exact: bool
) -> TableStatus:
    name, pending = table.__name__, counts["pending"]
    if exact:
        remaining, _ = table().progress()
        pending = max(0, remaining - counts["reserved"] - counts["error"] - counts["ignore"])
    done, empty, waiting = rows
    oldest, reason = _oldest(table) if counts["pending"] else (None, "")
    per_hour = rates.get(name, 0.0)
    left = 3600.0 * pending / per_hour if per_hour and pending else None
    return TableStatus(
        name, done, empty, pending, counts["reserved"], counts["error"], waiting, oldest, per_hour, left, reason
    )


def _side_by_side(questions: Sequence[Callable[[Any], Any]], at_once: int = 4) -> list[Any]:
    """Return the answers of functions of a connection, in their order, `at_once` at a time on separate connections."""
    free: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def ask(question: Callable[[Any], Any]) -> Any:
        server = free.get()
        try:
            return question(server)
        finally:
            free.put(server)

    with contextlib.ExitStack() as stack:
        for _ in range(at_once):
            free.put(stack.enter_context(contextlib.closing(connection.another())))
        pool = stack.enter_context(ThreadPoolExecutor(at_once))
        return list(pool.map(ask, questions))


def camera_kinds(server: Any) -> dict[str, int]:
    """Return the sources of the intrinsics of the keypoints, with how many each has."""
    table = keypoints.Keypoints.full_table_name
    rows = server.query(
        f"SELECT camera_kind, COUNT(*) FROM {table} GROUP BY camera_kind ORDER BY COUNT(*) DESC, camera_kind"  # noqa: S608
    ).fetchall()
    return {str(kind): int(n) for kind, n in rows}


def queue_name(table: Any) -> tuple[str, str]:
    """Return schema and name of a computed table's queue. The object of the queue (`jobs_of`) would read all foreign
    keys of the server, which takes longer than counting its rows."""
    return str(table.database), "~~" + str(table.table_name).lstrip("_")


def queues(server: Any) -> set[tuple[str, str]]:
    """Return schema and name of every queue that the server has."""
    rows = server.query("SELECT table_schema, table_name FROM information_schema.tables WHERE table_name LIKE '~~%%'")
    return {(str(schema), str(name)) for schema, name in rows.fetchall()}


def queue_counts(server: Any) -> dict[str, dict[str, int]]:
    """Return the numbers of job rows of each computed table by status. Only `server` is queried, so that a thread can
    use its own connection."""
    there, out = queues(server), {}
    for table in computed_tables():
        out[table.__name__] = dict.fromkeys(("pending", "reserved", "error", "ignore"), 0)
        if queue_name(table) in there:
            found = server.query(f"SELECT status, COUNT(*) FROM {quote(*queue_name(table))} GROUP BY status")  # noqa: S608
            out[table.__name__] |= {str(status): int(n) for status, n in found.fetchall()}
    return out


def throughput(server: Any, minutes: int = 60) -> dict[str, float]:
    """Return the jobs an hour of each table over the last `minutes`, from the first finished one."""
    table = worker.Throughput.full_table_name
    rows = server.query(
        f"SELECT stage, SUM(n_done), TIMESTAMPDIFF(SECOND, MIN(minute), CURRENT_TIMESTAMP) FROM {table}"  # noqa: S608
        " WHERE minute >= CURRENT_TIMESTAMP - INTERVAL %s MINUTE GROUP BY stage",
        args=(int(minutes),),
    ).fetchall()
    return {str(stage): 3600.0 * float(n) / max(float(seconds), 60.0) for stage, n, seconds in rows}


#: Condition on rows of `Worker`: their heartbeat is recent.
_ALIVE = "worker_stopped IS NULL AND worker_seen > CURRENT_TIMESTAMP(3) - INTERVAL 60 SECOND"
#: And: they take jobs.
_TAKES_JOBS = f"worker_resource NOT IN ('{worker.CRON}', '{worker.SUPERVISOR}')"


def live_workers() -> list[dict[str, Any]]:
    """Return the workers with a recent heartbeat: host, process, resource, current job."""
    names = ("worker_host", "worker_pid", "worker_resource", "worker_doing")
    alive = worker.Worker & _ALIVE & _TAKES_JOBS
    return [{n: r[n] for n in names} for r in alive.to_dicts(order_by="worker_host, worker_pid")]


def machines() -> list[Machine]:
    """Return the machines on which workers live, by name."""
    out: dict[str, Machine] = {}
    alive = worker.Worker & _ALIVE & f"worker_resource != '{worker.CRON}'"
    for row in alive.to_dicts(order_by="worker_host, worker_seen"):
        host, of_supervisor = str(row["worker_host"]), row["worker_resource"] == worker.SUPERVISOR
        known = out.get(host, Machine(host))
        resting = [*known.resting, row["worker_doing"]] if of_supervisor and row["worker_doing"] else known.resting
        out[host] = Machine(host, known.gpus if row["worker_gpus"] is None else row["worker_gpus"], resting)
    return list(out.values())


def worker_counts(server: Any) -> tuple[int, int]:
    """Return the numbers of workers that live, and of those whose heartbeat ended within the last hour without that
    they did in order."""
    silent = f"TIMESTAMPDIFF(SECOND, worker_seen, CURRENT_TIMESTAMP) FROM {worker.Worker.full_table_name}"
    rows = server.query(f"SELECT {silent} WHERE worker_stopped IS NULL AND {_TAKES_JOBS}")
    ages = [float(age) for (age,) in rows.fetchall()]
    return sum(age < LOST_S for age in ages), sum(LOST_S <= age < 3600.0 for age in ages)


def cron_passes(server: Any) -> list[Cron]:
    """Return the state of each kind of regular work that ran."""
    age = "TIMESTAMPDIFF(SECOND, {}, CURRENT_TIMESTAMP)".format
    rows = server.query(
        f"SELECT worker, {age('worker_seen')}, {age('worker_stopped')}, worker_doing"  # noqa: S608
        f" FROM {worker.Worker.full_table_name} WHERE worker_resource = %s ORDER BY worker",
        args=(worker.CRON,),
    ).fetchall()
    return [
        Cron(str(name).removeprefix("cron "), float(seen), None if good is None else float(good), str(failed))
        for name, seen, good, failed in rows
    ]


def oldest_jobs(server: Any, counts: dict[str, dict[str, int]]) -> dict[str, float]:
    """Return the age (s) of the oldest pending job of each table that has one. `counts`: as of `queue_counts`."""
    waiting = [t for t in computed_tables() if counts[t.__name__]["pending"]]
    return {t.__name__: age for t in waiting if (age := _age(t, server)) is not None}


def error_counts(server: Any, counts: dict[str, dict[str, int]]) -> dict[tuple[str, str], int]:
    """Return how many jobs of a table are in error with a code, by the two. `counts`: as of `queue_counts`."""
    out: dict[tuple[str, str], int] = {}
    for table in (t for t in computed_tables() if counts[t.__name__]["error"]):
        found = "SUBSTRING_INDEX(error_message, ':', 2)"
        rows = server.query(
            f"SELECT {found}, COUNT(*) FROM {quote(*queue_name(table))} WHERE status='error' GROUP BY {found}"  # noqa: S608
        )
        for message, n in rows.fetchall():
            name = (table.__name__, error_code(str(message)))
            out[name] = out.get(name, 0) + int(n)
    return out


def running(most: int = 200) -> list[Running]:
    """Return the running jobs, oldest first; at most so many of each table."""
    out = []
    for table, counts in zip(computed_tables(), queue_counts(video.Video.connection).values(), strict=True):
        if counts["reserved"]:
            jobs = jobs_of(table)
            for key, about, row in _keyed(jobs, jobs.reserved.to_dicts(order_by="reserved_time", limit=most)):
                since = row["reserved_time"]
                out.append(Running(table.__name__, key, about, str(row["host"]), int(row["pid"]), since))
    return sorted(out, key=lambda r: (r.since is None, r.since))


def span(seconds: float | None) -> str:
    """Return a duration in a suitable unit: 45 s, 12 min, 3.5 h, 2.1 d."""
    if seconds is None:
        return "-"
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length:
            value = seconds / length
            return f"{value:.1f} {unit}" if value < 10 and unit != "min" else f"{value:.0f} {unit}"
    return f"{seconds:.0f} s"


def _oldest(table: Any) -> tuple[float | None, str]:
    """Return the age (s) of the oldest pending job, and the reason for which jobs were put back."""
    jobs, server = quote(*queue_name(table)), table.connection
    why = server.query(
        f"SELECT error_message FROM {jobs} WHERE status='pending' AND scheduled_time > CURRENT_TIMESTAMP(3)"  # noqa: S608
        " ORDER BY scheduled_time LIMIT 1"
    ).fetchone()
    return _age(table, server), (str(why[0]) if why else "")


def _age(table: Any, server: Any) -> float | None:
    jobs = quote(*queue_name(table))
    age = server.query(
        f"SELECT TIMESTAMPDIFF(SECOND, MIN(created_time), CURRENT_TIMESTAMP) FROM {jobs} WHERE status='pending'"  # noqa: S608
    ).fetchone()[0]
    return None if age is None else float(age)


def _rows(table: Any, server: Any) -> tuple[int, int, int]:
    """Return the numbers of all, empty and waiting rows of a table, from narrow indexes."""
    if table.__name__ not in EMPTY_COLUMNS:
        return int(server.query(f"SELECT COUNT(*) FROM {table.full_table_name}").fetchone()[0]), 0, 0  # noqa: S608
    column, values, _ = EMPTY_COLUMNS[table.__name__]
    rows = server.query(f"SELECT {column}, COUNT(*) FROM {table.full_table_name} GROUP BY {column}").fetchall()  # noqa: S608
    counts = {str(value): int(n) for value, n in rows}
    return sum(counts.values()), sum(counts.get(v, 0) for v in values), counts.get("NEEDS_CHOICE", 0)


def empty_rows(table: Any) -> Any:
    """Return the rows of a computed table that mean "ran well, nothing to produce"."""
    if table.__name__ not in EMPTY_COLUMNS:
        return table & False
    column, values, _ = EMPTY_COLUMNS[table.__name__]
    return table & [{column: v} for v in values]


def _empty(names: Collection[str], most: int) -> list[EmptyRow]:
    out: list[EmptyRow] = []
    for table in computed_tables():
        reason = EMPTY_COLUMNS.get(table.__name__, ("", (), None))[2]
        if reason is None or table.__name__ not in names or "video_id" not in table.primary_key:
            continue
        said = {e.video_id for e in out}  # the first empty table has the reason
        for row in (empty_rows(table) * video.Video.proj("video_name")).to_dicts(order_by="video_id", limit=most):
            if int(row["video_id"]) in said:
                continue
            out.append(EmptyRow(table.__name__, int(row["video_id"]), row["video_name"], row[reason]))
    return out


def _errors(table: Any, most: int) -> list[ErrorRow]:
    out, jobs = [], jobs_of(table)
    for key, about, row in _keyed(jobs, jobs.errors.to_dicts(limit=most)):
        error = stored_error(row["error_message"])
        said = (error.code, error.found, error.next_step)
        out.append(ErrorRow(table.__name__, key, about, *said, str(row["error_stack"] or "")))
    return out


def _keyed(jobs: Any, rows: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], str, dict[str, Any]]]:
    """Rows of a queue, each behind its key and the name of its video ("": a key without one)."""
    names = _names(row["video_id"] for row in rows if "video_id" in jobs.primary_key)
    return [({k: row[k] for k in jobs.primary_key}, names.get(row.get("video_id"), ""), row) for row in rows]


def _names(videos: Iterable[int]) -> dict[Any, str]:
    """Names of videos by their numbers."""
    rows = rows_inside(video.Video.proj("video_name"), "video_id", map(int, videos))
    return {int(row["video_id"]): str(row["video_name"]) for row in rows}


def _waiting(most: int) -> list[Waiting]:
    found = (tracking.SubjectChoice & {"choice_status": "NEEDS_CHOICE"}) * video.Video.proj("video_name")
    rows = (found - video.NotUsable).to_dicts(order_by="video_id", limit=most)
    numbers = [int(row["video_id"]) for row in rows]
    several = tracking.with_several_methods(numbers)
    people = rows_inside(tracking.Tracking.Person.proj(), "video_id", numbers)
    seen = grouped(((int(r["video_id"]), r["tracking_method"]), int(r["person_id"])) for r in people)
    out = []
    for row in rows:
        key = {k: row[k] for k in ("video_id", "tracking_method")}
        persons = sorted(seen.get((int(row["video_id"]), row["tracking_method"]), []))
        choose = tracking.choose_command(key, "|".join(map(str, persons)), several)
        look = f"pbl choose {row['video_id']} --sheet persons_{row['video_id']}.jpg"
        out.append(Waiting(int(row["video_id"]), row["video_name"], row["choice_reason"], persons, choose, look))
    return out
