"""Phones send recordings while everything that takes them fails at random: what became of each recording.

    python -m research.benchmarks.phone_sends --sends 2000 --seed 1     # as root, who may mount three small disks
    python -m research.benchmarks.phone_sends --sends 60

Phones, a thread each, send as their page does (`capture_takes.js`): a recording stays on the phone until the server
says that it has it, and all else is tried again. One recording of twenty is cut in half, a quarter of the others have
a sensor log. The page of `pbl web` is a process of its own (a copy of one that has imported it, so that it is there
again within seconds); it computes nothing. Parts are of 64 KiB.

Faults, one after every few recordings: SIGKILL of the page, of the processes that open files for it, and of the
database; pauses of each of them, a few of 90 s; the disk of recordings, store or database full, to the last byte or
nearly. The phones break off requests, send the same part and the same end twice at once, give up waiting, forget what
they sent.
Exit status 1 where anything is wrong at the end.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import hashlib
import http.client
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from research.benchmarks import chaos
from tests import database
from tests.videos import constant_rate, write_video

#: Length of a part here (byte), recordings of a link, phones of a visit.
PART, OF_A_LINK, OF_A_VISIT = 2**16, 50, 2
#: Disks (MiB): room for so much, and for each recording.
DISKS = {"db": (900, 0.2), "store": (60, 0.05), "recordings": (80, 0.6)}
#: Longest pause (s), the share of pauses that are that long, and the longest of the others.
STALL_S, STALLS, PAUSE_S = 90.0, 0.1, 8.0
#: Time in which everything is to be sent once nothing fails (s).
DRAIN_S = 420.0
#: A fault comes after so many recordings, or so many seconds.
EVERY, EVERY_S = 4, 8.0


# ------------------------------------------------------------------------------------------------------------- the page
def start_pages(port: int) -> None:
    """Start a page for each line of the standard input, the bytes that it keeps free, and print its process number."""
    import pbl_workers.web  # noqa: F401  what takes long

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # none is waited for
    for line in sys.stdin:
        if not (pid := os.fork()):
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            os.dup2(2, 1)
            with contextlib.suppress(SystemExit):
                serve(port, int(line))
            os._exit(0)
        sys.stdout.write(f"{pid}\n")
        sys.stdout.flush()


def serve(port: int, kept_free: int) -> None:
    """The page of `pbl web`, with small parts, and without the computing that follows a recording."""
    from pbl_pipeline import temporary
    from pbl_schemas.intake import phone_recordings
    from pbl_workers import incoming, phone_uploads
    from pbl_workers.web import Where, phone
    from pbl_workers.web import serve as page

    temporary.sweep()
    for module in (phone_recordings, phone_uploads, phone):
        module.PART_BYTES = PART  # type: ignore[misc]
    incoming.KEPT_FREE = kept_free
    phone.compute = lambda *_: None
    draw, real, inserts = random.Random(os.getpid()), phone_uploads.register, Path(os.environ[chaos.INSERTS])

    def seen(*args: Any) -> int:
        """Register, seen from outside, and slower than it is."""
        mark = inserts / str(os.getpid())
        mark.touch()
        try:
            time.sleep(draw.uniform(0, 0.03))
            return real(*args)
        finally:
            time.sleep(draw.uniform(0, 0.03))
            mark.unlink(missing_ok=True)

    def slow(real: Callable[..., Any]) -> Callable[..., Any]:
        def act(*args: Any) -> Any:
            time.sleep(draw.uniform(0, 0.03))
            return real(*args)

        return act

    phone_uploads.register = seen
    for name in ("register_copies", "discard"):  # moments in which a kill is to come
        setattr(phone_uploads, name, slow(getattr(phone_uploads, name)))
    sys.modules["pbl_workers.web.serve"]._warm = lambda: None  # type: ignore[attr-defined]
    page(Where(port=port), "B")


@dataclasses.dataclass
class Site(chaos.Site):
    """An installation whose page is killed and started again."""

    port: int = 0
    pages: subprocess.Popen[str] | None = None  # starts them
    page: int = 0  # process number; 0 before the first

    def keep_page(self) -> None:
        """Start the page where it does not run, as systemd would, and wait for some time until it answers."""
        if self.pages is None:
            code = f"from research.benchmarks.phone_sends import start_pages; start_pages({self.port})"
            with (self.home / "page.log").open("ab") as log:
                own = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": log, "text": True}
                self.pages = subprocess.Popen([sys.executable, "-c", code], **own)
        if self.page and Path(f"/proc/{self.page}").exists():
            return
        assert self.pages.stdin
        assert self.pages.stdout
        # Half of the pages keep no room free, so that writes meet the end of the disk.
        self.pages.stdin.write(f"{self.draw.choice((0, 4 << 20))}\n")
        self.pages.stdin.flush()
        self.page = int(self.pages.stdout.readline())
        until = time.monotonic() + 15.0
        while time.monotonic() < until and not self.answers():
            time.sleep(0.1)

    def answers(self) -> bool:
        try:
            with contextlib.closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=3)) as connection:
                connection.request("GET", "/static/page.css")
                return connection.getresponse().status == 200
        except (OSError, http.client.HTTPException):
            return False

    def end_page(self) -> None:
        """End the page as a person does, and what starts it."""
        if self.pages is None:
            return
        until = time.monotonic() + 60.0
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.page, signal.SIGCONT)
            os.kill(self.page, signal.SIGTERM)
            while time.monotonic() < until and Path(f"/proc/{self.page}").exists():
                time.sleep(0.1)
        assert self.pages.stdin
        self.pages.stdin.close()
        self.pages.wait(60)
        self.pages, self.page = None, 0

    def helpers(self) -> list[int]:
        """The processes below the page, and below those."""
        parents: dict[int, list[int]] = collections.defaultdict(list)
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError, ValueError):
                parents[int(stat.read_text().rpartition(")")[2].split()[1])].append(int(stat.parent.name))
        found = list(parents[self.page]) if self.page else []
        for pid in found:  # it grows
            found += parents[pid]
        return found

    def helper(self, opens: bool) -> int:
        """A process below the page, preferably one that opens a file at this moment; 0 if there is none."""
        until = time.monotonic() + 3.0
        while opens and time.monotonic() < until:
            below = self.helpers()
            own = {pid for pid in below if _parent(pid) not in (0, self.page)}
            if own:
                return self.draw.choice(sorted(own))
        below = self.helpers()
        return self.draw.choice(below) if below else 0

    def kill_page(self) -> None:
        """Half of the times while a recording is registered."""
        if not self.page:  # 0: it would be our own group
            return
        inside = self.draw.random() < 0.5 and self.wait_for_insert()
        for mark in Path(os.environ[chaos.INSERTS]).iterdir():
            mark.unlink(missing_ok=True)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.page, signal.SIGKILL)
            self.done["page killed" + (" inside an insert" if inside else "")] += 1
            time.sleep(self.draw.uniform(0.1, 2.0))

    def kill_helper(self, opens: bool) -> None:
        if pid := self.helper(opens):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self.done["process that opens files killed" if opens else "any process below the page killed"] += 1

    def pause(self, what: str, pid: int) -> None:
        """Pause a process in the background."""
        seconds = STALL_S if self.draw.random() < STALLS else self.draw.uniform(0.5, PAUSE_S)
        with contextlib.suppress(ProcessLookupError):
            if pid:
                os.kill(pid, signal.SIGSTOP)
                subprocess.Popen(["sh", "-c", f"sleep {seconds}; kill -CONT {pid} 2>/dev/null"])
                self.done[f"{what} paused" + (f" for {STALL_S:.0f} s" if seconds == STALL_S else "")] += 1

    def kill_database(self) -> None:
        """Half of the times while a recording is registered."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.server, signal.SIGCONT)
            if self.draw.random() < 0.5:
                self.kill_server()
            else:
                os.kill(self.server, signal.SIGKILL)
                self.done["database killed"] += 1
                time.sleep(self.draw.uniform(0.2, 3.0))

    def faults(self, can_fill: bool) -> list[tuple[float, Callable[[], Any]]]:
        full = 1.0 if can_fill else 0.0
        return [
            (3.0, self.kill_page),
            (3.0, lambda: self.kill_helper(True)),
            (1.0, lambda: self.kill_helper(False)),
            (1.5, lambda: self.pause("page", self.page)),
            (2.0, lambda: self.pause("process that opens files", self.helper(True))),
            (1.0, lambda: self.pause("database", self.server)),
            (1.5, self.kill_database),
            (2.5 * full, lambda: self.fill("recordings", self.draw.choice((0, self.draw.randrange(2 << 20))), 4.0)),
            (full, lambda: self.fill("store", self.draw.choice((0, self.draw.randrange(2 << 15))), 4.0)),
            (full, lambda: self.fill("db", longest_s=6.0)),
        ]


