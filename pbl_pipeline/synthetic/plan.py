"""Plan of a motion before it is solved: the way of the pelvis, where and when each foot stands, the textbook curves."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Y_UP_TO_Z_UP, joint_of, load_body
from pbl_pipeline.gait.normative import harmonic_sum
from pbl_pipeline.shipped import shipped_text

_TABLES = json.loads(shipped_text("synthetic/data/curves.json"))

#: Degrees over one gait cycle of one side, its foot contact at phase 0: the mean, then (cosine, sine) of harmonic 1, 2
#: and so on. The project's own numbers: harmonics through values written down every 5 % of the cycle to follow the
#: course of textbook curves of healthy adults at their own speed (Perry and Burnfield, Gait Analysis, 2010; the shape
#: of the group means of Schwartz et al. 2008, J Biomech 41:1639). Hip flexion is that of the fitted body, whose pelvis
#: is level where Plug-in Gait's tips forward by 12 deg (`normative.offset_deg`). Subtalar: inversion positive; mtp:
#: extension positive. The arm swings against the leg of its side and is furthest back at that side's foot contact.
SIDE_CURVES_DEG: dict[str, tuple[float, ...]] = {n: tuple(c) for n, c in _TABLES["side_curves_deg"].items()}

#: The same for pelvis and trunk over the cycle of the right side. Pelvis: posterior tilt, right side down and right
#: side ahead positive, against the walking direction (the signs of the model's axes forward, up, right).
MIDDLE_CURVES_DEG: dict[str, tuple[float, ...]] = {n: tuple(c) for n, c in _TABLES["middle_curves_deg"].items()}

#: How the means of the curves differ between people (standard deviation, deg), about what Schwartz et al. 2008 give
#: for the legs; drawn within two standard deviations.
OFFSET_SD_DEG: dict[str, float] = _TABLES["offset_sd_deg"]


def swing(curve: tuple[float, ...], phase_rad: np.ndarray) -> np.ndarray:
    """A curve of `SIDE_CURVES_DEG` or `MIDDLE_CURVES_DEG` at phases, without its mean."""
    return harmonic_sum(np.array([0.0, *curve[1:]]), phase_rad)


def wander(
    rng: np.random.Generator, time_s: np.ndarray, sd: float, low_hz: float, high_hz: float, n: int = 10
) -> np.ndarray:
    """(T,) a smooth curve of mean 0 that does not repeat: `n` sines with random frequencies and phases.

    Frequencies are drawn evenly on a logarithmic scale, all with the same amplitude; over a long time the standard
    deviation is `sd`. It is a function of time, so other time stamps show the same curve.
    """
    frequency = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), n))
    phase = rng.uniform(0, 2 * np.pi, n)
    turns = 2 * np.pi * np.multiply.outer(np.asarray(time_s, np.float64), frequency)
    return sd * np.sqrt(2 / n) * np.sin(turns + phase).sum(axis=-1)


def within(rng: np.random.Generator, mean: float, sd: float, bound_sd: float = 2.0) -> float:
    """A normal number cut off at `bound_sd` standard deviations."""
    return mean + sd * float(np.clip(rng.standard_normal(), -bound_sd, bound_sd))


#: Stride time of healthy adults (Perry and Burnfield 2010: 1.06 to 1.12 s).
STRIDE_S = 1.10
#: Way of the pelvis (m) within a stride: up and down, side to side.
BOB_M, SWAY_M = 0.020, 0.022
#: Height of the pelvis above the floor (m).
PELVIS_HEIGHT_M = 0.95
#: The pelvis' own angles among `MIDDLE_CURVES_DEG`.
_PELVIS = ("tilt", "list", "rotation")


def plain_walk(
    time_s: Float[np.ndarray, " T"],
    *,
    stride_s: float = STRIDE_S,
    speed_m_per_s: float = 1.2,
    heading_rad: float = np.pi / 2,
    start_m: tuple[float, float] = (6.0, -1.8),
    camera_height_m: float = 1.2,
) -> Float[np.ndarray, "T 40"]:
    """Return joint values (T, 40) of a walk straight ahead along mean curves, each stride like the others.

    The right foot comes down at whole multiples of `stride_s`, the left one half a stride later; the pelvis is above
    `start_m` at time 0.
    """
    time_s = np.asarray(time_s, np.float64)
    phase = 2 * np.pi * time_s / stride_s
    angles = {a: c[0] + swing(c, phase) for a, c in MIDDLE_CURVES_DEG.items()}
    for side, shift in (("r", 0.0), ("l", np.pi)):
        angles |= {f"{a}_{side}": c[0] + swing(c, phase + shift) for a, c in SIDE_CURVES_DEG.items()}
    heading = np.full(len(time_s), float(heading_rad))
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    floor = np.asarray(start_m) + speed_m_per_s * time_s[:, None] * ahead
    height = PELVIS_HEIGHT_M - camera_height_m - BOB_M * np.cos(2 * phase - 0.6)
    return qpos_of(angles, floor, heading, SWAY_M * np.sin(phase - 0.3), height)


def qpos_of(
    angles_deg: Mapping[str, np.ndarray],
    floor_m: Float[np.ndarray, "T 2"],
    heading_rad: Float[np.ndarray, " T"],
    aside_m: Float[np.ndarray, " T"],
    height_m: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T 40"]:
    """Joint values from angles and the pelvis' way: `floor_m`, `aside_m` to its right, `height_m` in the world."""
    body = load_body()
    column = {n: i for i, n in enumerate(body.joint_names)}
    qpos = np.zeros((len(heading_rad), len(body.joint_names)))
    pelvis = [np.radians(angles_deg[name]) for name in _PELVIS]
    for angle, deg in angles_deg.items():
        if angle not in _PELVIS:
            joint, sign = joint_of(angle)
            qpos[:, column[joint]] = sign * np.radians(deg)
    for name, rad in zip(_PELVIS, pelvis_joints(np.column_stack(pelvis), heading_rad).T, strict=True):
        qpos[:, column[f"pelvis_{name}"]] = rad
    # Over the standing foot: to the right in the right side's stance; highest in the middle of each stance.
    floor = floor_m + aside_m[:, None] * np.column_stack([np.sin(heading_rad), -np.cos(heading_rad)])
    rest = body.mj_model.body("pelvis").pos
    qpos[:, column["pelvis_tx"]] = floor[:, 0] - rest[0]
    qpos[:, column["pelvis_tz"]] = -(floor[:, 1] - rest[1])
    qpos[:, column["pelvis_ty"]] = height_m - rest[2]
    return qpos


