"""Orientation of the phone while it filmed: the log of `--attitude`.

Frames. World: z up, heading free. Camera: OpenCV's (x right, y down, z forward) of the upright picture. Device: what
Android and iOS call the device's axes, x to the right and y to the top of the screen in portrait, z out of the screen.

The back camera looks along -z of the device. Held in portrait its picture has the screen's right as its right (+x)
and the screen's bottom as its down (-y), so the camera's axes in the device's frame are the columns of diag(1, -1, -1),
half a turn about x. Turn the phone clockwise by the angle a, as the person filming sees it: in the device's frame the
upright picture turns by a the other way about the screen's normal, so R_dc(a) = Rz(a) diag(1, -1, -1). At 90 degrees
the picture's right is +y and its down is +x. With the device to world rotation R_nd of the log, R_nc = R_nd R_dc(a).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results.video_facts import VideoInfo

CAMERA, DEVICE = "camera", "device"
#: Four numbers of a smaller norm define no rotation.
_SHORTEST_NORM = 1e-3
#: Phones turn the recording upright: a log by which the picture is tilted more is wrong; no hand tilts a phone so far.
_MOST_ROLL_DEG = 60.0
#: Closer to the vertical than this, a viewing direction has no roll to judge.
_VERTICAL_DEG = 30.0
#: Longest time (s) between samples over which the orientation is interpolated, and largest turn (deg) about the mean of
#: a phone that stands still.
MAX_HOLE_S, _STILL_DEG = 0.3, 0.5
log_error = functools.partial(
    PblError, "PHONE_LOG", next_step="see docs/phone_capture.md; without --attitude the camera is taken as still"
)


@dataclasses.dataclass(frozen=True)
class Attitude:
    """The phone's orientation over one recording. Validated and brought to unit length when made."""

    #: (P,) seconds, 0 at about the video's first frame (the fit finds the small offset left); strictly increasing.
    time_s: np.ndarray
    #: (P, 4) R_nc, camera to world, as unit quaternions (w, x, y, z); neighbours have the same sign.
    quat_wxyz: np.ndarray
    source: str = ""  # where it comes from, and how its clock was brought to the video's
    clock_sd_s: float = math.nan  # standard deviation of the remaining offset between the clocks; NaN: not known

    def __post_init__(self) -> None:
        time_s, quat_wxyz = check_attitude(self.time_s, self.quat_wxyz, self.source or None)
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "quat_wxyz", quat_wxyz)


def check_attitude(time_s: object, quat_wxyz: object, key: object = None) -> tuple[np.ndarray, np.ndarray]:
    """(P,) times and (P, 4) unit quaternions without a jump from q to -q, or an error.

    Raises `PblError` PHONE_LOG: other shapes, fewer than two samples, values that are not finite, stamps that repeat or
    run backwards, a quaternion of length (nearly) zero.
    """
    try:
        time, quat = np.asarray(time_s, np.float64), np.asarray(quat_wxyz, np.float64)
    except (TypeError, ValueError) as error:
        raise log_error(f"values that are not numbers ({error})", "numbers", key=key) from error
    if time.ndim != 1 or quat.shape != (len(time), 4):
        raise log_error(
            said("times of shape {times}, quaternions of shape {quats}", times=time.shape, quats=quat.shape),
            "(P,) and (P, 4)",
            key=key,
        )
    if len(time) < 2:
        raise log_error(said("{n} samples", n=len(time)), "at least two", key=key)
    for name, array in (("times", time), ("quaternions", quat)):
        bad = int(np.sum(~np.isfinite(array.reshape(len(time), -1)).all(axis=1)))
        if bad:
            raise log_error(
                said("{n} of {all} {what} not finite", n=bad, all=len(time), what=said(name)),
                "finite numbers; leave such samples out",
                key=key,
            )
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        i = int(back[0])
        found = said(
            "{n} stamps that repeat or run backwards, the first at {now:.6g} s after {before:.6g} s",
            n=len(back),
            now=time[i + 1],
            before=time[i],
        )
        raise log_error(found, "strictly increasing times; sort them and leave out repeats", key=key)
    norm = np.linalg.norm(quat, axis=1, keepdims=True)
    if not np.all((norm > _SHORTEST_NORM) & np.isfinite(norm)):
        found = said("{n} quaternions of length near zero", n=np.sum(~(norm > _SHORTEST_NORM)))
        raise log_error(found, "quaternions of length 1; leave such samples out", key=key)
    quat = quat / norm
    # q and -q are the same rotation, but their mean is not a rotation.
    turned = np.cumsum(np.sum(quat[1:] * quat[:-1], axis=1) < 0) % 2 == 1
    quat[1:][turned] *= -1
    return time, quat


