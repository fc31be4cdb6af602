"""The review page in a Chromium of the machine: what only a browser can show. Skips where there is none."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pbl_workers.populate import populate
from tests.integration import web
from tests.integration.chain import N_FRAMES, small_video
from tests.rows import register

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


#: In the page: the number in the picture that is shown now, and the frame of the body, of the 3D view and of the strip.
SHOWN = """
() => {
  const video = document.querySelector("video"), c = new OffscreenCanvas(1, 1).getContext("2d");
  c.drawImage(video, video.videoWidth / 2, video.videoHeight / 2, 1, 1, 0, 0, 1, 1);
  return { picture: Math.round(c.getImageData(0, 0, 1, 1).data[0] / 8), body: +document.querySelector("canvas.body").dataset.frame,
    space: +document.querySelector(".space canvas").dataset.frame, strip: +document.querySelector("#position").value };
}
"""  # noqa: E501


@pytest.fixture
def page(chromium: Any, tables: None, tmp_path: Path) -> Iterator[Any]:
    """A signed-in page of a phone's width over one fitted recording, video 1 of visit 1."""
    register(small_video(tmp_path, "walk"), session_label="2026-01-10")
    populate()
    with web.shown(chromium) as opened:
        yield opened


def test_a_recording_begins_where_the_body_does(page: Any):
    def late(route: Any) -> None:
        movement = route.fetch().json()
        movement["body"]["known"] = [[40, N_FRAMES - 1]]
        route.fulfill(json=movement)

    page.route("**/recordings/1/movement", late)
    page.goto("/recordings/1")
    page.wait_for_selector("canvas.body[data-frame='40']")


def test_from_the_link_to_a_frame_of_the_body(page: Any):
    page.get_by_role("link", name="2026-01-10").click()
    page.get_by_role("link", name="walk.mp4").click()
    page.wait_for_selector("[data-ready]")
    frame = lambda: int(page.locator("canvas.body").get_attribute("data-frame"))  # noqa: E731
    # Pictures and body stay within one frame of each other while it plays.
    shown = page.evaluate(WATCH)
    assert len(shown) > 5
    apart = [min((a - b) % 30, (b - a) % 30) for a, b in shown]
    assert sorted(apart)[-2] <= 1, shown  # but for one: beside other work the browser skips pictures
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


def settled(page: Any) -> int:
    """The frame that picture, body and 3D view show once nothing moves any more; they are the same one."""
    last: dict[str, int] = {}
    for _ in range(1000):
        found = page.evaluate(SHOWN)
        if found == last and found["picture"] == found["body"] % 30:
            assert found["body"] == found["space"] == found["strip"], found
            return found["body"]
        last = found
        page.wait_for_timeout(60)
    raise AssertionError(f"picture and body do not show one frame: {last}")


def test_picture_body_and_3d_view_show_one_frame_at_pause_step_and_seek(page: Any):
    page.set_viewport_size({"width": 1200, "height": 1500})  # all in view: what is not is not drawn
    page.goto("/recordings/1")
    page.wait_for_selector(".look[data-ready]")
    page.locator(".space").scroll_into_view_if_needed()
    page.wait_for_selector(".space[data-ready]")
    for frame in (0, 7, 59, 60, 201, 239, 33):  # on both sides of whole seconds and key frames, forwards and back
        page.locator("#position").fill(str(frame))
        page.wait_for_selector(f"canvas.body[data-frame='{frame}']")
        assert settled(page) == frame
    for key, way in ((".", 1), (".", 1), (",", -1), (".", 1)):
        before = settled(page)
        page.locator("#position").press(key)
        page.wait_for_selector(f"canvas.body[data-frame='{before + way}']")
        assert settled(page) == before + way
    for speed in ("1", "0.5"):
        page.locator("#speed").select_option(speed)
        before = settled(page)
        page.get_by_role("button", name="Play").click()
        page.wait_for_selector(f"canvas.body:not([data-frame='{before}'])")
        for _ in range(1000):
            if int(page.locator("canvas.body").get_attribute("data-frame")) > before + 3:
                break
            page.wait_for_timeout(30)
        page.get_by_role("button", name="Pause").click()
        assert settled(page) > before + 3
    page.get_by_label("Points").check()
    page.wait_for_selector("canvas.body[data-points]")
    settled(page)
