"""The review page for everybody: axe finds nothing serious on any page, and nothing sticks out, is cut or covered."""

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_schemas.intake.records import set_condition
from pbl_workers.populate import populate
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import register
from tests.videos import constant_rate, numbered_frames, write_video

#: What a page of each kind needs until everything on it is there.
PAGES = {
    "list": ("/visits", ""),
    "visit": ("/visits/1", ""),
    "recording": ("/recordings/1", ".look[data-ready]"),
    "choice": ("/recordings/2", ".boxes[data-ready]"),
    "nobody": ("/recordings/3", ""),
    "overlay": ("/recordings/1/overlay", ""),
    "report": ("/visits/1/report", ""),
    "compare": ("/compare?v=1.0&v=4", ""),
    "trend": ("/visits/1/trend", ""),
    "tasks": ("/visits/3/trend?measure=sit_to_stand.peak_trunk_lean_deg", ""),
    "letter": ("/visits/1/letter", ""),
    "refused": ("/recordings/5", ""),
    "enter": ("/visits/1/enter", ""),
    "new": ("/visits/new", ""),
    "facts": ("/visits/1/facts", ""),
    "upload": ("/visits/1/upload", ""),
    "instruments": ("/instruments", ""),
    "operate": ("/operate", ""),
    "missing": ("/recordings/99", ""),
    "away": ("/nothing", ""),
}
#: Rules of axe that are looked at: those of WCAG 2.2, levels A and AA, and its own good practice.
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
#: In the page: elements with text that are wider than their box shows, that leave the window or cover another control.
LAYOUT = """
() => {
  const bad = [], name = (e) => `${e.tagName.toLowerCase()}.${e.className || e.id} "${(e.textContent || e.value || "").trim().slice(0, 30)}"`;
  if (document.documentElement.scrollWidth > innerWidth) bad.push(`the page scrolls sideways: ${document.documentElement.scrollWidth}`);
  const clipped = (e) => e && (getComputedStyle(e).clipPath !== "none" || clipped(e.parentElement));
  const shown = (e) => e.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && !clipped(e) && !e.closest(".skip, .scroll, noscript, .uplot, details:not([open]) > :not(summary)");
  for (const e of document.querySelectorAll("body *")) {
    if (!shown(e)) continue;
    const box = e.getBoundingClientRect(), style = getComputedStyle(e);
    if (box.width < 2) continue;
    if (box.right > innerWidth + 1 || box.left < -1) bad.push(`outside: ${name(e)}`);
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (own && style.overflowX !== "visible" && e.scrollWidth > e.clientWidth + 1) bad.push(`cut: ${name(e)}`);
  }
  const controls = [...document.querySelectorAll("main button, main input, main select, main summary, main .buttons label")].filter((e) => shown(e) && !e.closest(".boxes"));
  controls.forEach((a, i) => controls.slice(i + 1).forEach((b) => {
    if (a.contains(b) || b.contains(a)) return;
    const p = a.getBoundingClientRect(), q = b.getBoundingClientRect();
    const w = Math.min(p.right, q.right) - Math.max(p.left, q.left), h = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
    if (w > 1 && h > 1) bad.push(`over each other: ${name(a)}, ${name(b)}`);
  }));
  return bad;
}
"""  # noqa: E501


@pytest.fixture(scope="module")
def visits(chromium: Any, module_tables: Path) -> None:
    """Video 1 with a fit, 2 in which somebody has to be chosen, 3 with nobody; a long label among the
    visits; 4 a later walk of the same person, 5 a screen recording."""
    walk, two = small_video(module_tables, "walk"), small_video(module_tables, "two", people="two alike")
    register(walk, session_label="2026-01-10")
    register(two, session_label="after the second operation, left knee")
    nobody = register(small_video(module_tables, "none", people="nobody"), subject="P002", session_label="2026-02-10")
    set_condition(nobody[0], activity="sit_to_stand")
    register(small_video(module_tables, "later"), session_label="2026-04-10")
    of_screen = (np.pad(f, ((20, 20), (0, 0), (0, 0))) for f in numbered_frames(60, 72, 128))
    register(write_video(module_tables / "screen.mp4", of_screen, constant_rate(60)), subject="P003")
    populate()


