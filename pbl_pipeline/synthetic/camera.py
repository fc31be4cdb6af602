"""Cameras: a phone that stands or is held, its path, its orientation log, and the projection of points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pbl_pipeline.sampling import interval_of
from pbl_pipeline.video import Camera

from .plan import GRID_STEP_S, Plan, wander, within

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
    """The phone's orientation log."""

    rate_hz: float = 100.0
    white_deg: float = 0.3  # per axis and sample
    drift_deg: float = 0.5  # a slow error about the vertical; a fifth of it about the level axes, which gravity limits
    clock_offset_s: float = 0.040  # a frame at video time t has the phone's time t + clock_offset_s


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
    """`phone_time_s` (P,) and `phone_quat_wxyz` (P, 4) as measured by the phone, from 0.3 s before to 0.3 s after.

    `R_nc_at` maps video times (P,) to the true orientations (P, 3, 3).
    """
    video_s = np.arange(start_s - 0.3, stop_s + 0.3, 1 / sensor.rate_hz)
    true = Rotation.from_matrix(R_nc_at(video_s))
    white = Rotation.from_rotvec(np.radians(sensor.white_deg) * rng.standard_normal((len(video_s), 3)))
    fraction = np.array([0.2, 0.2, 1.0]) * sensor.drift_deg
    drift = np.column_stack([wander(rng, video_s, deg, 0.005, 0.1) for deg in fraction])
    # The drift turns the phone's world; the noise is that of the sensor.
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


#: Direction that the person faces at the start, against the phone's line of sight (deg): 180 comes towards it, 90 shows
#: the left side. With "follow" the phone is carried behind the person.
VIEWS_DEG = {
    "frontal": 180.0,
    "oblique": 135.0,
    "sagittal": 90.0,
    "sagittal_right": -90.0,
    "rear": 0.0,
    "follow": 0.0,
}
CAMERAS = ("static", "panned", "handheld")
#: Nearest point of a frontal walk, distance of the middle of all other motions, distance of a carried phone (m).
NEAREST_M, MIDDLE_M, BEHIND_M = 2.5, 4.5, 3.2
#: Time over which a person who carries the phone keeps the distance (s), and the bobbing (m).
CARRY_SMOOTH_S, BOB_SD_M = 0.8, 0.012
#: Height of the phone above the floor (mean, standard deviation, m).
PHONE_HEIGHT_M = (1.2, 0.06)


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A placed motion and its camera."""

    plan: Plan
    height_m: float  # of the phone above the floor
    carried: bool  # the phone follows the person


def place(plan: Plan, view: str, seed: int, *, stays: bool = False) -> Scene:
    """Turn and move a plan, so that the phone at the origin sees it from a view (`VIEWS_DEG`).

    `stays`: the person stays in the middle of the way (on a treadmill).
    """
    rng = np.random.default_rng([seed, 21])
    height, slant = within(rng, *PHONE_HEIGHT_M), np.radians(within(rng, 0.0, 3.0))
    yaw = np.radians(VIEWS_DEG[view]) + slant
    turned = plan.moved(yaw, (0.0, 0.0))
    inside = (plan.grid_s >= 0) & (plan.grid_s <= plan.grid_s[-1] + plan.grid_s[0])
    xy = turned.xy_m[inside]
    if view == "follow":
        to = np.array([BEHIND_M, 0.0]) - xy[0]
    else:
        to = np.array([MIDDLE_M, within(rng, 0.0, 0.1)]) - 0.5 * (xy.min(axis=0) + xy.max(axis=0))
        if not stays:
            to[0] = max(to[0], NEAREST_M - xy[:, 0].min())
    return Scene(plan.moved(yaw, (float(to[0]), float(to[1]))), height, view == "follow")


def phone_path(scene: Scene, pelvis_m: Float[np.ndarray, "N 3"], seed: int) -> Float[np.ndarray, "N 3"]:
    """Position of the phone at the times of the plan's grid (m, relative to the first; the vertical is z).

    A carried phone keeps `BEHIND_M` behind the pelvis along the way, smoothly; every other one stays where it is.
    """
    t = scene.plan.grid_s
    if not scene.carried:
        return np.zeros((len(t), 3))
    rng = np.random.default_rng([seed, 22])
    sigma = CARRY_SMOOTH_S / GRID_STEP_S
    # Smoothed with the trend continued beyond the ends, so that the distance does not change there.
    pad = int(4 * sigma)
    way = np.pad(pelvis_m[:, :2], [(pad, pad), (0, 0)], mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(way, sigma, axis=0)[pad:-pad]
    heading = np.pad(scene.plan.heading_rad, pad, mode="edge")
    faces = gaussian_filter1d(heading, sigma)[pad:-pad]
    behind = smooth - BEHIND_M * np.column_stack([np.cos(faces), np.sin(faces)])
    wobble = np.column_stack([wander(rng, t, BOB_SD_M, 0.3, 2.5) for _ in range(3)])
    path = np.column_stack([behind, np.zeros(len(t))]) + wobble
    start = np.array([np.interp(0.0, t, path[:, i]) for i in range(3)])
    return path - start


def orientation(
    camera: str, carried: bool, time_s: np.ndarray, pelvis_m: Float[np.ndarray, "T 3"], seed: int
) -> Callable[[np.ndarray], Float[np.ndarray, "P 3 3"]]:
    """R_nc at any time of a phone that stands (or is carried on a gimbal), is turned, or is held (`CAMERAS`).

    `pelvis_m` is relative to the phone. A static phone looks level along the middle of the motion.
    """
    if camera != "static":
        tremor = 1.0 if camera == "handheld" else 0.0
        return HeldPhone(np.random.default_rng([seed, 5]), time_s, pelvis_m, tremor=tremor).R_nc
    if not carried:
        fixed = camera_turn(np.zeros(1), np.zeros(1), np.zeros(1))[0]
        return lambda t: np.tile(fixed, (len(t), 1, 1))
    azimuth = np.unwrap(np.arctan2(pelvis_m[:, 1], pelvis_m[:, 0]))
    spline = CubicSpline(time_s, gaussian_filter1d(azimuth, 0.5 / interval_of(time_s), mode="nearest"))

    def gimbal(t: np.ndarray) -> np.ndarray:
        yaw = spline(np.clip(t, time_s[0], time_s[-1]))
        return camera_turn(yaw, np.zeros(len(yaw)), np.zeros(len(yaw)))

    return gimbal
