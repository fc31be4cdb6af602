"""Checks of the world of laboratory markers and calibrated cameras against the body that moves in it.

A file states its vertical axis, its unit and its times, or a reader assumes them; a body shows them. Assumed of the
person: 0.75 to 3.4 m tall; in a trial as a whole the head is above the feet, as in walking, standing, sitting and
squatting, not in lying; a stride takes 0.4 to 8 s.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Generic, TypeVar

import numpy as np

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import MOST_MISS_M, MultiView, WorldMarkers
from pbl_pipeline.keypoints.multi_view import meeting_points
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.video import CameraPose

from .standing import standing_markers
from .units import body_metres

#: Size of the body relative to the unscaled one, seconds of a frame and of a stride.
SIZES, STEPS_S, STRIDES_S = (0.45, 2.0), (1 / 5000, 0.25), (0.4, 8.0)
#: Beyond this angle from z the vertical is wrong; within `NEAR_DEG` of another axis it is that one.
WRONG_DEG, NEAR_DEG, STEADY = 60.0, 40.0, 0.8
#: Least standard deviation (m) of the markers' heights on the standing body that shows a direction, and least
#: amplitude (m) of the distance between the feet that shows strides.
_SPREAD_M, _SWING_M = 0.15, 0.15
_UNITS = {"metres": 1.0, "feet": 0.3048, "inches": 0.0254, "centimetres": 0.01, "millimetres": 0.001}
_LEGS = ("tibia", "talus", "calcn", "toes")


World = TypeVar("World", bound=MultiView | WorldMarkers)


@dataclasses.dataclass(frozen=True)
class Turned(Generic[World]):
    """A trial in a world whose z is up by the body."""

    trial: World
    name: str
    off_deg: float  # between the body and z as read
    axis: str = ""  # that was up instead of z, such as "-y"; empty where nothing was turned


def in_upright_world(trial: World, name: str, markers: MarkerSet) -> Turned[World]:
    """Return the trial with z up; turned by right angles where the body clearly stands along another axis.

    Raises `PblError` FIT_INPUT: times, size or strides that no person has, or a vertical that is wrong and unclear.
    """
    points = _points(trial)
    _check_steps(np.asarray(trial.time_s), name)
    check_size(points, name, markers)
    up, steady = body_axis(points, markers)
    off, turn, label = float(np.degrees(np.arccos(np.clip(up[2], -1, 1)))), np.eye(3), ""
    if off > WRONG_DEG:
        number = int(np.argmax(np.abs(up)))
        axis = np.sign(up[number]) * np.eye(3)[number]
        near, label = float(np.degrees(np.arccos(axis @ up))), "-+"[int(axis[number] > 0)] + "xyz"[number]
        if near > NEAR_DEG or steady < STEADY:
            raise _error(
                name,
                f"the body's head lies {off:.0f} deg off z, seen from its feet, and along no axis "
                f"(nearest {label}: {near:.0f} deg)",
                "a person whose head is above the feet along z, the vertical",
                "pass --up y or --up z for a .trc; else turn the markers, or the calibration, so that z is up",
            )
        turn = _to_z(axis)
    points = points @ turn.T
    _check_strides(points, np.asarray(trial.time_s), name, markers)
    return Turned(_turned(trial, turn) if label else trial, name, off, label)


def check_size(points: np.ndarray, name: str, markers: MarkerSet) -> None:
    """Raise `PblError` FIT_INPUT unless points (T, J, 3) in metres are of a body of a person's size."""
    size = _size(points, markers)
    if SIZES[0] <= size <= SIZES[1]:
        return
    names = ((own, read) for own in _UNITS for read in ("metres", "centimetres", "millimetres"))
    own, read = min(names, key=lambda n: abs(np.log(size * _UNITS[n[0]] / _UNITS[n[1]])))
    raise _error(
        name,
        f"a body {_times(size)} that of an adult, such as {own} read as {read}",
        f"{SIZES[0]:g} to {SIZES[1]:g} times an adult's size",
        "correct the unit: Units of a .trc, xyz_world_m and translations of a calibration in metres",
    )


def body_axis(points: np.ndarray, markers: MarkerSet) -> tuple[np.ndarray, float]:
    """Unit vector (3,) from feet to head over all frames of points (T, J, 3), and its steadiness (0 to 1).

    In each frame the direction along which the markers lie as high as on the standing body, by least squares: a bent
    trunk, sitting and squatting tip it by less than 45 deg. (0, 0, 1) and 0 where the markers do not show it.
    """
    seen = np.isfinite(points).all(axis=2)
    high = standing_markers(load_body(), markers)[:, 2]
    n = np.maximum(seen.sum(axis=1), 1)
    above = np.where(seen, high - (seen @ high / n)[:, None], 0.0)
    shows = (n >= 3) & (np.sqrt(np.sum(above**2, axis=1) / n) > _SPREAD_M)
    along = np.einsum("tj,tja->ta", above[shows], np.nan_to_num(points[shows]))
    length = np.linalg.norm(along, axis=1)
    mean = np.sum(along[length > 0] / length[length > 0, None], axis=0) / max(len(length), 1)
    steady = float(np.linalg.norm(mean))
    return (mean / steady, steady) if steady > 0 else (np.array([0.0, 0.0, 1.0]), 0.0)


