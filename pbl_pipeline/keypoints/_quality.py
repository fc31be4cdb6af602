"""Checks of the keypoints of one trial: how much was seen, how sure, and whether left and right stayed where they were.

A body from the front and the same from behind, with the sides exchanged, give nearly one outline. Where the face tells
nothing (pixelated for privacy, against the light) a network may answer with either, and change its mind within a trial.
Which of the two is right cannot be told from the movement alone: the sequence that moves least may be the wrong one
throughout. So such a trial is reported, not repaired.
"""

from __future__ import annotations

import numpy as np

from pbl_pipeline.qc import EMPTY, FAIL, PASS, WARN, Check

from ._types import Keypoints

#: Nobody turns by this much between neighbouring frames (deg); single frames of noise stay below.
_TURN_DEG = 90.0
_LONGEST_STEP_S = 0.2
_LEGS = ("hip", "knee", "ankle", "heel", "foot_index")


def check_keypoints(keypoints: Keypoints) -> tuple[Check, ...]:
    """Checks `frames_seen_s`, `leg_confidence` and, where the points have sides, `side_changes`."""
    seen = keypoints.confidence.max(axis=1) > 0
    if not seen.any():
        return (Check("frames_seen_s", EMPTY, 0.0, 1.0, "no frame shows the person"),)
    time = keypoints.time_s
    seconds = float(seen.sum()) * (float(time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 0.0)
    advice = "" if seconds >= 3.0 else "fewer than about three strides are in view: film a longer walk"
    checks = [Check("frames_seen_s", PASS if seconds >= 3.0 else WARN, seconds, 3.0, advice)]
    legs = [i for i, n in enumerate(keypoints.names) if n.startswith(("left_", "right_")) and n.endswith(_LEGS)]
    if legs:
        mean = float(keypoints.confidence[np.ix_(seen, legs)].mean())
        advice = (
            "" if mean >= 0.6 else "the legs are hidden or hard to see: film the whole body from the side, in light"
        )
        checks.append(Check("leg_confidence", PASS if mean >= 0.6 else WARN, mean, 0.6, advice))
    if {"left_hip", "right_hip"} <= set(keypoints.names):
        changes = len(side_changes(keypoints))
        outcome = PASS if changes == 0 else WARN if changes <= 0.02 * seen.sum() else FAIL
        advice = (
            ""
            if changes == 0
            else "left and right change places between frames: look at the overlay; film from the side"
        )
        checks.append(Check("side_changes", outcome, float(changes), 0.0, advice))
    return tuple(checks)


def side_changes(keypoints: Keypoints) -> np.ndarray:
    """Frames (K,) at which the axis from left to right hip has turned by more than 90 degrees since the last one seen
    (at most 0.2 s ago): there the sides were exchanged."""
    axis = (
        keypoints.xyz_cam_m[:, keypoints.names.index("right_hip")]
        - keypoints.xyz_cam_m[:, keypoints.names.index("left_hip")]
    ).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(axis).all(axis=1) & (np.linalg.norm(axis, axis=1) > 0))
    axis = axis[rows] / np.linalg.norm(axis[rows], axis=1, keepdims=True)
    turned = np.einsum("ij,ij->i", axis[1:], axis[:-1]) < np.cos(np.radians(_TURN_DEG))
    return rows[1:][turned & (np.diff(keypoints.time_s[rows]) <= _LONGEST_STEP_S)]
