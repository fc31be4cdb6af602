"""Plan of a motion before it is solved: the way of the pelvis, and where and when each foot stands."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

#: Motions are planned and solved on a grid of this step (s) and sampled from it by cubic splines.
GRID_STEP_S = 0.01


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
        """When the heel is on the floor."""
        return self.down_s + 0.12 * self.forefoot * self.nominal_s, self.up_s - HEEL_OFF_BEFORE * self.nominal_s

    @property
    def ball_s(self) -> tuple[float, float]:
        """When the ball of the foot is on the floor."""
        flat = 0.0 if self.forefoot > 0 else FLAT_AFTER
        return self.down_s + flat * self.nominal_s, self.up_s - BALL_OFF_BEFORE * self.nominal_s

    @property
    def toe_s(self) -> tuple[float, float]:
        """When the toes are on the floor: they leave it last."""
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
    steps: tuple[Step, ...]  # all stances, in order of foot down
    #: angle -> (N,) of both sides where nobody walks: hip_flexion, knee_flexion, ankle_angle, tilt, lumbar_extension,
    #: arm_flex, elbow_flex; missing ones are those of standing.
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


def grid(seconds: float, margin_s: float = 0.6) -> np.ndarray:
    """Times of the grid for a motion of `seconds`, with a margin on both sides."""
    n = round(margin_s / GRID_STEP_S)
    return GRID_STEP_S * np.arange(-n, round(np.ceil(seconds / GRID_STEP_S)) + n + 1)


def ease(x: np.ndarray) -> np.ndarray:
    """From 0 at x <= 0 to 1 at x >= 1 with the least jerk."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)
