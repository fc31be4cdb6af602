"""Cost of the pages of a visit that phones film, and of `/visits` beside ten phones.

    python -m research.benchmarks.phone_state                    # visits of 100 and 200 recordings

The recordings are copies of the rows of one, in a separate database: once where all wait to be computed, once where all
are computed. Processor time is that of the page's process, the median of `--repeats` requests.
"""

from __future__ import annotations

import contextlib
import functools
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest

from research.benchmarks.workers import say
from tests.database import installation

#: Seconds between two questions of a phone.
_AGAIN_S = 3.0


def cpu_s(ask: Callable[[], Any], repeats: int) -> float:
    """Return the processor time of this process for a call (s), the median."""
    spent = []
    for _ in range(repeats):
        begin = time.process_time()
        ask()
        spent.append(time.process_time() - begin)
    return statistics.median(spent)


def wall_s(ask: Callable[[], Any], seconds: float = 4 * _AGAIN_S) -> float:
    """Return the mean time of a call (s) over so many seconds."""
    begin, n = time.monotonic(), 0
    while (spent := time.monotonic() - begin) < seconds or not n:
        ask()
        n += 1
    return spent / n


def sent_by_phone(folder: Path, label: str) -> int:
    """Register a visit with a recording and a phone's link; returns the number of both."""
    from pbl_schemas.capture import RECEIVED, PhoneRecording
    from pbl_schemas.intake import phone_recordings
    from pbl_schemas.rows import utc_now
    from tests.integration.chain import small_video
    from tests.rows import new_visit, register

    visit = new_visit(label)
    (number,) = register(small_video(folder, f"walk{label}", n=100 + visit), session_label=label)
    link, _ = phone_recordings.make_link(visit, "A", 2.0)
    about = {"phone_video_size": 1, "phone_log_size": 0, "phone_about": {"step": "1"}, "phone_sha256": f"{visit:064d}"}
    state = {"phone_state": RECEIVED, "video_id": number, "phone_created": utc_now()}
    key = {"phone_recording": number, "session_id": visit, "phone_link": link}
    PhoneRecording.insert1({**key, **about, **state})
    return number


def asks(browser: Any) -> Callable[[], Any]:
    """Return the question that the page of a phone repeats."""
    said: dict[str, str] = {}

    def ask() -> None:
        answer = browser.get("/phone/state.json", headers={"if-none-match": said["etag"]} if said else {})
        assert answer.status_code in (200, 304), answer.text
        if "etag" in answer.headers:
            said["etag"] = answer.headers["etag"]

    return ask


@click.command()
@click.option("--recordings", default=[100, 200], multiple=True, show_default=True, help="Of a visit.")
@click.option("--phones", default=10, show_default=True, help="That ask while the list of visits is loaded.")
@click.option("--repeats", default=5, show_default=True)
def main(recordings: tuple[int, ...], phones: int, repeats: int) -> None:
    """Print processor times and the list's time alone and beside phones."""
    from starlette.testclient import TestClient

    import pbl_schemas
    from pbl_schemas import video
    from pbl_schemas.intake import phone_recordings
    from pbl_workers import refresh
    from pbl_workers.populate import populate
    from tests.integration import chain, web
    from tests.integration.compute_target import nothing
    from tests.rows import copies

    with installation() as home, pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
        pbl_schemas.activate()
        stack.enter_context(web.one_query_at_a_time())
        chain.install(patch)
        reviewer = web.client(target=nothing)
        with reviewer:
            computed = {sent_by_phone(home, f"2026-01-{1 + i:02d}"): n for i, n in enumerate(recordings)}
            populate()
            waiting = {sent_by_phone(home, f"2026-02-{1 + i:02d}"): n for i, n in enumerate(recordings)}
            others = {sent_by_phone(home, f"2026-03-{1 + i:02d}"): recordings[0] for i in range(phones)}
            refresh.refresh()
            browsers = {}
            for number, n in {**computed, **waiting, **others}.items():
                copies(number, n - 1, 1000 * number)
                visit = (video.Video & {"video_id": number}).fetch1("session_id")
                _, key = phone_recordings.make_link(visit, "A", 2.0)
                own = TestClient(reviewer.app, base_url=web.BASE)
                own.portal = reviewer.portal
                own.post("/phone/open", data={"key": key}, follow_redirects=False)
                browsers[number] = visit, asks(own)
            for number, n in {**computed, **waiting}.items():
                visit, ask = browsers[number]
                name = f"{n} {'computed' if number in computed else 'waiting'}"
                say(f"{name}: state.json, first", cpu_s(ask, 1), "s")
                say(f"{name}: state.json, again", cpu_s(ask, repeats), "s")
                page = cpu_s(functools.partial(reviewer.get, f"/visits/{visit}"), repeats)
                say(f"{name}: page of the visit", page, "s", "bar 1")
            wait = threading.Event()
            film = [browsers[number][1] for number in others]

            def look() -> None:
                assert reviewer.get("/visits").status_code == 200

            alone = wall_s(look)

            def repeat(ask: Callable[[], Any]) -> None:
                while not wait.wait(_AGAIN_S):
                    ask()

            threads = [threading.Thread(target=repeat, args=(ask,)) for ask in film]
            for ask in film:
                ask()
            for thread in threads:
                thread.start()
                time.sleep(_AGAIN_S / phones)
            beside = wall_s(look)
            wait.set()
            for thread in threads:
                thread.join()
            say("/visits alone", alone, "s")
            say(f"/visits beside {phones} phones of {recordings[0]}", beside, "s")
            say("ratio", beside / alone, "", "bar 1.5")


if __name__ == "__main__":
    main()
