"""Exchanged sides are put back, and legs that cross are left alone: synthetic people seen with a detector's noise."""

import dataclasses
import functools

import numpy as np
import pytest

from pbl_pipeline.body import SCALE_NAMES
from pbl_pipeline.keypoints import Keypoints, check_keypoints
from pbl_pipeline.keypoints.flips import Exchange, FlipParams, exchange_sides, exchanged, lowered, mirror_of
from pbl_pipeline.synthetic import SynthSpec, synth, synthesise

pytestmark = pytest.mark.slow

_synth_physique = synth.physique


@functools.cache
def seen(task: str = "walk", view: str = "sagittal", fps: float = 30.0) -> Keypoints:
    seconds = 4.0 if task == "walk" else None
    spec = SynthSpec(task=task, view=view, fps=fps, seconds=seconds, camera="panned", marker_set="blazepose_33")
    return synthesise(spec).keypoints


def arrays(keypoints: Keypoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return keypoints.xy_px, keypoints.xyz_cam_m, keypoints.confidence


def judged(keypoints: Keypoints, spoiled: Exchange | None = None) -> Exchange:
    xy, xyz, confidence = arrays(keypoints)
    if spoiled is not None:
        xy, xyz, confidence = (exchanged(v, spoiled, keypoints.names) for v in (xy, xyz, confidence))
    return exchange_sides(keypoints.time_s, keypoints.names, xy, xyz, confidence)


def spoil(n_frames: int, what: str, first: int, length: int) -> Exchange:
    rows, none = np.zeros(n_frames, bool), np.zeros(n_frames, bool)
    rows[first : first + length] = True
    return Exchange(rows if what != "rest" else none, rows if what != "legs" else none, none)


WALKS = [("walk", view, fps) for fps in (30.0, 60.0) for view in ("sagittal", "frontal", "oblique")]


@pytest.mark.parametrize(
    ("task", "view", "fps"), [*WALKS, ("sit_to_stand", "sagittal", 30.0), ("tug", "sagittal", 30.0)]
)
def test_legs_that_cross_sitting_down_and_turning_are_left_alone(task, view, fps):
    found = judged(seen(task, view, fps))
    assert not found.legs.any()
    assert not found.rest.any()


@pytest.mark.parametrize("length", [1, 3, 10])
@pytest.mark.parametrize("what", ["both", "legs", "rest"])
@pytest.mark.parametrize("view", ["sagittal", "frontal"])
def test_exchanged_sides_are_put_back(view, what, length):
    keypoints = seen(view=view)
    n = len(keypoints.time_s)
    # Everywhere in the walk, so that single and double support and the moments of crossing are among them.
    for first in range(7, n - length - 5, 11):
        spoiled = spoil(n, what, first, length)
        found = judged(keypoints, spoiled)
        np.testing.assert_array_equal(found.legs, spoiled.legs, err_msg=f"from frame {first}")
        np.testing.assert_array_equal(found.rest, spoiled.rest, err_msg=f"from frame {first}")


@pytest.mark.parametrize("view", ["sagittal", "oblique", "frontal"])
@pytest.mark.parametrize("short", [("left_thigh",), ("left_leg_and_foot",), ("left_thigh", "left_leg_and_foot")])
def test_legs_of_very_different_length_are_neither_exchanged_nor_mistaken(monkeypatch, short, view):
    """One leg's thigh, shank or both 30 % shorter: which side is which is told by the movement, not by the lengths."""

    def physique(seed, markers):
        scale, offsets = _synth_physique(seed, markers)
        return np.where(np.isin(SCALE_NAMES, short), 0.7, 1.0) * scale, offsets

    monkeypatch.setattr(synth, "physique", physique)
    keypoints = seen.__wrapped__(view=view)
    hip, knee, ankle = (keypoints.xyz_cam_m[:, keypoints.names.index(f"left_{n}")] for n in ("hip", "knee", "ankle"))
    assert not judged(keypoints).table.any()
    right = [keypoints.xyz_cam_m[:, keypoints.names.index(f"right_{n}")] for n in ("hip", "knee", "ankle")]
    ratio = [
        np.nanmedian(np.linalg.norm(a - b, axis=1)) / np.nanmedian(np.linalg.norm(c - d, axis=1))
        for a, b, c, d in ((hip, knee, *right[:2]), (knee, ankle, *right[1:]))
    ]
    assert min(ratio) < 0.85  # the legs are as unlike as was asked for, as seen by the detector
    n = len(keypoints.time_s)
    for first, length in ((20, 3), (50, 10), (80, 1)):
        spoiled = spoil(n, "legs", first, length)
        np.testing.assert_array_equal(judged(keypoints, spoiled).table, spoiled.table)


def test_at_any_rate_of_frames_and_over_a_gap():
    keypoints = seen(fps=240.0)
    n = len(keypoints.time_s)
    for length in (2, 24, 120):  # 8 ms to half a second
        spoiled = spoil(n, "both", 401, length)
        np.testing.assert_array_equal(judged(keypoints, spoiled).legs, spoiled.legs)
    slow = seen()
    spoiled = spoil(len(slow.time_s), "both", 60, 12)
    lost = [v.copy() for v in arrays(slow)]
    lost[0][58:62], lost[1][58:62], lost[2][58:62] = np.nan, np.nan, 0.0
    xy, xyz, confidence = (exchanged(v, spoiled, slow.names) for v in lost)
    found = exchange_sides(slow.time_s, slow.names, xy, xyz, confidence)
    np.testing.assert_array_equal(found.legs[62:], spoiled.legs[62:])


def test_nothing_seen_no_3d_and_names_without_sides():
    keypoints = seen()
    xy, xyz, confidence = arrays(keypoints)
    empty = exchange_sides(keypoints.time_s, keypoints.names, np.nan * xy, np.nan * xyz, 0 * confidence)
    assert not empty.table.any()
    spoiled = spoil(len(xy), "both", 40, 5)
    flat = exchange_sides(
        keypoints.time_s, keypoints.names, exchanged(xy, spoiled, keypoints.names), np.nan * xyz, confidence
    )
    # Of somebody seen from the side the picture alone says little: nothing is exchanged that was right.
    assert not (flat.legs & ~spoiled.legs).any()
    assert not (flat.rest & ~spoiled.rest).any()
    names = tuple(f"marker{i}" for i in range(33))
    assert mirror_of(names) is None
    assert not exchange_sides(keypoints.time_s, names, xy, xyz, confidence).table.any()


def test_the_picture_alone_tells_the_sides_of_somebody_seen_from_the_front():
    keypoints = seen(view="frontal")
    spoiled = spoil(len(keypoints.time_s), "both", 40, 5)
    xy, xyz, confidence = (exchanged(v, spoiled, keypoints.names) for v in arrays(keypoints))
    found = exchange_sides(keypoints.time_s, keypoints.names, xy, np.nan * xyz, confidence)
    np.testing.assert_array_equal(found.legs, spoiled.legs)
    np.testing.assert_array_equal(found.rest, spoiled.rest)


def test_a_body_without_width_is_marked_and_bridged():
    """What a network gives that cannot decide between front and back: both sides in the middle."""
    keypoints = seen(view="frontal")
    n, names = len(keypoints.time_s), keypoints.names
    spoiled = spoil(n, "both", 50, 6)
    xy, xyz, confidence = (exchanged(v, spoiled, names) for v in arrays(keypoints))
    for row in (49, 56):  # as the sides change
        for v in (xy, xyz):
            v[row] = (v[row] + v[row][mirror_of(names)]) / 2
    found = exchange_sides(keypoints.time_s, names, xy, xyz, confidence)
    np.testing.assert_array_equal(np.flatnonzero(found.narrow), [49, 56])
    keep = np.setdiff1d(np.arange(n), [49, 56])
    np.testing.assert_array_equal(found.legs[keep], spoiled.legs[keep])
    np.testing.assert_array_equal(found.rest[keep], spoiled.rest[keep])


def test_confidence_is_lowered_where_sides_were_exchanged():
    names = ("left_knee", "right_knee", "left_shoulder", "right_shoulder")
    rows = np.array([[0.8, 0.4, 0.6, 0.2]] * 3)
    on, off = np.array([True, False, False]), np.zeros(3, bool)
    exchange = Exchange(on, off, np.array([False, False, True]))
    low = lowered(rows, exchange, names, FlipParams(lower=0.5, lower_narrow=0.1))
    np.testing.assert_allclose(low, [[0.2, 0.4, 0.6, 0.2], [0.8, 0.4, 0.6, 0.2], [0.08, 0.04, 0.06, 0.02]])


def test_the_check_counts_the_frames():
    keypoints = seen()

    def outcome(share: float) -> str:
        changed = np.zeros((len(keypoints.time_s), 3), bool)
        changed[: round(share * len(changed)), 0] = True
        checks = check_keypoints(dataclasses.replace(keypoints, sides_changed=changed))
        check = next(c for c in checks if c.check == "sides_exchanged_share")
        assert check.value == pytest.approx(share, abs=0.01)
        return check.outcome

    assert [outcome(s) for s in (0.0, 0.1, 0.5)] == ["PASS", "WARN", "FAIL"]
    assert not any(c.check == "sides_exchanged_share" for c in check_keypoints(keypoints))
