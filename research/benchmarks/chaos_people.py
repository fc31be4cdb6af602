"""Work of people, beside the faults of `chaos`: phones that send, decisions, persons forgotten, backups and `pbl cron`.

Each is what a clinic does: commands of `pbl` in processes of their own, the page of `pbl web` for phones (as
`phone_sends` runs it), decisions by a process that is killed as well.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

import click

from research.benchmarks import phone_sends, workers
from tests.command import PBL
from tests.database import new_home, remove_home

#: Recordings of a phone, and phones that send one after the other.
TAKES, PHONES = 20, 40
#: Seconds between commands, and how long one may take.
EVERY_S, AT_MOST_S = (1.0, 6.0), 600.0
#: Commands, and how often one is drawn.
COMMANDS = {
    ("cron", "refresh"): 2,
    ("cron", "release"): 1,
    ("cron", "reprocess"): 2,
    ("cron", "summary"): 1,
    ("cron", "disk", "--least-free", "0"): 1,
    ("cron", "backup", "--keep", "2"): 2,
    ("status",): 1,
    ("forget",): 4,
}
#: What a command says where the database, a disk or a worker was in its way.
USUAL = ("DB_", "STORE_", "FILE_UNWRITABLE", "FORGET_", "BACKUP_", "MACHINE_SHORT", "another process", "DECIDED_")


# ------------------------------------------------------------------------------------------------------------ decisions
def decide(seed: int, start: int) -> None:
    """Mark recordings as not usable, or take that back, and print each decision's number before and after it."""
    import pbl_schemas
    from pbl_pipeline.errors import PblError
    from pbl_schemas import connection, video
    from pbl_schemas.decisions import not_usable
    from pbl_schemas.decisions.review_decisions import mark_not_usable, take_back
    from pbl_schemas.job_errors import of_database

    draw, number, active = random.Random(seed), start, False
    for _ in sys.stdin:
        try:
            if not active:
                pbl_schemas.activate(methods=False)
                active = True
            connection.connect()
            (last,) = connection.connect().query(f"SELECT MAX(video_id) FROM {video.Video.full_table_name}").fetchone()
            one = draw.randint(1, last or 1)
            marked = not_usable.unusable([one])
            sys.stdout.write(f"asked {number} {one}\n")
            sys.stdout.flush()
            if marked:
                take_back(one, f"D{number}")
            else:
                mark_not_usable(one, "other", "of chaos", by=f"D{number}")
            sys.stdout.write(f"done {number} {one}\n")
        except Exception as error:  # noqa: BLE001  told to who counts
            coded = error if isinstance(error, PblError) else of_database(error)
            sys.stdout.write(f"error {number} {coded.code if coded else f'INTERNAL {type(error).__name__}: {error}'}\n")
        number += 1
        sys.stdout.flush()


