"""Checks of the keypoints of one trial, and calibration of their confidence.

A body seen from the front and one seen from behind, with the sides exchanged, have nearly the same outline. If the face
is not visible (pixelated for privacy, against the light) a network may return either, and change within a trial. The
movement alone does not show which is right: the sequence that moves least may be wrong throughout. So such a trial is
reported, not repaired.

The thresholds of the picture are where the detector begins to get worse than in the original picture, on recordings
that were darkened, blurred and reduced (docs/confidence.md).

A stated confidence is a number between 0 and 1 in the detector's scale. A curve maps it to the probability that the
point lies within a bound of the true one in the picture. Curves are data with a name and a version
(`data/confidence_curves.json`, made by `python -m research.confidence`) and never change: another fit is another
version, and its name is a parameter of the keypoint method. Fits are weighted with the stated confidence
(docs/confidence.md explains why); reports show the probability.
"""

from __future__ import annotations

import dataclasses
import functools
import json

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import EMPTY, FAIL, PASS, WARN, Check
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.shipped import shipped_text
from pbl_pipeline.tracking import step_s

from .in_view import SEEN_SHARE, ends, visibility
from .types import Keypoints

#: The bound of all curves: a fraction of the length of the trunk (middle of the shoulders to middle of the hips) in the
#: picture, as it would be seen from the side. The "percentage of correct points" of pose estimation at 0.2.
BOUND_TRUNK = 0.2
_DATA = "keypoints/data/confidence_curves.json"


@dataclasses.dataclass(frozen=True)
class ConfidenceCurve:
    """A monotone map from stated confidence to probability."""

    name: str  # "blazepose-v1": detector and version
    detector: str  # name of the detector
    bound_trunk: float  # the point counts as right within this fraction of the trunk's length
    #: (K,) knots; linear between them, constant outside.
    stated: np.ndarray
    probability: np.ndarray
    n: int  # number of points that it was fitted to
    source: str  # the data that it was fitted to, in words
    params: dict  # of the detection with these confidences (`KeypointParams` without `confidence_curve`)

    def __call__(self, confidence: np.ndarray) -> np.ndarray:
        """Return probabilities for stated confidences of any shape; 0 for 0, which means that no point was found."""
        confidence = np.asarray(confidence, float)
        return np.where(confidence > 0, np.interp(confidence, self.stated, self.probability), 0.0)


@functools.cache
def confidence_curves() -> dict[str, ConfidenceCurve]:
    """All curves by name."""
    curves = {}
    for name, c in json.loads(shipped_text(_DATA))["curves"].items():
        stated, probability = np.asarray(c["stated"], float), np.asarray(c["probability"], float)
        if np.any(np.diff(stated) <= 0) or np.any(np.diff(probability) < 0) or not 0 <= probability[0] <= 1:
            raise ValueError(f"{_DATA}: {name} is not a monotone curve")
        curves[name] = ConfidenceCurve(
            name, c["detector"], c["bound_trunk"], stated, probability, c["n"], c["source"], c["params"]
        )
    return curves


def confidence_curve(name: str) -> ConfidenceCurve:
    """Return the curve of that name. Raises `PblError` SOLVER_UNKNOWN."""
    curves = confidence_curves()
    if name not in curves:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"confidence curve {name!r}",
            expected=f"one of {', '.join(curves)}, or none",
            next_step="choose one of these names in the keypoint parameters, or update the program that reads the file",
        )
    return curves[name]


def probability_within(keypoints: Keypoints) -> np.ndarray | None:
    """(T, J) probability that a point lies within the curve's bound of the true one; None without a curve."""
    if not keypoints.confidence_curve:
        return None
    return confidence_curve(keypoints.confidence_curve)(keypoints.confidence)


def confidence_text(keypoints: Keypoints) -> str:
    """Describe the confidence of the points, and their probability, in one sentence."""
    found = keypoints.confidence > 0
    if not found.any():
        return "no point was found"
    stated = f"median {np.median(keypoints.confidence[found]):.2f} as the detector states it"
    probability = probability_within(keypoints)
    if probability is None:
        return f"{stated}; its reliability was not measured"
    bound = confidence_curve(keypoints.confidence_curve).bound_trunk
    right = float(np.mean(probability[found]))
    return (
        f"{stated}; {right:.0%} of the points within {bound:.0%} of the trunk's length ({keypoints.confidence_curve})"
    )


