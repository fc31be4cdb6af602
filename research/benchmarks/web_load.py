"""`pbl web` under load: twenty people at once, a worker killed and the database restarted meanwhile.

    python -m research.benchmarks.web_load                         # 20 people, 5 minutes
    python -m research.benchmarks.web_load --people 5 --minutes 1

The server is `pbl web` itself over an embedded database of its own, with recordings of the tests' stand-ins. Each
person opens lists, filters, visits and recordings with their movement and parts of their videos, and chooses who is
measured; a worker computes what the choices make pending. After 40 % of the time the worker is killed and started anew,
after 60 % the database is stopped for some seconds.

Every answer is judged: a page has to be of what was asked for; an answer that is none has to say what to do
(DB_NOT_RUNNING, DB_REFUSED while the database is away, DECIDED_MEANWHILE for who came second). At the end every
decision that was answered as taken is a row, and no row is of a decision that was not. Exit code 1 otherwise.
"""

from __future__ import annotations

import collections
import dataclasses
import os
import random
import re
import signal
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

import click
import httpx2 as httpx

from research.benchmarks.workers import say
from tests.database import installation

#: Recordings in which nobody has to be chosen, and in which two walk alike.
CLEAR, ALIKE = 6, 6
#: Codes of an answer without what was asked for that is right while the database is away, and a while after.
AWAY = ("DB_NOT_RUNNING", "DB_REFUSED")
_AWAY_S, _SETTLES_S = 6.0, 10.0


@dataclasses.dataclass
class Seen:
    """What all people saw. wrong: answers that should not be; taken: decisions that were answered as taken, by person
    and recording; open: decisions whose answer said that the database went away."""

    times: dict[str, list[float]] = dataclasses.field(default_factory=lambda: collections.defaultdict(list))
    answers: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    wrong: list[str] = dataclasses.field(default_factory=list)
    taken: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    open: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    lock: threading.Lock = dataclasses.field(default_factory=threading.Lock)
    away: tuple[float, float] = (0.0, 0.0)


class Person(threading.Thread):
    """Somebody in front of a browser. names: of the recordings by number; videos: their files."""

    def __init__(self, link: str, number: int, names: dict[int, str], videos: dict[int, Path], seen: Seen, end: float):
        super().__init__(daemon=True)
        self._names, self._videos, self._seen, self._end = names, videos, seen, end
        self._random = random.Random(number)
        self._browser = httpx.Client(base_url=re.match(r"http://[^/]+", link)[0], timeout=60, follow_redirects=False)  # type: ignore[index]
        assert self._browser.get(link).status_code == 303

    def run(self) -> None:
        """Do this and that until the end."""
        does = [self._lists] * 4 + [self._visit] * 3 + [self._recording] * 3 + [self._movement] * 2 + [self._video] * 4
        does += [self._choose] * 2
        while time.monotonic() < self._end:
            action = self._random.choice(does)
            try:
                action(self._random.choice(list(self._names)))
            except httpx.HTTPError as error:
                self._wrong(f"{action.__name__}: {type(error).__name__} {error}")
            time.sleep(self._random.uniform(0, 0.5))

    def _ask(self, what: str, path: str, method: str = "GET", **more: Any) -> httpx.Response | None:
        """The answer; None for one that says, as it should, that the database is away."""
        begin = time.monotonic()
        answer = self._browser.request(method, path, **more)
        with self._seen.lock:
            self._seen.times[what].append(time.monotonic() - begin)
            self._seen.answers[answer.status_code] += 1
        if answer.status_code != 503:
            return answer
        down, up = self._seen.away
        if not down or begin > up + _SETTLES_S:
            self._wrong(f"{what}: 503 while the database was there")
        elif not any(code in answer.text for code in AWAY) or "pbl db" not in answer.text:
            self._wrong(f"{what}: 503 without what to do")
        return None

    def _wrong(self, what: str) -> None:
        with self._seen.lock:
            self._seen.wrong.append(f"{time.monotonic():.1f} {self.name} {what}")

    def _page(self, what: str, path: str, *texts: str) -> None:
        answer = self._ask(what, path)
        if answer is not None and (answer.status_code != 200 or not all(t in answer.text for t in texts)):
            self._wrong(f"{what} {path}: {answer.status_code}, not the page that was asked for")

    def _lists(self, number: int) -> None:
        asked = self._random.choice(["", "?quality=WARN", "?state=computed", "?state=waiting", "?first_day=2026-01-01"])
        self._page("list", f"/visits{asked}", "<h1>")

    def _visit(self, number: int) -> None:
        self._page("visit", f"/visits/{number}", f"visit-{number}", f'href="/recordings/{number}"')

    def _recording(self, number: int) -> None:
        self._page("recording", f"/recordings/{number}", self._names[number])

    def _movement(self, number: int) -> None:
        answer = self._ask("movement", f"/recordings/{number}/movement")
        # 404: what it was computed for is pending.
        if answer is None or (answer.status_code == 404 and "DB_NOT_FOUND" in answer.text):
            return
        if answer.status_code != 200 or "curves" not in answer.json():
            self._wrong(f"movement of {number}: {answer.status_code}")

    def _video(self, number: int) -> None:
        size = self._videos[number].stat().st_size
        first = self._random.randrange(size - 1)
        last = min(size - 1, first + 65_535)
        answer = self._ask("video", f"/recordings/{number}/video", headers={"range": f"bytes={first}-{last}"})
        if answer is None:
            return
        with self._videos[number].open("rb") as file:
            file.seek(first)
            if (answer.status_code, answer.content) != (206, file.read(last + 1 - first)):
                self._wrong(f"video of {number}: other bytes")

    def _choose(self, number: int) -> None:
        answer = self._ask("recording", f"/recordings/{number}")
        if answer is None or "/person" not in answer.text:
            return
        form = answer.text[answer.text.index(f'action="/recordings/{number}/person"') :].split("</form>")[0]
        fields = dict(re.findall(r'type="hidden" name="([a-z]+)" value="([^"]*)"', form))
        person = self._random.choice([1, 2])
        sent = self._ask("decision", f"/recordings/{number}/person", "POST", data={**fields, "person": person})
        with self._seen.lock:
            if sent is None:
                self._seen.open[self.name, number] += 1
            elif sent.status_code == 303:
                self._seen.taken[self.name, number] += 1
        if sent is not None and sent.status_code != 303 and "DECIDED_MEANWHILE" not in sent.text:
            self._wrong(f"decision on {number}: {sent.status_code}")


