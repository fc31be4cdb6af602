"""Workers, supervisors, the database and the disks fail at random while recordings come in: results and remains.

    python -m research.benchmarks.chaos --minutes 20 --seed 1             # as root, who may mount two small disks
    python -m research.benchmarks.chaos --minutes 10 --database mysql     # on Debian's MySQL (tests/mysql.py)
    python -m research.benchmarks.chaos --minutes 30 --people             # phones, decisions, forget, backups, cron

Faults, one every few seconds: kill -9 of working processes, of those that they are forked from, of supervisors, and of
the database inside an insert, before or after its statement; pauses of processes for longer than it takes until they
count as dead, and of the database; a full disk of the store and of the database. The supervisors act as separate
machines, so that a paused process loses its job to another. Heavy stages give recorded results. The last lines compare
what `pbl status` says with the results, and count the remains; exit status 1 where anything is wrong.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import platform
import random
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import click
import pytest

from pbl_workers.process import Options
from research.benchmarks import worker_standins, workers
from tests import database, mysql
from tests.integration import chain

#: Variables of the processes: which machine they pass for, and the folder in which those inside an insert have a file.
HOST, INSERTS = "PBL_BENCH_HOST", "PBL_BENCH_INSERTS"
#: Seconds until a process without a heartbeat counts as dead here, and the longest pause of one.
DEAD_S, PAUSE_S = 8.0, 20.0
#: Sizes of the two disks (MiB): of what is recorded while it runs, and room.
DISKS = {"db": lambda minutes: 600 + 20 * minutes, "store": lambda minutes: 40 + 40 * minutes}
#: After so long `pbl status` has to be right (s), and everything is to be done (s).
STATUS_S, DRAIN_S = 120.0, 900.0


def main_of_boss(number: int) -> None:
    """A supervisor of one process, on a separate machine."""
    from pbl_workers.supervisor import Supervisor

    os.environ[HOST] = f"machine-{number}"
    _pass_for_a_machine()
    import pbl_schemas

    pbl_schemas.activate(methods=False)  # without a database it ends, and is started again
    raise SystemExit(Supervisor(Options(resource="cpu", selftest=False, grace_s=5.0), target=work).run())


def work(options: Options, pipe: Connection) -> None:
    """A working process whose inserts can be seen from outside and take some time."""
    import pbl_schemas
    from pbl_schemas import computed_tables

    _pass_for_a_machine()
    activate = pbl_schemas.activate
    pbl_schemas.activate = lambda: activate(methods=False)  # they are there
    draw, inserts = random.Random(os.getpid()), Path(os.environ[INSERTS])

    def seen(real: Any) -> Any:
        def make_insert(self: Any, *args: Any) -> None:
            mark = inserts / str(os.getpid())
            mark.touch()
            try:
                time.sleep(draw.uniform(0, 0.1))
                real(self, *args)
                time.sleep(draw.uniform(0, 0.1))
            finally:
                mark.unlink(missing_ok=True)

        return make_insert

    for table in computed_tables():
        table.make_insert = seen(table.make_insert)
    worker_standins.work(options, pipe)


def _pass_for_a_machine() -> None:
    from pbl_workers import recover

    name = os.environ[HOST]
    platform.node = lambda: name
    recover.DEAD_AFTER_S = DEAD_S


# --------------------------------------------------------------------------------------------------------------- faults
@dataclasses.dataclass
class Site:
    """An installation on two small disks, its supervisors, and what was done to it."""

    home: Path
    draw: random.Random
    mysql: mysql.Server | None = None  # the database, where it is not the embedded one
    bosses: list[Any] = dataclasses.field(default_factory=list)
    done: Counter[str] = dataclasses.field(default_factory=Counter)

    @property
    def server(self) -> int:
        """Process number of the database."""
        from pbl_schemas.operations import embedded

        if self.mysql is not None:
            return self.mysql.pid
        return int(embedded.Folder(self.home / "db").state()["pid"])

    def start_server(self) -> None:
        """Start the database where it does not run, as systemd would."""
        from pbl_schemas.operations import embedded

        if self.mysql is not None:
            self.mysql.start()
        else:
            embedded.start(folder=embedded.Folder(self.home / "db"))

    def keep_bosses(self, n: int) -> None:
        """Start the supervisors that are missing, as systemd would."""
        context = multiprocessing.get_context("spawn")
        alive = {int(b.name): b for b in self.bosses if b.is_alive()}
        for i in range(n):
            if i not in alive:
                alive[i] = context.Process(target=main_of_boss, args=(i,), name=str(i))
                alive[i].start()
        self.bosses = [alive[i] for i in range(n)]

    def end_bosses(self) -> None:
        for boss in self.bosses:
            boss.terminate()
        for boss in self.bosses:
            boss.join(60)

    def children(self) -> list[int]:
        """The working processes."""
        return [child for one in self.forked_from() for child in _children(one)]

    def forked_from(self) -> list[int]:
        """The process under each supervisor that its working process is forked from."""
        return [child for b in self.bosses for child in _children(b.pid)]

    def kill_forked_from(self) -> None:
        if pids := self.forked_from():
            os.kill(self.draw.choice(pids), signal.SIGKILL)
            self.done["process that others are forked from killed"] += 1

    def kill_worker(self) -> None:
        if pids := self.children():
            os.kill(self.draw.choice(pids), signal.SIGKILL)
            self.done["working process killed"] += 1

    def kill_supervisor(self) -> None:
        self.draw.choice(self.bosses).kill()
        self.done["supervisor killed"] += 1

    def pause_worker(self) -> None:
        """Pause a worker in the background: meanwhile others take its job."""
        if pids := self.children():
            seconds = self.draw.uniform(2.0, PAUSE_S)
            self.done["working process paused" + (", taken for dead" if seconds > DEAD_S else "")] += 1
            pid = self.draw.choice(pids)
            os.kill(pid, signal.SIGSTOP)
            subprocess.Popen(["sh", "-c", f"sleep {seconds}; kill -CONT {pid}"])

    def pause_server(self) -> None:
        os.kill(self.server, signal.SIGSTOP)
        time.sleep(self.draw.uniform(1.0, 8.0))
        os.kill(self.server, signal.SIGCONT)
        self.done["database paused"] += 1

    def kill_server(self) -> None:
        """Inside an insert, where one begins within some seconds."""
        inside = self.wait_for_insert()
        if self.mysql is not None:
            self.mysql.kill()
        else:
            os.kill(self.server, signal.SIGKILL)
        self.done["database killed" + (" inside an insert" if inside else "")] += 1
        time.sleep(self.draw.uniform(0.2, 3.0))
        self.start_server()

    def wait_for_insert(self) -> bool:
        """Wait for a moment inside an insert; False where none began within some seconds."""
        inserts, until = Path(os.environ[INSERTS]), time.monotonic() + 10.0
        while not (inside := any(inserts.iterdir())) and time.monotonic() < until:
            time.sleep(0.002)
        time.sleep(self.draw.uniform(0, 0.05))
        return inside

    def fill(self, disk: str, left: int = 0, longest_s: float = 8.0) -> None:
        """No byte, or so many, are left on a disk for some seconds."""
        ballast = self.home / disk / "ballast"
        with ballast.open("wb") as file:
            size, chunk = 0, 64 << 20
            while chunk >= 4096:
                try:
                    os.posix_fallocate(file.fileno(), size, chunk)
                    size += chunk
                except OSError:
                    chunk //= 2
            file.truncate(max(0, size - left))
        time.sleep(self.draw.uniform(longest_s / 4, longest_s))
        ballast.unlink()
        self.done[f"disk of the {disk} full"] += 1


def _children(pid: int) -> list[int]:
    """The process under a supervisor that others are forked from, or those that are forked from it."""
    found = []
    with contextlib.suppress(OSError):
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            if b"forkserver" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
    return found


def _faults(site: Site, can_fill: bool) -> list[tuple[float, Any]]:
    full = 1.0 if can_fill else 0.0
    return [
        (4.0, site.kill_worker),
        (0.5, site.kill_forked_from),
        (1.0, site.kill_supervisor),
        (2.0, site.pause_worker),
        (0.5, site.pause_server),
        (1.0, site.kill_server),
        (full, lambda: site.fill("store")),
        (full, lambda: site.fill("db")),
    ]


# ------------------------------------------------------------------------------------------------------------------ run
@click.command()
@click.option("--minutes", default=20.0, show_default=True)
@click.option("--seed", default=0, show_default=True)
@click.option("--supervisors", default=3, show_default=True)
@click.option("--database", "kind", type=click.Choice(["embedded", "mysql"]), default="embedded", show_default=True)
@click.option("--people", "with_people", is_flag=True, help="Also phones, decisions, `pbl forget`, backups and cron.")
def main(minutes: float, seed: int, supervisors: int, kind: str, with_people: bool) -> None:
    """Let things fail for some minutes, then count."""
    home = database.new_home()
    sizes = {name: size(minutes) for name, size in DISKS.items()}
    with disks(home, sizes) as can_fill, pytest.MonkeyPatch.context() as patch:
        database.leave_nothing_of_the_developer(patch)
        (home / "inserts").mkdir()
        patch.setenv("PBL_HOME", str(home))
        patch.setenv("PBL_STORE", str(home / "store"))
        patch.setenv(INSERTS, str(home / "inserts"))
        patch.setenv(HOST, "the machine of cron")
        patch.setenv(worker_standins.RECORDED, str(chain.small_video(home, "recorded")))
        patch.setenv(worker_standins.SLEEP, "0.1")
        _pass_for_a_machine()
        site, people = Site(home, random.Random(seed)), None
        if with_people:
            from research.benchmarks import chaos_people, phone_sends

            site = phone_sends.Site(home, site.draw)
            people = chaos_people.People(site)
            for name, variable in (("tmp", "TMPDIR"), ("backup", "PBL_BACKUP")):
                (home / name).mkdir()
                patch.setenv(variable, str(home / name))
            (home / "tmp").chmod(0o1777)
        if kind == "mysql":
            site.mysql = mysql.start(home / "db")
            for name, value in site.mysql.environment.items():
                patch.setenv(name, value)
        try:
            wrong = _run(site, minutes, supervisors, can_fill, people)
        finally:
            site.end_bosses()
            from pbl_schemas.operations import embedded

            if site.mysql is not None:
                site.mysql.stop()
            embedded.stop(folder=embedded.Folder(home / "db"))
    shutil.rmtree(home, ignore_errors=True)
    for line in wrong:
        click.echo(f"WRONG: {line}")
    raise SystemExit(1 if wrong else 0)


@contextlib.contextmanager
def disks(home: Path, sizes: Mapping[str, float]) -> Iterator[bool]:
    """Mount small disks (MiB by name) in a folder; whether that was allowed."""
    mounted: list[Path] = []
    try:
        for name, size in sizes.items():
            (home / name).mkdir()
            command = ["mount", "-t", "tmpfs", "-o", f"size={size:.0f}m,mode=755", "none", str(home / name)]
            if subprocess.run(command, check=False, capture_output=True).returncode == 0:
                mounted.append(home / name)
        yield len(mounted) == len(sizes)
    finally:
        for disk in mounted:
            subprocess.run(["umount", "--lazy", str(disk)], check=False)


def _run(site: Site, minutes: float, supervisors: int, can_fill: bool, people: Any | None) -> list[str]:
    """people: `chaos_people.People`."""
    from pbl_schemas.operations.declare import declare_all

    site.start_server()
    declare_all()
    registered = _register(0)
    until, weights = time.monotonic() + 60 * minutes, _faults(site, can_fill)
    if people is not None:
        weights += people.faults()
        people.registered = registered
        people.start()
    refreshed = 0.0
    while time.monotonic() < until:
        site.keep_bosses(supervisors)
        time.sleep(site.draw.uniform(0.5, 4.0))
        site.draw.choices([f for _, f in weights], [w for w, _ in weights])[0]()
        with contextlib.suppress(Exception):  # as a person and cron would: again later
            site.start_server()
            if time.monotonic() - refreshed > 5.0:
                _cron()
                refreshed = time.monotonic()
            if _waiting() < 30:
                registered = _register(registered)
                if people is not None:
                    people.registered = registered
    click.echo(f"{minutes:g} minutes: " + ", ".join(f"{n} {what}" for what, n in sorted(site.done.items())))
    if people is not None:
        people.stop()
        people.finish()
    ended = time.monotonic()
    wrong = _status(site, supervisors, ended + STATUS_S)
    wrong += _drain(site, supervisors, ended + DRAIN_S)
    click.echo(f"all done {time.monotonic() - ended:.0f} s after the last fault; {registered} recordings")
    site.end_bosses()
    return wrong + _left(registered, people) + (people.left() if people is not None else [])


def _register(first: int) -> int:
    from research.benchmarks.many_recordings import register_many

    register_many(workers.recordings(first, 10 * workers.EACH))
    return first + 10 * workers.EACH


def _waiting() -> int:
    from pbl_schemas import video

    return len(video.VideoInfo.jobs.pending)


def _cron() -> None:
    from pbl_schemas import connection
    from pbl_workers import refresh

    connection.connect()
    refresh.refresh(True)


def _status(site: Site, supervisors: int, until: float) -> list[str]:
    """Wait until what `pbl status` says is so: no dead worker, no job in dead hands, the rows that are there."""
    from pbl_schemas import computed_tables
    from pbl_schemas.reading import status

    wrong, last, began = ["it was not asked"], list[str](), time.monotonic()
    while wrong and time.monotonic() < until:
        time.sleep(2.0)
        site.keep_bosses(supervisors)
        _cron()
        alive = set(site.children())
        rows = {t.__name__: len(t()) for t in computed_tables()}
        state = status.pipeline_status()
        listed = [int(w["worker_pid"]) for w in state.workers]
        wrong = [f"pbl status lists process {pid}, which is dead" for pid in listed if pid not in alive]
        wrong += [f"pbl status does not list process {pid}" for pid in alive if pid not in listed]
        for table in computed_tables():
            held = {int(pid) for pid in table.jobs.reserved.to_arrays("pid")}
            wrong += [f"{table.__name__} is held by process {pid}, which is dead" for pid in held - alive]
        said = {t.table: t.done for t in state.tables}
        wrong += [f"{n} rows of {t}, pbl status: {said[t]}" for t, n in rows.items() if said[t] < n]
        last = wrong or last
    if not wrong:
        click.echo(
            f"pbl status true after {time.monotonic() - began:.0f} s; before: {'; '.join(last) or 'nothing wrong'}"
        )
    return wrong


def _drain(site: Site, supervisors: int, until: float) -> list[str]:
    """Let everything be done, with what `pbl cron` does every night."""
    from pbl_schemas.reading.status import queue_counts
    from pbl_schemas.video import Video
    from pbl_workers import requeue

    busy = {}
    while time.monotonic() < until:
        site.keep_bosses(supervisors)
        _cron()
        again = requeue.retry("WORKER_CRASH")
        if again:
            click.echo(f"killed three times at the same job, tried again as `pbl cron reprocess` does: {again}")
        counts = queue_counts(Video.connection)
        busy = {t: c for t, c in counts.items() if t != "SessionFit" and c["pending"] + c["reserved"]}
        if not busy and not again:
            return [f"{t}: {c['error']} error rows" for t, c in counts.items() if c["error"]]
        time.sleep(2.0)
    return [f"not done after {DRAIN_S:g} s: {busy}"]


def _left(registered: int, people: Any | None) -> list[str]:
    """Return the faults: missing results, jobs and files that were left behind."""
    from pbl_schemas import computed_tables, connection, fit
    from pbl_schemas.operations.orphans import WRITING, orphans, remove
    from pbl_schemas.video import Video

    connection.connect()
    wrong = []
    if people is not None:  # of phones: `people.left`
        numbered = len(Video & "video_path LIKE '/recordings/%%'")
        if numbered != (expected := registered - workers.EACH * len(people.forgotten)):
            wrong.append(f"{numbered} of {expected} recordings")
        registered = len(Video())
    before_fit = computed_tables()[: computed_tables().index(fit.SessionFit)]
    for table in before_fit:
        if len(table()) != registered:
            wrong.append(f"{len(table())} rows of {table.__name__} for {registered} recordings")
        if n := len(table.jobs):
            wrong.append(f"{n} job rows of {table.__name__}")
    found = orphans(young_s=0.0)
    if people is not None:  # what the page was writing when it was killed goes by `pbl cron disk`
        remove(found, 0.0, WRITING)
        found = orphans(young_s=0.0)
    click.echo(f"{found.n_files} files in the store, {len(found.orphans)} without a row, {len(found.lost)} lost")
    wrong += [f"file without a row: {f.path} ({f.age_s:.0f} s old)" for f in found.orphans]
    return wrong + [f"lost: {path}" for path in found.lost]


if __name__ == "__main__":
    main()