def pelvis_joints(angles_rad: Float[np.ndarray, "T 3"], heading_rad: Float[np.ndarray, " T"]) -> np.ndarray:
    """pelvis_tilt, pelvis_list and pelvis_rotation (T, 3) in rad of a pelvis that is turned against its heading.

    The model turns the pelvis about the world's axes (right, forward, up of a person who looks along x; tilt, list,
    rotation, each about the axes the ones before have turned). `angles_rad` are the same three about the axes of the
    walking direction, so that they are what gait people mean at any heading. The rotation is continuous in time.
    """
    turned = Y_UP_TO_Z_UP @ Rotation.from_euler("ZXY", angles_rad).as_matrix()
    world = Rotation.from_euler("Z", heading_rad[:, None]).as_matrix() @ turned
    joints = Rotation.from_matrix(Y_UP_TO_Z_UP.T @ world).as_euler("ZXY")
    rotation = np.unwrap(joints[:, 2])
    whole = np.round((np.median(heading_rad) - np.median(rotation)) / (2 * np.pi))
    return np.column_stack([joints[:, 0], joints[:, 1], rotation + 2 * np.pi * whole])


#: Motions are planned and solved on a grid of this step (s) and sampled from it by cubic splines.
GRID_STEP_S = 0.01
#: The grid begins and ends this long before and after the motion (s).
MARGIN_S = 0.6


