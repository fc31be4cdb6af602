"""Where the phone stands or goes, and how it looks at a motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.errors import PblError

from .camera import HeldPhone, camera_turn
from .plan import GRID_STEP_S, Plan, wander, within

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
#: A person who carries the phone keeps the distance only over seconds, and bobs (m).
CARRY_SMOOTH_S, BOB_SD_M = 0.8, 0.012
#: Height of the phone above the floor (mean, standard deviation, m).
PHONE_HEIGHT_M = (1.2, 0.06)


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A placed motion and its camera.

    plan: the plan, placed; height_m: of the phone above the floor; carried: whether the phone goes along.
    """

    plan: Plan
    height_m: float
    carried: bool


def place(plan: Plan, view: str, seed: int, *, stays: bool = False) -> Scene:
    """Turn and move a plan, so that the phone at the origin sees it from the view asked for.

    `stays`: the person stays in the middle of the way (on a treadmill).

    Raises `PblError` USAGE for an unknown view.
    """
    if view not in VIEWS_DEG:
        raise PblError(
            "USAGE", found=f"view {view!r}", expected=f"one of {', '.join(VIEWS_DEG)}", next_step="pass one of these"
        )
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
    """Where the phone is at the times of the plan's grid (m, against its first place; the vertical is z).

    A carried phone keeps `BEHIND_M` behind the pelvis along the way, smoothly; every other one stays where it is.
    """
    t = scene.plan.grid_s
    if not scene.carried:
        return np.zeros((len(t), 3))
    rng = np.random.default_rng([seed, 22])
    sigma = CARRY_SMOOTH_S / GRID_STEP_S
    # Smoothed with its trend held beyond the ends, so that the distance does not change there.
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
    """R_nc at any time: of a phone that stands (or is carried on a gimbal), that is turned, or that is held.

    `pelvis_m` is against the phone. A static phone looks level along the middle of what it sees. Raises `PblError`
    USAGE for an unknown camera.
    """
    if camera not in CAMERAS:
        raise PblError(
            "USAGE", found=f"camera {camera!r}", expected=f"one of {', '.join(CAMERAS)}", next_step="pass one of these"
        )
    if camera != "static":
        tremor = 1.0 if camera == "handheld" else 0.0
        return HeldPhone(np.random.default_rng([seed, 5]), time_s, pelvis_m, tremor=tremor).R_nc
    if not carried:
        fixed = camera_turn(np.zeros(1), np.zeros(1), np.zeros(1))[0]
        return lambda t: np.tile(fixed, (len(t), 1, 1))
    azimuth = np.unwrap(np.arctan2(pelvis_m[:, 1], pelvis_m[:, 0]))
    spline = CubicSpline(time_s, gaussian_filter1d(azimuth, 0.5 / np.median(np.diff(time_s)), mode="nearest"))

    def gimbal(t: np.ndarray) -> np.ndarray:
        yaw = spline(np.clip(t, time_s[0], time_s[-1]))
        return camera_turn(yaw, np.zeros(len(yaw)), np.zeros(len(yaw)))

    return gimbal