@dataclasses.dataclass
class People:
    """The work of people and of `cron` at a site, and its results."""

    site: phone_sends.Site
    registered: int = 0  # recordings whose persons may be forgotten
    heard: phone_sends.Heard = dataclasses.field(default_factory=phone_sends.Heard)
    ended: Counter[str] = dataclasses.field(default_factory=Counter)
    wrong: list[str] = dataclasses.field(default_factory=list)
    asked_to_forget: set[str] = dataclasses.field(default_factory=set)
    forgotten: set[str] = dataclasses.field(default_factory=set)
    decided: dict[str, dict[int, int]] = dataclasses.field(default_factory=lambda: defaultdict(dict))  # number -> video
    _stop: threading.Event = dataclasses.field(default_factory=threading.Event)
    _threads: list[threading.Thread] = dataclasses.field(default_factory=list)
    _phones: list[phone_sends.PhoneOf] = dataclasses.field(default_factory=list)
    _command: subprocess.Popen[str] | None = None
    _decider: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Make the phones' links, and begin."""
        from pbl_schemas.intake import phone_recordings
        from tests.rows import new_visit

        with socket.create_server(("127.0.0.1", 0)) as free:
            self.site.port = free.getsockname()[1]
        self.films = phone_sends.Films(phone_sends._film(self.site.home))
        for i in range(PHONES):
            keys = [phone_recordings.make_link(new_visit("2026-01-01", f"P{i:03d}"), "B", 24)[1] for _ in range(4)]
            takes = list(range(i * TAKES, (i + 1) * TAKES))
            seed = self.site.draw.randrange(2**31)
            self._phones.append(phone_sends.PhoneOf(self.site.port, keys, takes, self.films, self.heard, seed))
        draw = random.Random(self.site.draw.randrange(2**31))
        for work in (lambda: self._commands(random.Random(draw.random())), self._decide, self._send):
            self._threads.append(threading.Thread(target=self._noted, args=[work], daemon=True))
            self._threads[-1].start()

    def _noted(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            self.wrong.append(f"people: {type(error).__name__}: {error}")
            raise

    def faults(self) -> list[tuple[float, Any]]:
        """Faults beside those of `chaos`."""
        return [(1.0, self.site.kill_page), (1.0, self.kill_command), (0.5, self.kill_decider)]

    def kill_command(self) -> None:
        if (command := self._command) is not None and command.poll() is None:
            command.kill()
            self.site.done["command killed"] += 1

    def kill_decider(self) -> None:
        if (decider := self._decider) is not None and decider.poll() is None:
            decider.kill()
            self.site.done["decision killed"] += 1

    # ---------------------------------------------------------------------------------------------------- what they do
    def _commands(self, draw: random.Random) -> None:
        while not self._stop.wait(draw.uniform(*EVERY_S)):
            (command,) = draw.choices([*COMMANDS], [*COMMANDS.values()])
            if command == ("forget",):
                persons = self.registered // workers.EACH
                if persons > 2:
                    self.forget(f"S{draw.randrange(persons - 1):07d}")
            else:
                self.run(*command)

    def run(self, *arguments: str) -> int:
        """Run a command of `pbl`; an exit that it does not explain is wrong."""
        with (self.site.home / "commands.log").open("a") as log:
            own: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
            self._command = subprocess.Popen([*PBL, "--quiet", *arguments], **own)
            try:
                said, _ = self._command.communicate(timeout=AT_MOST_S)
            except subprocess.TimeoutExpired:
                self._command.kill()
                said, _ = self._command.communicate()
                self.wrong.append(f"pbl {' '.join(arguments)} did not end within {AT_MOST_S:.0f} s")
            code = self._command.returncode
            log.write(f"pbl {' '.join(arguments)}: {code}\n{said}\n")
        killed = code == -signal.SIGKILL
        self.ended[f"pbl {' '.join(arguments[:2])}: {'killed' if killed else code}".replace(arguments[-1], "...")] += 1
        if "INTERNAL" in said or "Traceback" in said:
            self.wrong.append(f"pbl {' '.join(arguments)}: {said[-1500:]}")
        elif code not in (0, -signal.SIGKILL) and not any(usual in said for usual in USUAL):
            self.wrong.append(f"pbl {' '.join(arguments)} ended with {code}: {said[-600:]}")
        return code

    def forget(self, subject: str) -> int:
        self.asked_to_forget.add(subject)
        if (code := self.run("forget", "--yes", subject)) == 0:
            self.forgotten.add(subject)
        return code

    def _decide(self) -> None:
        number = 0
        while not self._stop.wait(0.5):
            if self._decider is None or self._decider.poll() is not None:
                code = f"from research.benchmarks.chaos_people import decide; decide({number}, {number})"
                own = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
                self._decider = subprocess.Popen([sys.executable, "-c", code], **own)
            assert self._decider.stdin
            assert self._decider.stdout
            with contextlib.suppress(BrokenPipeError):
                self._decider.stdin.write("\n")
                self._decider.stdin.flush()
            number += 1
            while line := self._decider.stdout.readline():
                if not line.startswith(("asked ", "done ", "error ")):
                    continue  # DataJoint prints its warnings there
                what, of, rest = line.rstrip("\n").split(" ", 2)
                if what == "error":
                    self.ended[f"decision: {rest.split()[0]}"] += 1
                    if rest.startswith("INTERNAL"):
                        self.wrong.append(f"decision {of}: {rest}")
                    break
                self.decided[what][int(of)] = int(rest)
                if what == "done":
                    self.ended["decision: made"] += 1
                    break
        if self._decider is not None:
            self._decider.kill()
            self._decider.wait()

    def _send(self) -> None:
        """Let the phones send, two at a time; the page is started again where it was killed."""
        sending, waiting = list[phone_sends.PhoneOf](), list(self._phones)
        while not self._stop.wait(0.5):
            self.site.keep_page()
            sending = [phone for phone in sending if phone.is_alive()]
            if len(sending) < 2 and waiting:
                sending.append(waiting.pop(0))
                sending[-1].start()
        for phone in sending:
            phone.calm = phone.no_more = True
        until = time.monotonic() + phone_sends.DRAIN_S
        while any(phone.is_alive() for phone in sending) and time.monotonic() < until:
            self.site.keep_page()
            time.sleep(0.5)
        self.site.end_page()

    # ---------------------------------------------------------------------------------------------------- at the end
    def stop(self) -> None:
        """Let the phones send what they began; no one decides or calls a command any more."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self.wrong += self.heard.wrong
        self.wrong += [f"still on a phone: {n}" for p in self._phones for n in p.takes if n in self.heard.begun]

    def finish(self) -> None:
        """Use all recordings again, and forget persons whose removal was broken off."""
        from pbl_schemas import connection, video
        from pbl_schemas.decisions.review_decisions import take_back

        for subject in sorted(self.asked_to_forget - self.forgotten):
            until = time.monotonic() + 120.0
            while self.forget(subject) and time.monotonic() < until:
                time.sleep(2.0)
        connection.connect()
        for number in video.NotUsable().to_arrays("video_id"):
            take_back(int(number), "the last one")

    def left(self) -> list[str]:
        """Return what is wrong with decisions, forgotten persons, recordings of phones, and backups."""
        from pbl_schemas import connection, lab, video
        from pbl_schemas.review import Decision

        connection.connect()
        wrong = [f"not forgotten: {s}" for s in sorted(self.asked_to_forget - self.forgotten)]
        wrong += [f"forgotten and there: {row}" for row in lab.Subject().to_dicts() if row["subject"] in self.forgotten]
        made = Counter(str(name) for name in Decision().to_arrays("decision_by"))
        there = {int(n) for n in video.Video().to_arrays("video_id")}
        for number, one in self.decided["done"].items():
            if made[f"D{number}"] != 1 and one in there:
                wrong.append(f"decision {number} about {one}: {made[f'D{number}']} rows")
        wrong += [f"decision {name} twice" for name, n in made.items() if n > 1 and name.startswith("D")]
        click.echo("people: " + ", ".join(f"{n} x {what}" for what, n in sorted(self.ended.items())))
        click.echo(
            f"{len(self.forgotten)} persons forgotten, {len(self.decided['done'])} decisions, {len(self.heard.ends)} "
            f"recordings of phones ended; told to try again: {self.heard.again.most_common(6)}"
        )
        return self.wrong + wrong + phone_sends._left(self.site, self.films, self.heard) + self._restored()

    def _restored(self) -> list[str]:
        """Back up what is there now, restore it into another installation and compare; check the older backups."""
        from pbl_schemas.operations import backup
        from tests.rows import everything

        kept = sorted((self.site.home / "backup").glob("*/manifest.json"))
        for manifest in kept:
            backup.check(manifest.parent)
        before, elsewhere = everything(), new_home()
        folder = self.site.home / "last"
        wrong = [f"pbl db backup ended with {code}"] if (code := self.run("db", "backup", str(folder))) else []
        own = {k: v for k, v in os.environ.items() if not k.startswith("DJ_")}
        own |= {"PBL_HOME": str(elsewhere), "PBL_STORE": str(elsewhere / "store")}
        done = subprocess.run(
            [*PBL, "db", "restore", str(folder)], env=own, capture_output=True, text=True, check=False
        )
        try:
            if done.returncode:
                return [*wrong, f"restore: {done.stderr[-600:]}"]
            code = (
                "import sys; from pbl_schemas import connection; from tests.rows import everything; "
                "connection.connect(); [print(k, len(v), sep='\\t') for k, v in everything().items()]"
            )
            told = subprocess.run([sys.executable, "-c", code], env=own, capture_output=True, text=True, check=True)
            after = {k: int(n) for k, n in (line.split("\t") for line in told.stdout.splitlines())}
            n_rows = {k: len(v) for k, v in before.items()}
            other = [k for k in n_rows.keys() | after.keys() if n_rows.get(k) != after.get(k)]
            wrong += [f"restored: {n_rows.get(k)} rows of {k} became {after.get(k)}" for k in other]
            click.echo(f"{len(kept)} backups of cron whole; {sum(after.values())} rows restored elsewhere")
        finally:
            remove_home(elsewhere)
        return wrong
