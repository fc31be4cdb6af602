"""Frames of a recording with the whole person in view, and those that count (the paper, section Keypoint Detection)."""

from __future__ import annotations

import dataclasses
import functools
import math
import re

import numpy as np

from pbl_pipeline.runs import runs
from pbl_pipeline.tracking import step_s
from pbl_pipeline.video import unknown_at

from .types import Keypoints

#: Fraction of the markers that must have been detected for a frame to count.
SEEN_SHARE = 0.5
#: Fraction of the markers that must lie inside the picture.
INSIDE_SHARE = 0.95
#: Least mean confidence over the markers of a frame; longest gap of partial view that is bridged; longest run without
#: sight of the person that is (`fit.ViewParams` has the same, frozen in its paramsets).
MIN_CONFIDENCE, MAX_GAP_S, MAX_BLIND_S = 0.5, 1.0, 0.15

#: Names of points on feet and head, in any marker set.
_FEET = re.compile(r"heel|toe|ankle|ankm|foot", re.IGNORECASE)
_HEAD = re.compile(r"nose|head|eye|cheek", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class Gap:
    """Frames between two with the whole person in view, from the last before to the first after them (s); `bridged` if
    short enough to count nevertheless."""

    start_s: float
    stop_s: float
    bridged: bool


@dataclasses.dataclass(frozen=True)
class Visibility:
    """Frames in which the person is in view."""

    time_s: np.ndarray  # (T,)
    seen: np.ndarray  # (T,) bool most points of the person were found
    whole: np.ndarray  # (T,) bool the whole person is in view (`whole_person_in_view`)
    counts: np.ndarray  # (T,) bool used by a fit: whole, or in a bridged gap; orientation of the phone known
    unoriented: np.ndarray  # (T,) bool in a hole of the phone's log

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Gaps between the first and the last frame with the whole person, also those of the phone's orientation."""
        time, counts = self.time_s, self.counts
        around = _around_gaps(self.whole & ~self.unoriented)
        return tuple(Gap(float(time[a]), float(time[b]), bool(counts[a : b + 1].all())) for a, b in around)

    @property
    def whole_share(self) -> float:
        """Fraction of all frames with the whole person in view."""
        return float(np.mean(self.whole)) if len(self.whole) else 0.0

    @property
    def first_s(self) -> float:
        """Time of the first frame with the whole person, NaN if there is none."""
        return float(self.time_s[self.whole][0]) if self.whole.any() else math.nan

    @property
    def last_s(self) -> float:
        """Time of the last frame with the whole person, NaN if there is none."""
        return float(self.time_s[self.whole][-1]) if self.whole.any() else math.nan

    @property
    def counts_s(self) -> float:
        """Time of the frames that count."""
        return float(np.sum(self.counts)) * step_s(self.time_s)

    def text(self) -> str:
        """Summary in one sentence."""
        if not self.whole.any():
            return "the whole person is never in view"
        words = f"the whole person is in view in {self.whole_share:.0%} of the frames, from {self.first_s:.1f} to "
        words += f"{self.last_s:.1f} s"
        if not self.gaps:
            return words + ", without a gap"
        spans = ", ".join(f"{g.start_s:.1f} to {g.stop_s:.1f} s" for g in self.gaps if not g.bridged)
        short = sum(g.bridged for g in self.gaps)
        parts = [f"not used: {spans}"] if spans else []
        if short:
            parts.append(f"{short} {'gap' if short == 1 else 'gaps'} of partial view under {MAX_GAP_S:g} s bridged")
        return f"{words}; {'; '.join(parts)}"


def visibility(
    keypoints: Keypoints,
    min_confidence: float = MIN_CONFIDENCE,
    max_gap_s: float = MAX_GAP_S,
    max_blind_s: float = MAX_BLIND_S,
) -> Visibility:
    """Find the frames of a trial of one camera that show the whole person, and those that count."""
    time = np.asarray(keypoints.time_s, float)
    whole = whole_person_in_view(keypoints, min_confidence)
    seen = np.mean(keypoints.confidence > 0, axis=1) >= SEEN_SHARE
    counts = bridge_gaps(whole, time, max_gap_s) & ~blind_runs(seen, time, max_blind_s)
    unoriented = unoriented_frames(keypoints)
    return Visibility(time, seen, whole, counts & ~unoriented, unoriented)


def unoriented_frames(keypoints: Keypoints) -> np.ndarray:
    """(T,) bool: frames in a hole of the phone's log that is too long to interpolate (`video.unknown_at`)."""
    time = np.asarray(keypoints.time_s, float)
    if keypoints.phone_time_s is None or keypoints.phone_quat_wxyz is None:
        return np.zeros(len(time), bool)
    return unknown_at(time, keypoints.phone_time_s, keypoints.phone_quat_wxyz)


def whole_person_in_view(keypoints: Keypoints, min_confidence: float) -> np.ndarray:
    """(T,) bool: nearly all markers are detected inside the picture, with a mean confidence of `min_confidence`.

    The mean, not each marker: in a view from the side the far arm is hidden in every frame, but the person is in view.
    Markers that are never detected in this trial do not count, unless they are most of them, or of a foot or the head
    of a person who reaches to that border: they may have been beyond it all the time.
    """
    given = np.any(keypoints.confidence > 0, axis=0)
    if given.mean() < SEEN_SHARE:
        return np.zeros(len(keypoints.time_s), bool)
    width, height = keypoints.image_size_px
    x, y = np.moveaxis(keypoints.xy_px, -1, 0)
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    inside &= keypoints.confidence > 0
    needed = np.tile(given, (len(inside), 1))
    for points, at_border in ends(keypoints):
        needed |= points & at_border[:, None]
    fraction = np.sum(inside & needed, axis=1) / np.sum(needed, axis=1)
    return (fraction >= INSIDE_SHARE) & (keypoints.confidence[:, given].mean(axis=1) >= min_confidence)


def ends(keypoints: Keypoints) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """For the feet and the lower border, then for the head and the upper one: their points (J,) bool, and the frames
    (T,) bool in which the person reaches to that border."""
    box, height = np.asarray(keypoints.box_px, float), keypoints.image_size_px[1]
    feet, head = feet_and_head(tuple(keypoints.names))
    return (feet, box[:, 3] >= height - 1), (head, box[:, 1] <= 0)


@functools.cache
def feet_and_head(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Markers (J,) bool of the feet, and of the head."""
    feet, head = (np.array([bool(p.search(n)) for n in names]) for p in (_FEET, _HEAD))
    return feet, head


def _around_gaps(flags: np.ndarray) -> np.ndarray:
    """Return (N, 2): the last frame before and the first after each stretch of False between two of True (T,)."""
    index = np.flatnonzero(flags)
    before = np.flatnonzero(np.diff(index) > 1)
    return np.stack([index[before], index[before + 1]], axis=1)


def bridge_gaps(in_view: np.ndarray, time_s: np.ndarray, max_gap_s: float) -> np.ndarray:
    """Frames to use: those in view and those inside a gap between two of them that is shorter than `max_gap_s`."""
    used, around = in_view.copy(), _around_gaps(in_view)
    for a, b in around[time_s[around[:, 1]] - time_s[around[:, 0]] < max_gap_s].tolist():
        used[a:b] = True
    return used


def blind_runs(seen: np.ndarray, time_s: np.ndarray, max_blind_s: float) -> np.ndarray:
    """(T,) bool: frames in unbroken runs without sight of the person, longer than `max_blind_s`.

    Partial view may be bridged; without any points a fitted trajectory is free and invents movement (on a synthetic
    walker up to 50 deg at the knee within 0.9 s).
    """
    blind = np.zeros(len(seen), bool)
    for a, b in _around_gaps(seen):
        if time_s[b] - time_s[a] > max_blind_s:
            blind[a + 1 : b] = True
    return blind


def longest_run_s(used: np.ndarray, time_s: np.ndarray) -> float:
    """Return the length (s) of the longest unbroken run of used frames."""
    return max((float(time_s[run][-1] - time_s[run][0]) for run in runs(used)), default=0.0)