_LEGS_HIDDEN = "the legs are hidden or hard to see: film the whole body from the side, in light"
#: Check -> value beyond which it warns, value beyond which it fails (values are to be above both, or below), advice.
_LIMITS: dict[str, tuple[float, float, str]] = {
    # About three strides.
    "frames_seen_s": (3.0, 0.0, "fewer than about three strides are in view: film a longer walk"),
    # The same, and the least for a fit.
    "whole_person_s": (3.0, 1.0, "keep head and feet in the picture, step back or film a longer walk"),
    # Fraction of the frames between the first and the last sight of the person in which she is not found.
    "frames_without_person_share": (
        0.05,
        0.5,
        "the person is lost again and again between the first and the last frame: film without others in between, "
        "in more light, and follow the walk",
    ),
    # Fraction of the frames in which feet or head are beyond the lower or upper border.
    "feet_cut_share": (0.1, 0.5, "the feet leave the picture below: tilt the phone or step back"),
    "head_cut_share": (0.1, 0.5, "the head leaves the picture above: tilt the phone or step back"),
    # Head to feet in the picture.
    "body_height_px": (
        100.0,
        50.0,
        "the person is too small in the picture: film from nearer, or in a higher resolution; do not zoom digitally",
    ),
    # Brightness (0..255) of the brightest twentieth of the person. At about half of it people are no longer found.
    "picture_brightness": (60.0, 15.0, "the person is too dark: switch lights on, and do not film against a window"),
    # Finest detail as a fraction of the person's size.
    "picture_detail_share": (
        0.04,
        0.06,
        "the picture of the person is blurred: film in more light (a shorter exposure), hold the phone still, wipe "
        "the lens, and let it focus on the person",
    ),
    "frame_rate_hz": (
        20.0,
        10.0,
        "too few frames a second for fast movements and the moment of a step: film with 30 or 60",
    ),
    # Mean stated confidence of the legs' points; fraction of them within the bound of the detector's curve.
    "leg_confidence": (0.6, 0.0, _LEGS_HIDDEN),
    "leg_points_right_share": (0.9, 0.0, _LEGS_HIDDEN),
    # Fraction of the frames in which left and right were exchanged back; if large, the others may be the wrong ones.
    "sides_exchanged_share": (
        0.02,
        0.3,
        "the detector took left for right, or could not tell them, in this share of the frames; their names follow "
        "the movement now: look at the overlay, film in better light or more from the side",
    ),
}
#: Turn between neighbouring frames (deg) that no person makes; single frames of noise stay below.
_TURN_DEG = 90.0
_LONGEST_STEP_S = 0.2
_LEGS = ("hip", "knee", "ankle", "heel", "foot_index")


def check_keypoints(keypoints: Keypoints) -> tuple[Check, ...]:
    """Check the keypoints of one trial. If no frame shows the person: EMPTY, and the failed checks of the picture.

    `frames_seen_s`, `whole_person_s`, `frames_without_person_share`, `feet_cut_share`, `head_cut_share`,
    `body_height_px`, `picture_brightness`, `picture_detail_share`, `frame_rate_hz`, `leg_confidence`,
    `leg_points_right_share`, `side_changes`, `sides_exchanged_share`, without those that are not known of a trial.
    """
    seen = keypoints.confidence.max(axis=1) > 0
    if not seen.any():
        why = [c for c in _picture(keypoints) if c is not None and c.outcome != PASS]
        return (Check("frames_seen_s", EMPTY, 0.0, 1.0, "no frame shows the person"), *why)
    checks = [*_time(keypoints, seen), *_cut(keypoints), *_picture(keypoints), _rate(keypoints.time_s)]
    return tuple(c for c in [*checks, *_legs(keypoints, seen), *_sides(keypoints, seen)] if c is not None)


def _time(keypoints: Keypoints, seen: np.ndarray) -> list[Check | None]:
    """Checks of the time in which the person, and the whole person, is in view."""
    seconds = float(seen.sum()) * step_s(keypoints.time_s)
    shown = visibility(keypoints)
    first, last = np.flatnonzero(seen)[[0, -1]]
    absent = 1.0 - float(np.mean(seen[first : last + 1]))
    whole = _limit_check("whole_person_s", shown.counts_s)
    if whole is not None and whole.advice:
        whole = dataclasses.replace(whole, advice=f"{shown.text()}: {whole.advice}")
    return [_limit_check("frames_seen_s", seconds), whole, _limit_check("frames_without_person_share", absent)]