@dataclasses.dataclass(frozen=True)
class Step:
    """One stance of one foot.

    side: "r" or "l"; down_s, up_s: its events, -inf and inf for a foot that stands from the start or to the end;
    xy_m, heading_rad: where the origin of the calcaneus stands on the floor and where the foot points;
    nominal_s: how long such a stance lasts, from which the phases of the roll are taken; forefoot: 0..1, how much of
    the landing is on the forefoot (drop foot) instead of the heel.
    """

    side: str
    down_s: float
    up_s: float
    xy_m: tuple[float, float]
    heading_rad: float
    nominal_s: float
    forefoot: float = 0.0

    @property
    def heel_s(self) -> tuple[float, float]:
        """Time with the heel on the floor."""
        return self.down_s + 0.12 * self.forefoot * self.nominal_s, self.up_s - HEEL_OFF_BEFORE * self.nominal_s

    @property
    def ball_s(self) -> tuple[float, float]:
        """Time with the ball of the foot on the floor."""
        flat = 0.0 if self.forefoot > 0 else FLAT_AFTER
        return self.down_s + flat * self.nominal_s, self.up_s - BALL_OFF_BEFORE * self.nominal_s

    @property
    def toe_s(self) -> tuple[float, float]:
        """Time with the toes on the floor, which leave it last."""
        return self.ball_s[0], self.up_s


#: Roll of the foot in fractions of the stance: flat after the heel's contact, heel and ball off before the toes.
FLAT_AFTER, HEEL_OFF_BEFORE, BALL_OFF_BEFORE = 0.13, 0.42, 0.08


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A motion on a grid of N times."""

    grid_s: Float[np.ndarray, " N"]  # (N,)
    #: (N, 2), (N,) way of the pelvis' origin on the floor and where the person faces.
    xy_m: Float[np.ndarray, "N 2"]
    heading_rad: Float[np.ndarray, " N"]
    #: (N,) 1 where the pelvis follows `xy_m`, 0 where it goes where the standing feet and the posture put it.
    on_path: Float[np.ndarray, " N"]
    speed_m_per_s: Float[np.ndarray, " N"]  # (N,) along the way, which sets how much of a walk the legs and arms do
    steps: tuple[Step, ...]  # all stances, in order of initial contact
    #: angle -> (N,) of both sides while the person does not walk: hip_flexion, knee_flexion, ankle_angle, tilt,
    #: lumbar_extension, arm_flex, elbow_flex; missing ones are those of standing.
    posture_deg: dict[str, np.ndarray]

    def moved(self, yaw_rad: float, to_m: tuple[float, float]) -> Plan:
        """The same motion turned about the vertical by `yaw_rad`, then moved."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, -s], [s, c]])
        steps = []
        for x in self.steps:
            at = turn @ x.xy_m + to_m
            place = (float(at[0]), float(at[1]))
            steps.append(dataclasses.replace(x, xy_m=place, heading_rad=x.heading_rad + yaw_rad))
        return dataclasses.replace(
            self, xy_m=self.xy_m @ turn.T + to_m, heading_rad=self.heading_rad + yaw_rad, steps=tuple(steps)
        )


def grid(seconds: float) -> np.ndarray:
    """Times of the grid for a motion of `seconds`, with `MARGIN_S` on both sides."""
    n = round(MARGIN_S / GRID_STEP_S)
    return GRID_STEP_S * np.arange(-n, round(np.ceil(seconds / GRID_STEP_S)) + n + 1)


def ease(x: np.ndarray) -> np.ndarray:
    """From 0 at x <= 0 to 1 at x >= 1 with the least jerk."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def fade(x: np.ndarray) -> np.ndarray:
    """From 0 at x <= 0 to 1 at x >= 1, a cubic with level ends."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
