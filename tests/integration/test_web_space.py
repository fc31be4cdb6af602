"""The 3D view of a recording of 30 s in a Chromium of the machine, and what its page weighs."""

from pathlib import Path
from typing import Any

import pytest

from pbl_workers.populate import populate
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import register

#: Byte of everything but the video that a recording's page may load, as it comes over the line.
WEIGHT = 400_000


@pytest.fixture(scope="module")
def walk(chromium: Any, module_tables: Path) -> int:
    """A fitted recording of 30 s."""
    number = register(small_video(module_tables, "walk", 900), session_label="2026-01-10")[0]
    populate()
    return number


def changed(page: Any, before: bytes) -> bytes:
    """The 3D picture once it is another one."""
    for _ in range(1200):
        now = page.locator(".space-view").screenshot()
        if now != before:
            return now
        page.wait_for_timeout(50)
    raise AssertionError("the picture stays the same")


def opened(page: Any, number: int) -> Any:
    page.goto(f"/recordings/{number}")
    page.wait_for_selector(".look[data-ready]")
    page.locator(".space").scroll_into_view_if_needed()
    page.wait_for_selector(".space[data-ready]", timeout=60_000)
    return page


def test_the_3d_view_is_drawn_though_it_was_out_of_view_just_before(chromium: Any, walk: int):
    """A busy browser tells of several changes at once, of which the last one counts."""
    with web.shown(chromium, size=(1200, 900)) as page:
        page.add_init_script(
            "window.IntersectionObserver = class extends IntersectionObserver { constructor(told, options) {"
            " super((entries) => told([{ isIntersecting: false }, ...entries]), options); } };"
        )
        opened(page, walk)
        page.wait_for_selector(".space canvas[data-frame='0']")
        page.locator(".space-view").focus()
        last = page.locator(".space-view").screenshot()
        page.keyboard.press("ArrowLeft")
        changed(page, last)


def test_the_3d_view_turns_and_follows_the_time_line(chromium: Any, walk: int):
    with web.shown(chromium, size=(1200, 900)) as page:
        opened(page, walk)
        page.wait_for_selector(".space canvas[data-frame='0']")
        view = page.locator(".space-view")
        view.focus()
        last = view.screenshot()
        for key in ("ArrowLeft", "ArrowUp", "+", "Home"):
            page.keyboard.press(key)
            last = changed(page, last)
        page.keyboard.press("-")
        assert page.locator("#speed").input_value() == "1", "plus and minus are not the speed here"
        box, last = view.bounding_box(), changed(page, last)
        page.mouse.move(box["x"] + 200, box["y"] + 100)
        page.mouse.down()
        page.mouse.move(box["x"] + 300, box["y"] + 110, steps=3)
        page.mouse.up()
        changed(page, last)
        for name in ("From the side", "From the front", "From above", "As filmed"):
            page.get_by_role("button", name=name).click()
        page.locator("#position").fill("400")
        page.wait_for_selector("canvas.body[data-frame='400']")
        view.scroll_into_view_if_needed()  # it is not drawn while it is out of sight, as beside the time line
        page.wait_for_selector(".space canvas[data-frame='400']")
        # What the page weighs, with the 3D view and without the video.
        weights = page.evaluate(
            "() => [...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]"
            ".map((e) => [new URL(e.name).pathname, e.transferSize])"
        )
        weights = {name: size for name, size in weights if not name.endswith("/video")}
        assert {"/vendor/three-0.187.0.min.js", f"/recordings/{walk}/body"} <= set(weights)
        assert all(size > 0 for size in weights.values()), weights
        assert sum(weights.values()) <= WEIGHT, weights


def test_without_webgl_the_page_says_so_and_the_rest_works(chromium: Any, walk: int):
    with web.shown(chromium) as page:
        page.add_init_script(
            "const get = HTMLCanvasElement.prototype.getContext;"
            "HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
            " return kind.startsWith('webgl') ? null : get.call(this, kind, ...more); };"
        )
        page.goto(f"/recordings/{walk}")
        page.wait_for_selector(".look[data-ready]")
        page.locator(".space").scroll_into_view_if_needed()
        page.get_by_text("This browser cannot draw 3D").wait_for()
        assert not page.locator(".space-view").is_visible()
        page.locator("#position").fill("300")
        page.wait_for_selector("canvas.body[data-frame='300']")
