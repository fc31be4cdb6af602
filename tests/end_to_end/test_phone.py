"""From the link of a visit to its index: a Chromium films the demo recording, with orientations as sensors, and the
same pictures come as a file. Minutes, and two idle cores: a loaded machine loses frames. `pytest -m machine`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from pbl_pipeline.video import probe, read_frames
from schemas import fit, gdi, session, video
from schemas.capture import PhoneRecording
from schemas.intake import Sensors, VisitRecord, ingest
from tests.integration.test_web_phone import new_visit
from tests.integration.test_web_phone_browser import UPRIGHT, filming, turn, with_camera
from tests.rows import remove_all
from tests.videos import constant_rate, write_video
from workers.populate import populate

pytestmark = [pytest.mark.slow, pytest.mark.machine]
#: Frames (30 a second) in which the first picture stands still before the walk, and the last one after it.
BEFORE, AFTER = 150, 60


def pictures(demo: Path) -> Iterator[np.ndarray]:
    last = None
    for frame in read_frames(demo):
        for _ in range(1 + BEFORE * (last is None)):
            yield frame.image
        last = frame.image
    for _ in range(AFTER):
        assert last is not None
        yield last


def index_of(visit: int) -> float:
    return float((gdi.SessionGdi & {"session_id": visit}).fetch1("session_gdi"))


def test_the_index_of_a_phone_is_that_of_the_same_pictures_as_a_file(
    database: Path, chromium: Any, demo_files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    schemas.activate()
    remove_all()
    monkeypatch.setenv("PBL_ARCHIVE", str(tmp_path / "archive"))
    demo = demo_files["demo_video"]
    n = BEFORE + AFTER + sum(1 for _ in read_frames(demo))
    visit = new_visit("2026-01-10")
    with with_camera(chromium, tmp_path / "walk.mjpeg", pictures(demo)) as browser, filming(browser, visit) as page:
        page.locator(".allow").click()
        page.wait_for_timeout(1500)
        page.locator(".record").click()
        page.wait_for_selector("main[data-filming='yes']")
        for moment in range((n - 90) // 3):  # a hand that trembles a little, three times in ten frames
            wave = 0.0005 * np.sin(moment)
            turn(page, (UPRIGHT[0], UPRIGHT[1], float(wave), float(wave)))
            page.wait_for_timeout(70)
            if page.evaluate("document.querySelector('.clock').textContent") >= f"0:{(n - 90) // 30:02}":
                break
        page.locator(".record").click()
        page.wait_for_selector(".after:not([hidden])")
        page.locator(".keep").click()
        page.get_by_text("server has it").wait_for(timeout=60_000)
    about = PhoneRecording().fetch1("phone_about")
    (phone,) = (video.Video & {"session_id": visit}).to_dicts()
    (log,) = Path(phone["video_path"]).parent.glob("*.json")
    file = write_video(tmp_path / "walk.mp4", pictures(demo), constant_rate(n))
    ingest([file], VisitRecord("P001", "2026-02-01", camera_motion="handheld"), files=[Sensors(attitude=log)])
    populate()
    other = int((session.Session & {"session_label": "2026-02-01"}).fetch1("session_id"))
    trial = (fit.SessionFit.Trial & {"video_id": phone["video_id"]}).fetch1()
    assert trial["trial_orientation"] == "measured: phone"
    assert abs(trial["trial_clock_offset"]) <= 0.01
    assert index_of(visit) == pytest.approx(index_of(other), abs=1.0)
    # A loaded machine loses frames: then they are counted.
    filmed_s = float(probe(phone["video_path"]).time_s[-1])
    assert about["frames"] + about["dropped"] == pytest.approx(30 * filmed_s + 1, abs=0.02 * about["frames"])
