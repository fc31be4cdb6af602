"""A recording in the review page: its video by ranges, the body and the curves as numbers."""

from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.render import body_track
from pbl_schemas import fit, reading, video
from pbl_workers.populate import populate
from pbl_workers.web.movement import METRE_STEPS, TURN_STEPS
from tests import Environment, not_none
from tests.integration import web
from tests.integration.chain import N_FRAMES, small_video
from tests.rows import register


@pytest.fixture(scope="module")
def looked_at(module_tables: Path):
    """Videos 1 (fitted) and 2 (nobody in it), and the file of 1."""
    path = small_video(module_tables, "walk")
    ids = register(path, session_label="2026-01-10")
    ids += register(small_video(module_tables, "none", people="nobody"), session_label="2026-02-10")
    populate()
    return path, *ids


def test_a_page_of_a_recording(looked_at):
    _, walk, nobody = looked_at
    browser = web.client()
    page = browser.get(f"/recordings/{walk}").text
    assert f'src="/recordings/{walk}/video"' in page
    assert "initial contact" in page
    assert f"{N_FRAMES} frames" in page
    empty = browser.get(f"/recordings/{nobody}").text
    assert "No body is fitted" in empty
    assert "nobody" in empty
    assert browser.get(f"/recordings/{nobody}/movement").status_code == 404
    for forged in (0, 999, 2**31, 10**30):
        for what in ("", "/video", "/movement", "/body"):
            assert browser.get(f"/recordings/{forged}{what}").status_code == 404


def test_the_body_that_is_sent_is_that_of_the_fit(looked_at):
    """What the page's script makes of it is compared with the overlay in tests/unit/test_web_scripts.py."""
    _, walk, _ = looked_at
    browser = web.client()
    body = browser.get(f"/recordings/{walk}/movement").json()["body"]
    assert fit.trial_key(walk) is not None
    track = body_track(not_none(reading.load_recording(walk).fit))
    low, high = np.frombuffer(browser.get(f"/recordings/{walk}/body").content, np.uint8).reshape(2, -1, N_FRAMES)
    again = (low.astype(np.uint16) | high.astype(np.uint16) << 8).astype(np.int16).astype(np.int64)
    changes = np.concatenate([again[:, :1], np.cumsum(again[:, 1:], axis=1)], axis=1)
    found = np.cumsum(changes, axis=1).T
    assert body["known"] == [[0, N_FRAMES - 1]]
    np.testing.assert_allclose(found[:, :3] / METRE_STEPS + body["start"], track.root_m, atol=0.5 / METRE_STEPS + 1e-6)
    turns = found[:, 3:-4].reshape(N_FRAMES, -1, 4) / TURN_STEPS
    np.testing.assert_allclose(turns, track.quat_wxyz, atol=0.5 / TURN_STEPS + 1e-9)


def test_curves_events_and_what_is_uncertain(looked_at):
    from pbl_pipeline.gait import leg_angles

    _, walk, _ = looked_at
    found = web.client().get(f"/recordings/{walk}/movement").json()
    assert fit.trial_key(walk) is not None
    about = reading.load_recording(walk)
    assert len(found["time"]) == N_FRAMES
    knee = next(c for c in found["curves"] if c["name"] == "Knee flexion")
    np.testing.assert_allclose(
        knee["left"]["value"], leg_angles(not_none(about.fit))["left"]["knee_flexion"], atol=0.006
    )
    assert len(found["events"]) == len(not_none(about.events).events) > 4
    far = {c.far_leg for c in about.cycles}
    for side in ("left", "right"):
        spans = found["uncertain"][side]
        if side in far:
            assert any(a <= c.start_s <= b for c in about.cycles if c.far_leg == side for a, b in spans)


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ("bytes=0-99", 206),
        ("bytes=-50", 206),
        ("bytes=100-", 206),
        ("bytes=0-0,-1", 206),
        ("bytes=99999999999-", 416),
        ("bytes=50-10", 400),
        ("bytes=x-y", 400),
        ("lines=0-1", 400),
        ("bytes=" + ",".join(["0-"] * 5000), 200),
        ("bytes=" + ",".join(["0-"] * 90), 206),
    ],
)
def test_ranges_of_a_video(looked_at, asked: str, status: int):
    path, walk, _ = looked_at
    whole = path.read_bytes()
    answer = web.client().get(f"/recordings/{walk}/video", headers={"range": asked})
    assert answer.status_code == status
    assert len(answer.content) <= len(whole)  # many ranges over each other are not sent many times
    expected = {"bytes=0-99": whole[:100], "bytes=-50": whole[-50:], "bytes=100-": whole[100:]}
    if asked in expected:
        assert answer.content == expected[asked]
    assert answer.headers["content-security-policy"]


def test_a_video_that_is_gone_leaves_the_rest(looked_at):
    path, walk, _ = looked_at
    away = path.rename(path.with_suffix(".away"))
    try:
        browser = web.client()
        page = browser.get(f"/recordings/{walk}")
        assert page.status_code == 200
        assert "VIDEO_MISSING" in page.text
        assert "<video" not in page.text
        assert browser.get(f"/recordings/{walk}/video").status_code == 404
        assert browser.get(f"/recordings/{walk}/movement").status_code == 200
    finally:
        away.rename(path)


def test_where_heads_are_to_be_hidden_the_original_is_never_sent(looked_at, environment: Environment):
    _, walk, _ = looked_at
    environment(PBL_DEIDENTIFY="blur")
    browser = web.client()
    assert browser.get(f"/recordings/{walk}/video").status_code == 404
    page = browser.get(f"/recordings/{walk}").text
    assert "no de-identified copy" in page
    assert "<video" not in page


def test_a_fit_of_another_body_says_so(looked_at, monkeypatch: pytest.MonkeyPatch):
    import dataclasses

    from pbl_schemas.reading import visits

    _, walk, _ = looked_at
    load = visits.load_trial_fit
    other_body = lambda *a: dataclasses.replace(load(*a), body_sha256="0" * 64)  # noqa: E731
    monkeypatch.setattr(visits, "load_trial_fit", other_body)
    answer = web.client().get(f"/recordings/{walk}/body")
    assert answer.status_code == 409
    assert "install the version that made the fit" in answer.text


def test_a_lost_file_of_the_fit_says_so(looked_at, monkeypatch: pytest.MonkeyPatch):
    from pbl_schemas.reading import objects

    _, walk, _ = looked_at
    assert fit.SessionFit.Trial & {"video_id": walk}
    assert video.Video & {"video_id": walk}
    monkeypatch.setattr(objects, "file_ref", lambda value: {"path": "gone.npz", "store": "arrays", "size": 1})
    answer = web.client().get(f"/recordings/{walk}/movement")
    assert answer.status_code == 409
    assert "Restore the object store" in answer.text
