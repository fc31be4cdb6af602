"""Time until a recording plays in `pbl web`.

    python -m research.benchmarks.web_video            # 30 s of 1080p in a Chromium without windows

Makes its own database; needs `pip install -e .[browser]` and a Chromium of the machine. From a click on the
recording's link in its visit: "shown" is when the first frame is on the page, "ready" when body and controls are,
"plays" when the next frame is, Play being pressed as soon as it is there. "start" is from the click on Play to that
frame. Bar: plays after 1.0 s. The body is that of the tests' stand-in; video, server and page are real.
"""

from __future__ import annotations

import shutil
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from pbl_workers.populate import populate
from tests import database
from tests.integration import chain, web
from tests.rows import register
from tests.videos import constant_rate, write_video

SIZE, FPS = (1080, 1920), 30
#: Written into each page before its own scripts: notes when what happened, in ms since the click that led here.
WATCH = """
const seen = (window.seen = { frames: [] });
const look = () => {
  const video = document.querySelector("video");
  if (video && !seen.video) {
    seen.video = true;
    const frame = () => { seen.frames.push(performance.now()); video.requestVideoFrameCallback(frame); };
    video.requestVideoFrameCallback(frame);
  }
  const ready = document.querySelector(".look[data-ready]");
  if (ready && !seen.ready) { seen.ready = performance.now(); document.getElementById("play").click(); }
  if (!seen.ready || !seen.video) requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""


def pictures(seconds: float) -> Iterator[np.ndarray]:
    """A picture with detail and some noise that moves: about 10 Mbit/s, as phones write."""
    rng = np.random.default_rng(1)
    ground = rng.integers(0, 255, (SIZE[0] // 8, SIZE[1] // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    for i in range(round(seconds * FPS)):
        frame = np.roll(ground, 3 * i, axis=1)
        frame[::4, i % 4 :: 4] = rng.integers(0, 255, 1)
        yield frame


def times(page: Any) -> dict[str, float]:
    """One visit of the recording from its link: figures in seconds."""
    page.goto("/visits/1")
    page.get_by_role("link", name="walk.mp4").first.click()
    page.wait_for_selector(".look[data-ready]")
    for _ in range(200):
        seen = page.evaluate("() => window.seen")
        later = [t for t in seen["frames"] if t > seen["ready"]]
        if later:
            break
        page.wait_for_timeout(20)
    else:
        raise AssertionError("it does not play")
    plays = max(later[0], seen["frames"][1] if len(seen["frames"]) > 1 else later[0])
    found = {"shown": seen["frames"][0], "ready": seen["ready"], "plays": plays, "start": later[0] - seen["ready"]}
    return {name: ms / 1000 for name, ms in found.items()}


@click.command()
@click.option("--seconds", default=30.0, show_default=True)
@click.option("--repeats", default=7, show_default=True)
def main(seconds: float, repeats: int) -> None:
    """Make the recording, open it, print median and worst."""
    from playwright.sync_api import sync_playwright

    import pbl_schemas

    with database.installation() as home, pytest.MonkeyPatch.context() as patch:
        pbl_schemas.activate()
        chain.install(patch)
        path = write_video(Path(home) / "walk.mp4", pictures(seconds), constant_rate(round(seconds * FPS)), crf=27)
        click.echo(f"video: {seconds:g} s, {SIZE[1]} x {SIZE[0]} px, {path.stat().st_size / 2**20:.0f} MiB")
        register(path, session_label="2026-01-10")
        populate()
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            with web.shown(browser, size=(1200, 900)) as page:
                page.add_init_script(WATCH)
                times(page)  # the server loads what draws a body once (`serve` does it at its start)
                found = [times(page) for _ in range(repeats)]
            browser.close()
    for name in found[0]:
        values = [f[name] for f in found]
        click.echo(f"{name:6} median {statistics.median(values):.2f} s, worst {max(values):.2f} s")


if __name__ == "__main__":
    main()