def unknown_at(at_s: np.ndarray, time_s: np.ndarray, quat_wxyz: np.ndarray) -> np.ndarray:
    """(T,) bool: times inside a hole of a log (P,), (P, 4) longer than `MAX_HOLE_S`; none of a phone that stood still.

    A hand's tremor and a pan turn the phone on the way between two samples.
    """
    wide = np.flatnonzero(np.diff(time_s) > MAX_HOLE_S)
    turns = Rotation.from_quat(quat_wxyz, scalar_first=True)
    if not len(wide) or np.degrees((turns.mean().inv() * turns).magnitude().max()) < _STILL_DEG:
        return np.zeros(np.shape(at_s), bool)
    after = np.searchsorted(time_s, at_s)  # at a sample it is known
    return np.isin(after - 1, wide) & (np.take(time_s, after, mode="clip") != at_s)


def camera_in_device(rotation_deg: float = 0.0) -> Rotation:
    """R_dc, back camera to device, for a phone turned clockwise by `rotation_deg` from portrait (module docstring)."""
    return Rotation.from_euler("z", rotation_deg, degrees=True) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def held_deg(video: VideoInfo, quat_wxyz: np.ndarray) -> float:
    """Clockwise turn of the phone from portrait (0, 90, 180 or 270 deg) while it recorded `video`.

    The sensor of a back camera lies such that the stored picture has to be turned clockwise by 90 degrees when the
    phone stands in portrait, and by as much more as the phone is turned: the flag of the file minus 90. A file without
    a flag (0) may be a landscape recording, or a converted one whose pictures were turned or cropped. Then the log's
    quaternions (P, 4), device to world, decide: phones record an upright picture.
    """
    if video.rotation_deg:
        return float((video.rotation_deg - 90) % 360)
    turns = (0.0, 180.0, 270.0, 90.0) if video.height_px >= video.width_px else (270.0, 90.0, 0.0, 180.0)
    device = Rotation.from_quat(quat_wxyz, scalar_first=True)
    rolls = [typical_roll_deg((device * camera_in_device(turn)).as_quat(scalar_first=True)) for turn in turns]
    return turns[int(np.argmin([90.0 if r is None else abs(r) for r in rolls]))]


def typical_roll_deg(quat_wxyz: np.ndarray) -> float | None:
    """Median roll (deg) of the picture against gravity by camera-to-world quaternions (P, 4); None for a camera that
    looks up or down."""
    up_cam = Rotation.from_quat(quat_wxyz, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    clear = np.hypot(up_cam[:, 0], up_cam[:, 1]) > math.sin(math.radians(_VERTICAL_DEG))
    if not clear.any():
        return None
    # Up in the picture is -y; a roll to the right of the picture counts positive.
    roll = np.degrees(np.arctan2(up_cam[clear, 0], -up_cam[clear, 1]))
    return float(roll[np.argsort(np.abs(roll))[len(roll) // 2]])


def check_roll(path: Path, quat_wxyz: np.ndarray, frame: str) -> None:
    """Refuse a log by which the picture lies on its side for most of the time (median). Raises `PblError` PHONE_LOG."""
    roll = typical_roll_deg(quat_wxyz)
    if roll is None or abs(roll) <= _MOST_ROLL_DEG:
        return
    raise log_error(
        said(
            "by this log (frame {frame}) the upright picture is turned by {roll:.0f} deg against gravity",
            frame=frame,
            roll=roll,
        ),
        "a picture that stands upright, within what a hand tilts",
        next_step="check `frame` (device: the phone's own axes) and `rotation_deg` (0 portrait, 90 top to the right, "
        "270 top to the left), and that the quaternions turn the phone's vectors into the world and not back",
        key=path,
    )