def _parent(pid: int) -> int:
    with contextlib.suppress(OSError, ValueError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return 0


# ----------------------------------------------------------------------------------------------------------- the phones
class Again(Exception):
    """The recording stays on the phone and is sent again: its argument says why."""


@dataclasses.dataclass(frozen=True)
class Films:
    """Recordings by their number: whole films of one video, or its first half; each with other bytes."""

    film: bytes

    @staticmethod
    def is_whole(number: int) -> bool:
        return number % 20 != 7

    def of(self, number: int) -> tuple[bytes, bytes]:
        """The video, and the sensor log, which may be empty."""
        own = number.to_bytes(8) + random.Random(number).randbytes(number * 7919 % 100_000)
        if not self.is_whole(number):
            return self.film[: len(self.film) // 2] + own[:8], b""
        return self.film + (8 + len(own)).to_bytes(4) + b"free" + own, _log(number) if number % 4 == 1 else b""


def _log(number: int) -> bytes:
    time_s = [i / 60 for i in range(400 + number % 50)]  # longer than the recorded stages of `chaos`
    values = {"qw": 0.5**0.5, "qx": 0.5**0.5, "qy": 0.0, "qz": 0.0}
    sensor = {"time_s": time_s, **{name: [v] * len(time_s) for name, v in values.items()}}
    return json.dumps({"frame": "device", "phone": {"make": "B", "model": str(number)}, "orientation": sensor}).encode()


@dataclasses.dataclass
class Heard:
    """Acts of the phones, and the server's answers."""

    ends: dict[int, tuple[str, str]] = dataclasses.field(default_factory=dict)  # state and error at the last answer
    begun: set[int] = dataclasses.field(default_factory=set)
    again: Counter[str] = dataclasses.field(default_factory=Counter)
    acts: Counter[str] = dataclasses.field(default_factory=Counter)
    wrong: list[str] = dataclasses.field(default_factory=list)
    seconds: list[float] = dataclasses.field(default_factory=list)  # of each recording from its begin to its end


class PhoneOf(threading.Thread):
    """A phone that films for a visit: it opens its link and sends its recordings, one after the other."""

    def __init__(self, port: int, keys: list[str], takes: list[int], films: Films, heard: Heard, seed: int) -> None:
        super().__init__(daemon=True)
        self.port, self.keys, self.takes, self.films, self.heard = port, keys, takes, films, heard
        self.draw, self.cookie, self.calm, self.no_more = random.Random(seed), "", False, False

    def run(self) -> None:
        began: dict[int, float] = {}
        while self.takes and not (self.no_more and not began):
            try:
                if not self.cookie:
                    self.open()
                for number in list(self.takes):
                    if self.no_more and number not in began:
                        return
                    self.heard.begun.add(number)
                    began.setdefault(number, time.monotonic())
                    told = self.send(number)
                    self.heard.ends[number] = told["state"], told["error"]
                    self.takes.remove(number)
                    self.heard.seconds.append(time.monotonic() - began.pop(number))
                    self.look(number, told)
            except Again as why:
                self.heard.again[str(why)] += 1
                time.sleep(self.draw.uniform(0.2, 2.0))
            except Exception as error:
                self.heard.wrong.append(f"a phone broke off: {type(error).__name__}: {error}")
                raise

    def open(self) -> None:
        status, _, cookie = self.request(
            "POST", "/phone/open", f"key={self.keys[0]}".encode(), kind="x-www-form-urlencoded"
        )
        if status == 403 and len(self.keys) > 1:  # the answer with the cookie was lost: another code is scanned
            self.keys.pop(0)
            raise Again("link was taken, its answer lost")
        if status != 303 or not cookie:
            raise Again(f"link not opened: {status}")
        self.cookie = cookie

    def look(self, number: int, told: dict[str, Any]) -> None:
        """Read the state as the page does; sometimes send a recording again that the server has."""
        state = self.told(*self.request("GET", "/phone/state.json")[:2])
        shown = {r["number"]: r["state"] for r in state["recordings"]}
        if shown.get(told["number"]) != told["state"]:
            self.heard.wrong.append(f"recording {number} is {told['state']}, the page says {shown.get(told['number'])}")
        if self.draw.random() < 0.05:
            self.heard.acts["sent again after its end"] += 1
            with contextlib.suppress(Again):
                again = self.send(number)
                if (again["number"], again["state"]) != (told["number"], told["state"]):
                    self.heard.wrong.append(f"recording {number} was {told['state']} and is {again['state']}")

    def send(self, number: int) -> dict[str, Any]:
        """Send what is not there yet; return what the server says of the recording."""
        film, log = self.films.of(number)
        whole = film + log
        parts = [whole[i : i + PART] for i in range(0, len(whole), PART)]
        sha256 = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()
        stated = {"sha256": sha256, "video_bytes": len(film), "log_bytes": len(log), "activity": "walking"}
        told = self.told(*self.request("POST", "/phone/recordings.json", json.dumps(stated).encode())[:2])
        for n in told["missing"]:
            self.send_part(told["number"], n, parts[n], len(whole))
        if told["state"] == "uploading":
            end = "POST", f"/phone/finish/{told['number']}.json", b"{}"
            if self.unlucky(0.04, "end of the recording sent, answer not awaited"):
                self.broken(*end, cut=False)
            if self.unlucky(0.04, "end of the recording sent twice at once"):
                self.beside(*end)
            told = self.told(*self.request(*end)[:2])
        if told["sha256"] != sha256:
            self.heard.wrong.append(f"recording {number} has another sum: {told}")
        if told["state"] not in ("received", "refused"):
            raise Again(f"state {told['state']} after its end")
        return told

    def send_part(self, number: int, n: int, part: bytes, size: int) -> None:
        ranged = f"bytes {n * PART}-{n * PART + len(part) - 1}/{size}"
        more = {"Content-Range": ranged, "X-SHA256": hashlib.sha256(part).hexdigest()}
        put = "PUT", f"/phone/recordings/{number}.json", part, "octet-stream"
        for chance, what, pause_s in ((0.03, "connection cut", 0.0), (0.001, "phone paused for 90 s", STALL_S)):
            if self.unlucky(chance, f"{what} within a part"):
                self.broken(*put, cut=True, more=more, pause_s=pause_s)
                raise Again("connection lost")
        if self.unlucky(0.03, "part sent twice at once"):
            self.beside(*put, more=more)
        self.told(*self.request(*put, more=more)[:2])

    def unlucky(self, chance: float, what: str) -> bool:
        happens = not self.calm and self.draw.random() < chance
        self.heard.acts[what] += happens
        return happens

    def beside(self, *args: Any, **more: Any) -> None:
        def act() -> None:
            with contextlib.suppress(Again):
                self.request(*args, **more)

        threading.Thread(target=act, daemon=True).start()

    def broken(
        self,
        method: str,
        path: str,
        body: bytes,
        kind: str = "json",
        *,
        cut: bool,
        more: Any = None,
        pause_s: float = 0,
    ) -> None:
        """Send a request and close: within its body, after a pause, or before the answer."""
        headers = {**self.headers(kind, more or {}), "Host": f"127.0.0.1:{self.port}", "Content-Length": str(len(body))}
        head = f"{method} {path} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in headers.items()) + "\r\n"
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=20) as sent:
            sent.sendall(head.encode() + (body[: self.draw.randrange(len(body))] if cut else body))
            time.sleep(pause_s)

    def headers(self, kind: str, more: dict[str, str]) -> dict[str, str]:
        own = {"Cookie": f"pbl_phone={self.cookie}"} if self.cookie else {}
        return {"Content-Type": f"application/{kind}", **own, **more}

    def request(
        self, method: str, path: str, body: bytes = b"", kind: str = "json", more: dict[str, str] | None = None
    ) -> tuple[int, bytes, str]:
        """Status, body and cookie of an answer. Raises Again: no answer."""
        patience = 3.0 if self.unlucky(0.02, "answer awaited for 3 s only") else 150.0
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=patience)
        try:
            connection.request(method, path, body, self.headers(kind, more or {}))
            answer = connection.getresponse()
            _, _, cookie = (answer.headers.get("set-cookie") or "").partition("pbl_phone=")
            return answer.status, answer.read(), cookie.partition(";")[0]
        except (OSError, http.client.HTTPException) as error:
            raise Again("connection lost") from error
        finally:
            connection.close()

    def told(self, status: int, body: bytes) -> dict[str, Any]:
        """The answer's content. Raises Again with its code where it is an error."""
        if status in (200, 204):
            return json.loads(body) if body else {}
        try:
            error = json.loads(body)["error"]
        except (ValueError, KeyError, TypeError):
            error = {"code": "no code", "found": body[:200].decode(errors="replace")}
        if error["code"] in ("INTERNAL", "PHONE_LINK", "no code"):
            self.heard.wrong.append(f"answer {status} {error['code']}: {error.get('found')}")
        raise Again(f"{status} {error['code']}")