def started(*command: str, **more: Any) -> subprocess.Popen:
    """A process of this Python."""
    return subprocess.Popen([sys.executable, *command], text=True, **more)


WORKER = """
import time, pytest
from tests.integration import chain
chain.install(pytest.MonkeyPatch())
import schemas
from workers.populate import populate
while True:
    try:
        schemas.activate()
        populate()
    except Exception as error:
        print("worker:", type(error).__name__, flush=True)
    time.sleep(0.3)
"""


def links(printed: IO[str]) -> Any:
    """The links that the server prints, one after the use of the other."""
    for line in printed:
        if found := re.search(r"open once: (\S+)", line):
            yield found[1]


@click.command()
@click.option("--people", default=20, show_default=True)
@click.option("--minutes", default=5.0, show_default=True)
def main(people: int, minutes: float) -> None:
    """Let people use the page, judge every answer, print the figures; exit code 1 for a wrong one."""
    import tempfile

    import pytest

    import schemas
    from schemas import embedded
    from schemas.review import Decision
    from tests.integration import chain
    from tests.rows import register
    from workers.populate import populate

    with installation() as home, tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        chain.install(patch)
        schemas.activate()
        names, videos = {}, {}
        for i in range(CLEAR + ALIKE):
            path = chain.small_video(
                Path(folder), f"walk{i}", 300, "walker and bystander" if i < CLEAR else "two alike"
            )
            (number,) = register(path, subject=f"P{i:03d}", session_label=f"visit-{i + 1}")
            names[number], videos[number] = path.name, path
        populate()
        worker = started("-c", WORKER)
        web = started(
            "-c",
            "from pbl_pipeline.cli import main; main()",
            "web",
            "--port",
            "0",
            "--role",
            "reviewer",
            stdout=subprocess.PIPE,
        )
        seen, begin = Seen(), time.monotonic()
        end = begin + 60 * minutes
        found = links(web.stdout)  # type: ignore[arg-type]
        crowd = [Person(next(found), n, names, videos, seen, end) for n in range(people)]
        for person in crowd:
            person.start()
        time.sleep(0.4 * 60 * minutes)
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        worker = started("-c", WORKER)
        time.sleep(0.2 * 60 * minutes)
        down = time.monotonic()
        seen.away = (down, end)
        embedded.stop(folder=embedded.Folder(home / "db"))
        time.sleep(_AWAY_S)
        embedded.start(folder=embedded.Folder(home / "db"))
        seen.away = (down, time.monotonic())
        for person in crowd:
            person.join(60 * minutes + 60)
        worker.kill()
        web.send_signal(signal.SIGINT)
        web.wait(20)
        rows = collections.Counter(r["video_id"] for r in Decision().to_dicts())
        report(seen, rows, minutes)


def report(seen: Seen, rows: collections.Counter, minutes: float) -> None:
    """Print the figures and exit."""
    for what, times in sorted(seen.times.items()):
        middle, high = statistics.median(times), sorted(times)[int(0.95 * (len(times) - 1))]
        say(f"{what}: {len(times)} answers, median", 1000 * middle, "ms", f"95 %: {1000 * high:.0f} ms")
    say("answers a second", sum(seen.answers.values()) / (60 * minutes), "", str(dict(sorted(seen.answers.items()))))
    taken, unsure = collections.Counter(), collections.Counter()
    for counted, of in ((taken, seen.taken), (unsure, seen.open)):
        for (_, number), n in of.items():
            counted[number] += n
    for number in sorted({*taken, *rows}):
        if not taken[number] <= rows[number] <= taken[number] + unsure[number]:
            seen.wrong.append(f"recording {number}: {rows[number]} rows of {taken[number]} decisions that were taken")
    say("decisions taken", float(sum(taken.values())), "", f"{sum(rows.values())} rows, {sum(unsure.values())} unsure")
    for line in seen.wrong[:20]:
        click.echo(f"WRONG {line}")
    click.echo(f"{len(seen.wrong)} wrong answers: {'PASS' if not seen.wrong else 'FAIL'}")
    sys.exit(1 if seen.wrong else 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONPATH", os.getcwd())
    main()