def explained(trial: MultiView, name: str, markers: MarkerSet) -> PblError | None:
    """Return VIEWS_DISAGREE with what is wrong with the calibration, where another reading of it makes the cameras
    agree: poses the other way round, camera axes of computer graphics, another unit. None if no reading does."""
    flip = np.diag([1.0, -1.0, -1.0])
    for inverse, graphics in itertools.product((False, True), repeat=2):
        poses = []
        for pose in trial.poses:
            R, p = np.asarray(pose.R_nc), np.asarray(pose.p_nc)
            R, p = (R.T, -R.T @ p) if inverse else (R, p)
            poses.append(CameraPose(R @ flip if graphics else R, p))
        miss, points = meeting_points(dataclasses.replace(trial, poses=tuple(poses)))
        unit = min(_UNITS, key=lambda u: abs(np.log(_size(points, markers) * _UNITS[u])))
        size = _size(points, markers) * _UNITS[unit]
        if not (SIZES[0] <= size <= SIZES[1] and np.nanmax(miss) * _UNITS[unit] <= MOST_MISS_M):
            continue
        wrong = [
            text
            for text, is_so in (
                ("poses the other way round (camera to world)", inverse),
                ("camera axes with y up and z backwards", graphics),
                (f"translations in {unit}", unit != "metres"),
            )
            if is_so
        ]
        return PblError(
            "VIEWS_DISAGREE",
            found=f"trial {name}: {', '.join(wrong)}: read so, the cameras agree within "
            f"{100 * np.nanmax(miss) * _UNITS[unit]:.0f} cm",
            expected="x_camera = R x_world + t with y down and z forward, t in metres",
            next_step="convert rotation and translation in the calibration (docs/files.md, section Several cameras)",
            key=name,
        )
    return None


def _points(trial: MultiView | WorldMarkers) -> np.ndarray:
    if isinstance(trial, MultiView):
        return meeting_points(trial)[1]
    return np.where((trial.confidence > 0)[..., None], trial.xyz_world_m, np.nan)


def _size(points: np.ndarray, markers: MarkerSet) -> float:
    seen = np.asarray(np.isfinite(points).all(axis=2))
    known = np.where(seen[..., None], points, 0.0)[:, None]
    return 1 / body_metres(load_body(), markers, [known], [seen[:, None]])


def _check_steps(time_s: np.ndarray, name: str) -> None:
    step = interval_of(time_s)
    if STEPS_S[0] <= step <= STEPS_S[1]:
        return
    guess = "frame numbers" if np.allclose(np.diff(time_s), 1) else "milliseconds" if step > 0.25 else "another unit"
    raise _error(
        name,
        f"{step:.3g} s from frame to frame, such as {guess} read as seconds",
        f"{STEPS_S[0]:g} to {STEPS_S[1]:g} s",
        "write the time of each frame in seconds",
    )


def _check_strides(points: np.ndarray, time_s: np.ndarray, name: str, markers: MarkerSet) -> None:
    """The distance between the legs along the way changes its sign twice a stride."""
    legs = [np.array([b.endswith(end) and b.startswith(_LEGS) for b in markers.body_names]) for end in ("_r", "_l")]
    seen = np.isfinite(points).all(axis=2) & np.stack(legs)[:, None]
    known = np.all([s.any(axis=1) for s in seen], axis=0)
    if known.sum() < 3:
        return
    both = [
        np.einsum("tj,tja->ta", s[known] / s[known].sum(axis=1, keepdims=True), np.nan_to_num(points[known, :, :2]))
        for s in seen
    ]
    apart = both[0] - both[1]
    apart -= apart.mean(axis=0)
    along = apart @ np.linalg.eigh(apart.T @ apart)[1][:, -1]
    far = np.abs(along) > max(0.3 * np.percentile(np.abs(along), 90), 0.3 * _SWING_M)
    side, at = np.sign(along[far]), time_s[known][far]
    change = at[1:][np.diff(side) != 0]
    if len(change) < 3 or np.percentile(np.abs(along), 90) < _SWING_M:
        return
    stride = 2 * float(np.median(np.diff(change)))
    if not STRIDES_S[0] <= stride <= STRIDES_S[1]:
        raise _error(
            name,
            f"strides of {stride:.2g} s",
            f"{STRIDES_S[0]:g} to {STRIDES_S[1]:g} s",
            "correct the times of the frames, in seconds (the rate of the recording)",
        )


def _to_z(axis: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) by right angles that takes a signed axis to z."""
    x, y, z = np.cross(axis, [0.0, 0.0, 1.0])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.diag([1.0, -1.0, -1.0]) if axis[2] else np.eye(3) + cross + cross @ cross


def _turned(trial: World, turn: np.ndarray) -> World:
    if isinstance(trial, WorldMarkers):
        return dataclasses.replace(trial, xyz_world_m=trial.xyz_world_m @ turn.T)
    poses = tuple(CameraPose(turn @ p.R_nc, turn @ p.p_nc) for p in trial.poses)
    return dataclasses.replace(trial, poses=poses)


def _times(ratio: float) -> str:
    return f"{ratio:.3g} times" if ratio > 1 else f"1/{1 / ratio:.3g} of"


def _error(name: str, found: str, expected: str, next_step: str) -> PblError:
    return PblError("FIT_INPUT", found=f"trial {name}: {found}", expected=expected, next_step=next_step, key=name)
