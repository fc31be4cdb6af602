"""Cameras: a phone that stands or is held, its own orientation log, and the picture of a point."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pbl_pipeline.video import Camera

from .plan import wander

#: An upright phone video: focal length about 1500 px, principal point in the middle (pixel centres count from 0).
PHONE_SIZE_PX = (1080, 1920)
PHONE_CAMERA = Camera(
    np.array([[1500.0, 0, 539.5], [0, 1500.0, 959.5], [0, 0, 1]]), np.zeros(5), "measured: a synthetic phone"
)
#: R_nc of a level camera that looks along world x: its columns are right, down, ahead.
LEVEL_R_NC = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])

#: Standard deviation (deg) of a hand's turns to the side, up and down, about the line of sight, at these frequencies.
TREMOR_DEG = (1.2, 1.0, 0.8)
TREMOR_HZ = (0.3, 3.0)
#: A person who films follows the walker with this delay, and smoothly (s).
FOLLOW_DELAY_S, FOLLOW_SMOOTH_S = 0.2, 0.25


@dataclasses.dataclass(frozen=True)
class PhoneSensor:
    """The phone's orientation log.

    rate_hz; white_deg per axis and sample; drift_deg: a slow error about the vertical, and a fifth of it about the two
    level axes, which gravity holds; clock_offset_s: a frame at video time t bears the phone's time t + clock_offset_s.
    """

    rate_hz: float = 100.0
    white_deg: float = 0.3
    drift_deg: float = 0.5
    clock_offset_s: float = 0.040


def camera_turn(yaw_rad: np.ndarray, pitch_rad: np.ndarray, roll_rad: np.ndarray) -> Float[np.ndarray, "T 3 3"]:
    """R_nc (T, 3, 3): a level camera turned left by `yaw` about the vertical, then up by `pitch`, then by `roll`
    clockwise about its line of sight."""
    yaw = Rotation.from_euler("Z", np.atleast_1d(yaw_rad)[:, None]).as_matrix()
    own = Rotation.from_euler("XZ", np.column_stack([np.atleast_1d(pitch_rad), np.atleast_1d(roll_rad)])).as_matrix()
    return yaw @ LEVEL_R_NC @ own


class HeldPhone:
    """A phone held at the origin that follows a walker: its orientation at any time around the trial.

    `tremor` multiplies the hand's (0: turned on a tripod).
    """

    def __init__(
        self, rng: np.random.Generator, time_s: np.ndarray, pelvis_m: Float[np.ndarray, "T 3"], *, tremor: float = 1.0
    ) -> None:
        step = 0.005
        self._grid = np.arange(time_s[0] - 1.5, time_s[-1] + 1.5, step)
        azimuth = np.unwrap(np.arctan2(pelvis_m[:, 1], pelvis_m[:, 0]))
        # Held, not extended, beyond the ends; the smoothing takes the corner away.
        at = np.clip(self._grid - FOLLOW_DELAY_S, time_s[0], time_s[-1])
        seen = CubicSpline(time_s, azimuth)(at) if len(time_s) > 3 else np.interp(at, time_s, azimuth)
        self._yaw = CubicSpline(self._grid, gaussian_filter1d(seen, FOLLOW_SMOOTH_S / step, mode="nearest"))
        self._pitch = float(np.mean(np.arctan2(pelvis_m[:, 2], np.linalg.norm(pelvis_m[:, :2], axis=1))))
        self._tremor, self._share = rng.integers(2**63, size=3), tremor

    def R_nc(self, time_s: np.ndarray) -> Float[np.ndarray, "T 3 3"]:
        """Camera to world (T, 3, 3) at video times."""
        yaw, pitch, roll = (
            np.radians(wander(np.random.default_rng(key), time_s, self._share * deg, *TREMOR_HZ, n=16))
            for key, deg in zip(self._tremor, TREMOR_DEG, strict=True)
        )
        return camera_turn(self._yaw(time_s) + yaw, self._pitch + pitch, roll)


def phone_log(
    rng: np.random.Generator, sensor: PhoneSensor, R_nc_at, start_s: float, stop_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """`phone_time_s` (P,) and `phone_quat_wxyz` (P, 4): what the phone measured, from 0.3 s before to 0.3 s after.

    `R_nc_at` maps video times (P,) to the true orientations (P, 3, 3).
    """
    video_s = np.arange(start_s - 0.3, stop_s + 0.3, 1 / sensor.rate_hz)
    true = Rotation.from_matrix(R_nc_at(video_s))
    white = Rotation.from_rotvec(np.radians(sensor.white_deg) * rng.standard_normal((len(video_s), 3)))
    fraction = np.array([0.2, 0.2, 1.0]) * sensor.drift_deg
    drift = np.column_stack([wander(rng, video_s, deg, 0.005, 0.1) for deg in fraction])
    # The drift turns the phone's idea of the world; the noise is the sensor's own.
    measured = Rotation.from_rotvec(np.radians(drift)) * true * white
    return video_s + sensor.clock_offset_s, measured.as_quat(scalar_first=True)


def picture_px(x_cam: Float[np.ndarray, "*n 3"], camera: Camera) -> Float[np.ndarray, "*n 2"]:
    """Pixels of points in the camera frame (m), lens distortion included (OpenCV)."""
    flat = np.ascontiguousarray(np.asarray(x_cam, np.float64).reshape(-1, 3))
    if not np.any(camera.distortion):
        uv = flat @ np.asarray(camera.matrix, np.float64).T
        return (uv[:, :2] / uv[:, 2:]).reshape(*x_cam.shape[:-1], 2)
    xy, _ = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return xy.reshape(*x_cam.shape[:-1], 2)
