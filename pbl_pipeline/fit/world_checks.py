"""Checks of the world of laboratory markers and calibrated cameras, and of the picture of another program's keypoints,
against the body that moves in it.

Assumed of the person, beyond `assumptions`: in a trial as a whole the head is above the feet, as in walking, standing,
sitting and squatting, not in lying.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Generic, TypeVar

import numpy as np

from pbl_pipeline.assumptions import SIZES, UNITS, check_size, check_steps, check_strides
from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError, as_said, joined, said
from pbl_pipeline.keypoints import MOST_MISS_M, SEEN_SHARE, Keypoints, MultiView, WorldMarkers
from pbl_pipeline.keypoints.multi_view import meeting_points
from pbl_pipeline.video import CameraPose

from .standing import standing_markers
from .units import body_metres

#: Beyond this angle from z the vertical is wrong; within `NEAR_DEG` of another axis it is that one.
WRONG_DEG, NEAR_DEG, STEADY = 60.0, 40.0, 0.8
#: Least standard deviation (m) of the markers' heights on the standing body that shows a direction.
_SPREAD_M = 0.15
_LEGS = ("tibia", "talus", "calcn", "toes")
#: Least size of a body in a picture (px); largest fraction of the points outside the picture.
_LEAST_PX, _MOST_OUTSIDE = 20.0, 0.05


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
    refuse, time_s = functools.partial(_error, name), np.asarray(trial.time_s)
    check_steps(time_s, refuse)
    check_size(_size(points, markers), refuse)
    up, steady = body_axis(points, markers)
    off, turn, label = float(np.degrees(np.arccos(np.clip(up[2], -1, 1)))), np.eye(3), ""
    if off > WRONG_DEG:
        number = int(np.argmax(np.abs(up)))
        axis = np.sign(up[number]) * np.eye(3)[number]
        near, label = float(np.degrees(np.arccos(axis @ up))), "-+"[int(axis[number] > 0)] + "xyz"[number]
        if near > NEAR_DEG or steady < STEADY:
            raise refuse(
                said(
                    "the body's head lies {off:.0f} deg off z, seen from its feet, and along no axis (nearest "
                    "{axis}: {near:.0f} deg)",
                    off=off,
                    axis=label,
                    near=near,
                ),
                "a person whose head is above the feet along z, the vertical",
                "pass --up y or --up z for a .trc; else turn the markers, or the calibration, so that z is up",
            )
        turn = _to_z(axis)
    points = points @ turn.T
    check_strides(_between_legs(points, markers), time_s, refuse)
    return Turned(_turned(trial, turn) if label else trial, name, off, label)


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


def check_picture(trial: Keypoints, name: str, markers: MarkerSet) -> None:
    """Check pixels against the body and the picture, which is taken as a level view of it.

    Raises `PblError` FIT_INPUT: a body upside down or on its side, points outside the picture, coordinates that are
    fractions of it, times or strides that no person has.
    """
    xy = np.where((trial.confidence > 0)[..., None], np.asarray(trial.xy_px, float), np.nan)
    extent = np.nanmax(xy, axis=1, initial=-np.inf) - np.nanmin(xy, axis=1, initial=np.inf)
    seen = np.isfinite(xy).all(axis=2).mean(axis=1) >= SEEN_SHARE * np.isfinite(xy).all(axis=2).any(axis=0).mean()
    if not seen.any():
        raise _error(name, "no frame with most of the points", "a person in view", "look at the file")
    size, picture = float(np.median(extent[seen].max(axis=1))), "x".join(map(str, trial.image_size_px))
    if size < _LEAST_PX:
        raise _error(
            name,
            said("a body of {size:.3g} px", size=size),
            f"pixels of the picture, at least {_LEAST_PX:g} for a body",
            "write pixels, not fractions of the picture (OpenPose: --keypoint_scale 0)",
        )
    points = np.stack([xy[..., 0], np.zeros(xy.shape[:2]), -xy[..., 1]], axis=-1)
    points *= np.ptp(standing_markers(load_body(), markers)[:, 2]) / size
    up = body_axis(points, markers)[0]
    if np.degrees(np.arccos(np.clip(up[2], -1, 1))) > WRONG_DEG:
        upside = abs(up[2]) > abs(up[0])
        raise _error(
            name,
            "a person who is upside down: y points up, or the picture is turned by 180 deg"
            if upside
            else "a person who lies on the side: the picture is turned by 90 deg",
            "a person who stands or sits upright in the picture, y down from its upper edge",
            "write y as height - 1 - y" if upside else "find the keypoints in the upright picture",
        )
    width, height = trial.image_size_px
    known = xy[np.isfinite(xy).all(axis=2)]
    outside = float(np.mean(np.any((known < -0.5) | (known > np.array([width, height]) - 0.5), axis=1)))
    if outside > _MOST_OUTSIDE:
        low, high = known.min(axis=0), known.max(axis=0)
        raise _error(
            name,
            said(
                "{share:.0%} of the points outside the picture of {picture} px: x {x0:.0f} to {x1:.0f}, y {y0:.0f} to "
                "{y1:.0f}",
                share=outside,
                picture=picture,
                x0=low[0],
                x1=high[0],
                y0=low[1],
                y1=high[1],
            ),
            "pixels of the upright picture, from its upper left corner",
            "pass the size of the picture in which the keypoints were found",
        )
    refuse, time_s = functools.partial(_error, name), np.asarray(trial.time_s)
    check_steps(time_s, refuse)
    check_strides(_between_legs(points, markers), time_s, refuse)


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
        unit = min(UNITS, key=lambda u: abs(np.log(_size(points, markers) * UNITS[u])))
        size = _size(points, markers) * UNITS[unit]
        if not (SIZES[0] <= size <= SIZES[1] and np.nanmax(miss) * UNITS[unit] <= MOST_MISS_M):
            continue
        wrong = [
            text
            for text, is_so in (
                (said("poses the other way round (camera to world)"), inverse),
                (said("camera axes with y up and z backwards"), graphics),
                (said("translations in {unit}", unit=said(unit)), unit != "metres"),
            )
            if is_so
        ]
        return PblError(
            "VIEWS_DISAGREE",
            found=said(
                "trial {name}: {wrong}: read so, the cameras agree within {cm:.0f} cm",
                name=name,
                wrong=joined(wrong),
                cm=100 * np.nanmax(miss) * UNITS[unit],
            ),
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


def _between_legs(points: np.ndarray, markers: MarkerSet) -> np.ndarray:
    """Horizontal distance (T, 2) from the markers of the left leg, below the knee, to those of the right one."""
    legs = [np.array([b.endswith(end) and b.startswith(_LEGS) for b in markers.body_names]) for end in ("_r", "_l")]
    seen = np.isfinite(points).all(axis=2) & np.stack(legs)[:, None]
    n = np.where(seen.any(axis=2), seen.sum(axis=2), np.nan)[..., None]
    right, left = np.einsum("stj,tja->sta", seen, np.nan_to_num(points[..., :2])) / n
    return right - left


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


def _error(name: str, found: str, expected: str, next_step: str) -> PblError:
    return PblError(
        "FIT_INPUT",
        found=said("trial {name}: {found}", name=name, found=as_said(found)),
        expected=expected,
        next_step=next_step,
        key=name,
    )