def _cut(keypoints: Keypoints) -> list[Check | None]:
    """Checks of feet and head beyond the border, and of the person's size."""
    width, height = keypoints.image_size_px
    xy = np.nan_to_num(np.asarray(keypoints.xy_px, float), nan=-1.0)
    found = (keypoints.confidence > 0) & np.all((xy >= 0) & (xy <= (width, height)), axis=2)
    given = found.any(axis=0)
    seen = found.mean(axis=1) >= SEEN_SHARE * given.mean()
    checks: list[Check | None] = []
    (feet, low), (head, high) = ends(keypoints)
    for name, points, at_border in (("feet_cut_share", feet, low), ("head_cut_share", head, high)):
        if points.any() and seen.any():
            cut = at_border & ~found[:, points].all(axis=1)
            checks.append(_limit_check(name, float(np.mean(cut[seen]))))
    whole = found[:, feet].any(axis=1) & found[:, head].any(axis=1)
    if whole.any():
        points = np.where(found[whole][..., None], xy[whole], np.nan)
        extent = np.nanmax(points, axis=1) - np.nanmin(points, axis=1)
        checks.append(_limit_check("body_height_px", float(np.median(extent.max(axis=1)))))
    return checks


def _picture(keypoints: Keypoints) -> list[Check | None]:
    picture = keypoints.picture
    if picture is None or not len(picture.time_s):
        return []
    return [
        _limit_check("picture_brightness", picture.bright),
        _limit_check("picture_detail_share", picture.detail_share),
    ]


def _rate(time_s: np.ndarray) -> Check | None:
    interval_s = interval_of(time_s) if len(time_s) > 1 else 0.0
    return _limit_check("frame_rate_hz", 1.0 / interval_s) if interval_s > 0 else None


def _legs(keypoints: Keypoints, seen: np.ndarray) -> list[Check | None]:
    """Checks of the stated confidence of the legs' points and, if known, of their probability."""
    legs = [i for i, n in enumerate(keypoints.names) if n.startswith(("left_", "right_")) and n.endswith(_LEGS)]
    if not legs:
        return []
    found = [_limit_check("leg_confidence", float(keypoints.confidence[seen][:, legs].mean()))]
    probability = probability_within(keypoints)
    if probability is not None:
        found.append(_limit_check("leg_points_right_share", float(probability[seen][:, legs].mean())))
    return found


def _sides(keypoints: Keypoints, seen: np.ndarray) -> list[Check | None]:
    if not {"left_hip", "right_hip"} <= set(keypoints.names):
        return []
    advice = "left and right change places between frames: look at the overlay; film from the side"
    limits = 0.0, 0.02 * float(seen.sum()), advice
    found = [_limit_check("side_changes", float(len(side_changes(keypoints))), limits)]
    if keypoints.sides_changed is not None:
        fraction = float(keypoints.sides_changed[seen].any(axis=1).mean())
        found.append(_limit_check("sides_exchanged_share", fraction))
    return found


def side_changes(keypoints: Keypoints) -> np.ndarray:
    """Frames (K,) at which the axis from left to right hip has turned by more than 90 degrees since the last one seen
    (at most 0.2 s before), so that the sides were exchanged."""
    axis = (
        keypoints.xyz_cam_m[:, keypoints.names.index("right_hip")]
        - keypoints.xyz_cam_m[:, keypoints.names.index("left_hip")]
    ).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(axis).all(axis=1) & (np.linalg.norm(axis, axis=1) > 0))
    axis = axis[rows] / np.linalg.norm(axis[rows], axis=1, keepdims=True)
    turned = np.einsum("ij,ij->i", axis[1:], axis[:-1]) < np.cos(np.radians(_TURN_DEG))
    return rows[1:][turned & (np.diff(keypoints.time_s[rows]) <= _LONGEST_STEP_S)]


def _limit_check(check: str, value: float, limits: tuple[float, float, str] | None = None) -> Check | None:
    """Check of a value by its `_LIMITS`, or by others; None if the value is not known."""
    if not np.isfinite(value):
        return None
    warn, fail, advice = limits or _LIMITS[check]
    sign = 1.0 if warn > fail else -1.0
    outcome = FAIL if sign * value < sign * fail else WARN if sign * value < sign * warn else PASS
    return Check(check, outcome, value, fail if outcome == FAIL else warn, "" if outcome == PASS else advice)
