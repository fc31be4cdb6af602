"""The review page in a Chromium of the machine: what only a browser can show. Skips where there is none."""

from __future__ import annotations

import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from tests.integration.chain import small_video
from tests.rows import register
from workers.populate import populate
from workers.web import Options, create_app

pytestmark = [pytest.mark.needs_extra, pytest.mark.slow]

#: In the page: while the video plays, the number in each shown picture (`numbered_frames`: its grey is 8 times the
#: number modulo 30) and the frame of the body that is drawn then.
WATCH = """
() => new Promise((done) => {
  const video = document.querySelector("video"), body = document.querySelector("canvas.body"), found = [];
  const copy = new OffscreenCanvas(1, 1), c = copy.getContext("2d", {willReadFrequently: true});
  const look = () => {
    c.drawImage(video, video.videoWidth / 2, video.videoHeight / 2, 1, 1, 0, 0, 1, 1);
    found.push([Math.round(c.getImageData(0, 0, 1, 1).data[0] / 8), +body.dataset.frame % 30]);
    if (video.ended || found.length > 400) done(found); else video.requestVideoFrameCallback(look);
  };
  video.requestVideoFrameCallback(look);
  video.addEventListener("ended", () => done(found));
  video.play();
})
"""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="pip install -e .[browser]")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(chromium: Any, tables: None, tmp_path: Path) -> Iterator[Any]:
    """A signed-in page over one fitted recording, video 1 of visit 1; an error of a script fails the test."""
    register(small_video(tmp_path, "walk"), session_label="2026-01-10")
    populate()
    app = create_app(Options(name="R. Viewer"))
    listening = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(app, log_level="error"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    context = chromium.new_context(
        base_url=f"http://127.0.0.1:{listening.getsockname()[1]}", viewport={"width": 390, "height": 800}
    )
    opened, errors = context.new_page(), []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    opened.goto(f"/enter?key={app.state.sessions.new_link('R. Viewer', 'reviewer')}")
    yield opened
    context.close()
    server.should_exit = True
    thread.join(10)
    assert not errors


def test_from_the_link_to_a_frame_of_the_body(page: Any):
    page.get_by_role("link", name="2026-01-10").click()
    page.get_by_role("link", name="walk.mp4").click()
    page.wait_for_selector("[data-ready]")
    frame = lambda: int(page.locator("canvas.body").get_attribute("data-frame"))  # noqa: E731
    # Pictures and body stay within one frame of each other while it plays.
    shown = page.evaluate(WATCH)
    assert len(shown) > 5
    apart = [min((a - b) % 30, (b - a) % 30) for a, b in shown]
    assert max(apart) <= 1, shown
    # A step is a frame, whatever was shown before.
    page.locator(".stage").focus()
    page.locator("#position").fill("100")
    page.wait_for_selector("canvas.body[data-frame='100']")
    for key, expected in ((".", 101), (".", 102), (",", 101)):
        page.keyboard.press(key)
        page.wait_for_selector(f"canvas.body[data-frame='{expected}']")
    before = frame()
    page.keyboard.press("l")
    page.wait_for_selector(f"canvas.body:not([data-frame='{before}'])")
    assert frame() > before
    page.keyboard.press("-")
    assert page.evaluate("document.querySelector('video').playbackRate") == 0.5
    # Something is drawn, nothing sticks out of a phone's width.
    assert page.evaluate(
        "() => { const b = document.querySelector('canvas.body');"
        " return b.getContext('2d').getImageData(0, 0, b.width, b.height).data.some((v) => v > 0); }"
    )
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
