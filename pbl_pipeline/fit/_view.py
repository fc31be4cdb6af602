"""Which frames of a trial count: those with the whole person in view (the paper, section Keypoint Detection)."""

from __future__ import annotations

import itertools

import numpy as np

from pbl_pipeline.keypoints import Keypoints

#: Share of the markers that must have been detected for a frame to say anything about the pose.
SEEN_SHARE = 0.5
#: Share of the markers that must lie inside the picture.
INSIDE_SHARE = 0.95


def whole_person_in_view(keypoints: Keypoints, min_confidence: float) -> np.ndarray:
    """(T,) bool: nearly all markers are detected inside the picture, with a mean confidence of `min_confidence`.

    The mean and not each marker: in a view from the side the far arm is hidden in every frame, and the person is in
    view all the same. Markers that the detector never gives in this trial say nothing of a single frame and do not
    count, unless they are most of them.
    """
    given = np.any(keypoints.confidence > 0, axis=0)
    if given.mean() < SEEN_SHARE:
        return np.zeros(len(keypoints.time_s), bool)
    width, height = keypoints.image_size_px
    xy = np.nan_to_num(keypoints.xy_px, nan=-1.0)
    inside = (xy[..., 0] >= 0) & (xy[..., 0] <= width) & (xy[..., 1] >= 0) & (xy[..., 1] <= height)
    inside &= keypoints.confidence > 0
    confidence = keypoints.confidence[:, given]
    return (inside[:, given].mean(axis=1) >= INSIDE_SHARE) & (confidence.mean(axis=1) >= min_confidence)


def bridge_gaps(in_view: np.ndarray, time_s: np.ndarray, max_gap_s: float) -> np.ndarray:
    """Frames to use: those in view and those inside a gap between two of them that is shorter than `max_gap_s`."""
    used = in_view.copy()
    index = np.flatnonzero(in_view)
    for a, b in itertools.pairwise(index):
        if b > a + 1 and time_s[b] - time_s[a] < max_gap_s:
            used[a:b] = True
    return used


def blind_runs(seen: np.ndarray, time_s: np.ndarray, max_blind_s: float) -> np.ndarray:
    """(T,) bool: frames in unbroken runs without sight of the person, longer than `max_blind_s`.

    Partial view may be bridged; where nothing was seen there is nothing to fit, and a trajectory that swings freely
    through such a hole invents movement (on a synthetic walker up to 50 deg at the knee within 0.9 s).
    """
    blind = np.zeros(len(seen), bool)
    index = np.flatnonzero(seen)
    for a, b in itertools.pairwise(index):
        if b > a + 1 and time_s[b] - time_s[a] > max_blind_s:
            blind[a + 1 : b] = True
    return blind


def longest_run_s(used: np.ndarray, time_s: np.ndarray) -> float:
    """Length (s) of the longest unbroken run of used frames."""
    best, start = 0.0, None
    for i, u in enumerate(used):
        if u and start is None:
            start = i
        if u and start is not None:
            best = max(best, float(time_s[i] - time_s[start]))
        if not u:
            start = None
    return best
