"""Choosing the person to be measured in the video itself, in a Chromium of the machine."""

from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import reading, tracking
from pbl_schemas.review import Decision
from pbl_workers.populate import populate
from tests import StandIn
from tests.integration import web
from tests.integration.chain import small_video
from tests.integration.test_visit_contract import track_people
from tests.rows import register


@pytest.fixture
def seen(tables: None, stand_in: StandIn) -> None:
    """The people of the stand-in within the picture: it sees them in one of 1920 x 1080 px."""
    stand_in(track_people=track_people)


@pytest.fixture
def two_alike(seen: None, tmp_path: Path) -> int:
    """A video in which somebody has to be chosen."""
    number = register(small_video(tmp_path, "walk", people="two alike"), session_label="2026-01-10")[0]
    populate()
    return number


def test_boxes_are_those_of_the_tracking(two_alike: int):
    browser = web.client(role="reader")
    found = browser.get(f"/recordings/{two_alike}/boxes?method=0").json()
    (key,) = tracking.Tracking().keys()
    tracked = reading.load_tracking(key)
    assert found["size"] == list(tracked.image_size_px)
    assert len(found["time"]) == len(tracked.time_s)
    for one, person in zip(found["people"], tracked.persons, strict=True):
        assert one["number"] == person.person_id
        assert one["boxes"][7] == [*(round(float(v)) for v in person.box_px[7]), 1]
    for forged in ("1", "-1", "x", "9999"):
        assert browser.get(f"/recordings/{two_alike}/boxes?method={forged}").status_code == 404
    assert browser.get("/recordings/999/boxes").status_code == 404


@pytest.mark.parametrize("way", ["click", "key", "tab"])
def test_from_a_click_on_a_person_to_the_row(chromium: Any, two_alike: int, way: str):
    with web.shown(chromium, name="A. First") as page:
        page.goto(f"/recordings/{two_alike}")
        page.wait_for_selector(".boxes[data-ready] .box[data-person='2']")
        box = page.locator(".box[data-person='2']")
        # It lies where the tracking saw the person in the frame that is shown.
        frame, shown = int(page.locator(".boxes").get_attribute("data-frame")), box.bounding_box()
        stage = page.locator(".stage").bounding_box()
        tracked = reading.load_tracking(tracking.Tracking().keys()[0])
        x0, y0, *_ = tracked.persons[1].box_px[frame] / [*tracked.image_size_px, *tracked.image_size_px]
        assert shown["x"] == pytest.approx(stage["x"] + x0 * stage["width"], abs=2)
        assert shown["y"] == pytest.approx(stage["y"] + y0 * stage["height"], abs=2)
        with page.expect_navigation():
            if way == "click":
                page.mouse.click(shown["x"] + shown["width"] - 4, shown["y"] + shown["height"] / 2)
            elif way == "key":
                page.keyboard.press("2")
            else:
                box.focus()
                page.keyboard.press("Enter")
        assert page.url.endswith(f"/recordings/{two_alike}")
    assert tracking.SubjectOverride.fetch1("override_person_id") == 2
    (row,) = Decision().to_dicts()
    assert (row["decision_by"], row["decision_after"]) == ("A. First", {"person": 2})


def test_another_person_is_chosen_only_where_that_is_asked_for(chromium: Any, seen: None, tmp_path: Path):
    number = register(small_video(tmp_path, "walk"), session_label="2026-01-10")[0]
    populate()
    with web.shown(chromium, role="reader") as page:  # who looks sees the boxes and can send none
        page.goto(f"/recordings/{number}")
        page.wait_for_selector("[data-ready]")
        page.get_by_role("button", name="Choose in the video").click()
        page.wait_for_selector(".box[data-person='2']", state="attached")
        assert page.locator(".box:enabled").count() == 0
        page.keyboard.press("2")
        page.wait_for_timeout(300)
        assert not tracking.SubjectOverride()
    with web.shown(chromium) as page:
        page.goto(f"/recordings/{number}")
        page.wait_for_selector("[data-ready]")
        page.keyboard.press("2")
        page.wait_for_timeout(300)
        assert not tracking.SubjectOverride()
        page.get_by_role("button", name="Choose in the video").click()
        page.wait_for_selector(".boxes[data-ready]")
        with page.expect_navigation():
            page.keyboard.press("2")
    assert tracking.SubjectOverride.fetch1("override_person_id") == 2