# ------------------------------------------------------------------------------------------------------------------ run
@click.command()
@click.option("--sends", default=2000, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--phones", default=24, show_default=True, help="That send at the same time.")
@click.option("--minutes", default=120.0, show_default=True, help="After which no further recording is begun.")
@click.option("--keep", is_flag=True, help="Leave the folder with the page's log.")
def main(sends: int, seed: int, phones: int, minutes: float, keep: bool) -> None:
    """Send, let things fail, then compare tables and files with the recordings."""
    home = database.new_home()
    sizes = {name: room + each * sends for name, (room, each) in DISKS.items()}
    with chaos.disks(home, sizes) as can_fill, pytest.MonkeyPatch.context() as patch:
        database.leave_nothing_of_the_developer(patch)
        for name in ("inserts", "tmp"):
            (home / name).mkdir()
        (home / "tmp").chmod(0o1777)
        patch.setenv("PBL_HOME", str(home))
        patch.setenv("PBL_STORE", str(home / "store"))
        patch.setenv(chaos.INSERTS, str(home / "inserts"))
        patch.setenv("TMPDIR", str(home / "tmp"))
        patch.delenv("PBL_ARCHIVE", raising=False)
        site = Site(home, random.Random(seed))
        try:
            wrong = _run(site, sends, phones, minutes, can_fill)
        finally:
            site.end_page()
            from pbl_schemas.operations import embedded

            embedded.stop(folder=embedded.Folder(home / "db"))
    if not keep:
        shutil.rmtree(home, ignore_errors=True)
    for line in wrong[:40]:
        click.echo(f"WRONG: {line}")
    click.echo(f"{len(wrong)} wrong" + (f"; {home}" if keep else ""))
    raise SystemExit(1 if wrong else 0)


def _film(folder: Path) -> bytes:
    """A short video of some 200 kB."""
    rng = np.random.default_rng(1)
    frames = (rng.integers(0, 255, (96, 128, 3), np.uint8) for _ in range(12))
    return write_video(folder / "film.mp4", frames, constant_rate(12)).read_bytes()


def _run(site: Site, sends: int, phones: int, minutes: float, can_fill: bool) -> list[str]:
    from pbl_schemas.intake import phone_recordings
    from pbl_schemas.operations.declare import declare_all
    from tests.rows import new_visit

    site.start_server()
    declare_all()
    films, heard = Films(_film(site.home)), Heard()
    click.echo(
        f"{sends} recordings of {len(films.film) / 1e3:.0f} to {len(films.film) / 1e3 + 100:.0f} kB, {phones} phones"
    )
    with socket.create_server(("127.0.0.1", 0)) as free:
        site.port = free.getsockname()[1]
    waiting, visit = list[PhoneOf](), 0
    for i, first in enumerate(range(0, sends, OF_A_LINK)):
        if i % OF_A_VISIT == 0:
            visit = new_visit(f"2026-01-{1 + i // OF_A_VISIT % 28:02d}", f"P{i // OF_A_VISIT:03d}")
        keys = [phone_recordings.make_link(visit, "B", 24)[1] for _ in range(4)]
        takes = list(range(first, min(sends, first + OF_A_LINK)))
        waiting.append(PhoneOf(site.port, keys, takes, films, heard, site.draw.randrange(2**31)))
    began, weights, sending, every = time.monotonic(), site.faults(can_fill), list[PhoneOf](), list(waiting)
    told = began
    site.keep_page()
    while waiting or any(phone.is_alive() for phone in sending):
        if time.monotonic() - began > 60 * minutes or (not waiting and len(heard.ends) >= sends - phones):
            break
        sending = [phone for phone in sending if phone.is_alive()]
        while waiting and len(sending) < phones:
            sending.append(waiting.pop(0))
            sending[-1].start()
        site.keep_page()
        with contextlib.suppress(Exception):  # a full disk: again later
            site.start_server()
        ended, until = len(heard.ends) + site.draw.randint(1, 2 * EVERY), time.monotonic() + EVERY_S
        while len(heard.ends) < ended and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(site.draw.uniform(0, 0.3))
        site.draw.choices([f for _, f in weights], [w for w, _ in weights])[0]()
        if time.monotonic() - told > 60:
            told = time.monotonic()
            click.echo(f"{told - began:.0f} s: {len(heard.ends)} ended; {heard.again.most_common(4)}", err=True)
    spent = time.monotonic() - began
    if time.monotonic() - began > 60 * minutes:
        for phone in sending:
            phone.no_more = True
    _drain(site, sending, time.monotonic() + DRAIN_S)
    click.echo(f"{spent:.0f} s with faults: " + ", ".join(f"{n} x {what}" for what, n in sorted(site.done.items())))
    click.echo("phones: " + ", ".join(f"{n} x {what}" for what, n in sorted(heard.acts.items())))
    click.echo("told to try again: " + ", ".join(f"{n} x {what}" for what, n in heard.again.most_common()))
    said = (site.home / "page.log").read_text(errors="replace")
    raised = Counter(
        line[:150] for line in said.splitlines() if re.match(r"[A-Za-z_.]+(Error|Exception|Exceeded)\b", line)
    )
    click.echo(
        "exceptions in the page's log: " + (", ".join(f"{n} x {w}" for w, n in raised.most_common(12)) or "none")
    )
    click.echo(f"the last one {time.monotonic() - began - spent:.0f} s after the last fault")
    site.end_page()
    wrong = heard.wrong + [f"still on a phone: {n}" for p in every for n in p.takes if n in heard.begun]
    return wrong + _left(site, films, heard)


def _drain(site: Site, sending: list[PhoneOf], until: float) -> None:
    """Let the phones send what they have begun, with nothing that fails."""
    for phone in sending:
        phone.calm = True
    with contextlib.suppress(ProcessLookupError):
        for pid in [site.server, *site.helpers(), site.page]:
            os.kill(pid, signal.SIGCONT)
    while any(phone.is_alive() for phone in sending) and time.monotonic() < until:
        site.keep_page()
        with contextlib.suppress(Exception):
            site.start_server()
        time.sleep(1.0)


def _left(site: Site, films: Films, heard: Heard) -> list[str]:
    """Return the faults: recordings that are missing, twice, changed or wrongly refused; remains."""
    from pbl_pipeline import temporary
    from pbl_pipeline.errors import CODES, INPUT
    from pbl_schemas import connection, video, worker
    from pbl_schemas.capture import PhoneRecording
    from pbl_schemas.intake.phone_recordings import begun_bytes
    from pbl_schemas.operations.archive import UNFINISHED_DAYS, archive_dir, unfinished
    from pbl_schemas.operations.orphans import orphans, remove

    site.start_server()  # the page may have started it, and stopped it at its end
    connection.connect()
    wrong, counts = [], Counter[str]()
    videos: dict[str, list[dict[str, Any]]] = collections.defaultdict(list)
    for row in video.Video().to_dicts():
        videos[row["video_sha256"]].append(row)
    logs = {int(n) for n in video.PhoneAttitude().to_arrays("video_id")}
    rows = Counter(int(n) for n in PhoneRecording().to_arrays("video_id") if n is not None)
    expected: set[Path] = set()
    for number in sorted(heard.begun):
        film, log = films.of(number)
        state, error = heard.ends.get(number, ("on the phone", ""))
        found = videos.pop(hashlib.sha256(film).hexdigest(), [])
        if not films.is_whole(number):
            code = error.partition(":")[0]
            good = state == "refused" and not found and code in CODES and CODES[code].cause == INPUT
            counts["cut in half: refused for good" if good else "cut in half: WRONG"] += 1
            wrong += [] if good else [f"recording {number}, cut in half: {state} {error}, {len(found)} videos"]
            continue
        same = [
            row for row in found if Path(row["video_path"]).is_file() and Path(row["video_path"]).read_bytes() == film
        ]
        once = len(found) == len(same) == 1 and rows[int(found[0]["video_id"])] == 1
        good = state == "received" and once and (int(found[0]["video_id"]) in logs) == bool(log)
        counts["whole: registered once, byte-equal" if good else "whole: WRONG"] += 1
        if not good:
            wrong.append(f"recording {number}: {state} {error}, {len(found)} videos, {len(same)} with its bytes")
        for path in (Path(row["video_path"]) for row in found):
            expected |= {path, path.with_suffix(".json")} if log else {path}
    click.echo(", ".join(f"{n} {what}" for what, n in sorted(counts.items())))
    wrong += [
        f"video of no recording: {row}"
        for own in videos.values()
        for row in own
        if Path(row["video_path"]).is_relative_to(archive_dir())
    ]
    if (n := len(PhoneRecording())) != len(heard.begun):
        wrong.append(f"{n} rows of recordings that phones sent, for {len(heard.begun)}")
    there = {path for path in archive_dir().rglob("*") if not path.is_dir()}
    wrong += [f"left behind: {path.relative_to(site.home)}" for path in sorted(there - expected)]
    wrong += [f"lost: {path}" for path in sorted(expected - there)]
    wrong += [f"folder of parts left: {one.path}" for one in unfinished(archive_dir())]
    wrong += [f"room promised to {number}: {n} bytes" for number, n in begun_bytes(UNFINISHED_DAYS).items()]
    if n := len(worker.Turn()):
        wrong.append(f"{n} locks left")
    temporary.sweep()
    left = [path.name for path in (site.home / "tmp").iterdir() if not path.name.startswith("pymp-")]
    wrong += [f"temporary: {name}" for name in left]
    stored = orphans(young_s=0.0)
    removed = remove(stored, 0.0)
    click.echo(
        f"{len(there)} files in the archive; {stored.n_files} in the store, of which `pbl cron` removed {removed} "
        f"without a row"
    )
    wrong += [f"store: without a row: {file.path}" for file in orphans(young_s=0.0).orphans]
    wrong += [f"lost: {path}" for path in stored.lost]
    seconds = sorted(heard.seconds)
    if seconds:
        click.echo(f"a recording took {seconds[len(seconds) // 2]:.1f} s (median), {seconds[-1]:.0f} s (longest)")
    return wrong


if __name__ == "__main__":
    main()