def go(page: Any, kind: str) -> None:
    address, until = PAGES[kind]
    # A page that waits for a file would load itself again at any moment, also while the next one is opened.
    page.route("**/static/making.js", lambda route: route.fulfill(body="", content_type="text/javascript"))
    answer = page.goto(address)
    assert answer.status == (404 if kind in ("missing", "away") else 200), kind
    if until:
        page.wait_for_selector(until, state="attached")
    if kind == "recording":
        page.locator(".space").scroll_into_view_if_needed()
        page.wait_for_selector(".space[data-ready]")


def serious(page: Any, kind: str, run: object) -> dict[str, list[tuple[str, str]]]:
    """What axe finds by the rules of `run`: "page: rule" to the elements and what is wrong with each."""
    result = page.evaluate("(run) => axe.run(document, run)", run)
    assert result["passes"], kind
    return {
        f"{kind}: {v['id']}": [(n["html"][:200], n["failureSummary"]) for n in v["nodes"]]
        for v in result["violations"]
        if v["impact"] in ("serious", "critical")
    }


@pytest.mark.long
def test_axe_finds_nothing_serious_and_every_width_holds_the_page(chromium: Any, visits: None, axe: str):
    found: dict[str, object] = {}
    with web.shown(chromium, "reviewer,operator", (1200, 900), bypass_csp=True, refused=True) as page:
        for kind in PAGES:
            go(page, kind)
            for width in (1200, 768, 390):
                page.set_viewport_size({"width": width, "height": 900})
                page.wait_for_timeout(100)  # what follows the width is drawn anew
                found[f"{kind} at {width} px"] = page.evaluate(LAYOUT)
            for details in page.locator("summary").all():
                details.click()
            page.evaluate(axe)
            found |= serious(page, kind, {"runOnly": TAGS})
            page.emulate_media(color_scheme="dark")
            found |= serious(page, f"{kind}, dark", {"runOnly": ["color-contrast", "link-in-text-block"]})
            page.emulate_media(color_scheme="light")
            page.set_viewport_size({"width": 1200, "height": 900})
        # Both would see it.
        page.evaluate(
            "document.querySelector('main').insertAdjacentHTML('afterbegin', '<img src=\"/static/icon.svg\">"
            '<p style="width: 2000px; max-width: none">x</p>'
            '<p style="overflow: hidden; white-space: nowrap; width: 9px">cut</p>'
            '<button>a</button><button style="margin-left: -20px">b</button>\')'
        )
        assert "planted: image-alt" in serious(page, "planted", {"runOnly": TAGS})
        seen = " ".join(page.evaluate(LAYOUT))
        assert all(what in seen for what in ("scrolls sideways", "outside", "cut", "over each other")), seen
    assert not any(found.values()), {what: bad for what, bad in found.items() if bad}


def test_german_fits_on_a_phone(chromium: Any, visits: None):
    """Its words are the longest, and a phone is the narrowest."""
    found = {}
    with web.shown(chromium, "reviewer,operator", locale="de", refused=True) as page:
        for kind in PAGES:
            go(page, kind)
            found[kind] = page.evaluate(LAYOUT)
        assert page.get_by_role("link", name="Ganganalyse").count()
    assert not any(found.values()), {kind: bad for kind, bad in found.items() if bad}


@pytest.mark.long
def test_pictures_of_every_page(chromium: Any, visits: None, tmp_path: Path):
    """At two widths, in both languages, light and dark: into the folder PBL_TEST_PICTURES, to be looked at."""
    folder, found = Path(os.environ.get("PBL_TEST_PICTURES", tmp_path)), {}
    for language in ("en", "de"):
        with web.shown(chromium, "reviewer,operator", locale=language, refused=True) as page:
            for kind in PAGES:
                go(page, kind)
                for width, scheme in itertools.product((390, 1200), ("light", "dark")):
                    page.set_viewport_size({"width": width, "height": 900})
                    page.emulate_media(color_scheme=scheme)
                    page.wait_for_timeout(150)
                    name = f"{kind}.{language}.{width}.{scheme}"
                    page.screenshot(path=folder / f"{name}.png", full_page=True)
                    found[name] = page.evaluate(LAYOUT)
    assert not any(found.values()), {what: bad for what, bad in found.items() if bad}
