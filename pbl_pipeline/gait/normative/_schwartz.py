"""Normal gait at any speed: joint angles over the gait cycle, cadence and stance, after Schwartz et al. 2008."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from pbl_pipeline.shipped import shipped_text

#: Acceleration of gravity (m/s^2), which makes speeds comparable between people: v / sqrt(g * leg length).
GRAVITY = 9.81


@dataclasses.dataclass(frozen=True, eq=False)
class GaitNorm:
    """Curves of the gait cycle that are continuous in phase and speed.

    Speeds are dimensionless, v / sqrt(g L) with the leg length L; below the slowest and above the fastest of the five
    groups the curves are those of that group.
    """

    #: Names of the five groups, their mean speed, cadence (steps per sqrt(L / g)) and foot off (of the cycle).
    groups: tuple[str, ...]
    speed: np.ndarray
    cadence: np.ndarray
    foot_off: np.ndarray
    #: angle -> (5, 1 + 2 K): mean, then (cosine, sine) of harmonics 1, 2, ...; phase 0 is the foot contact of the
    #: angle's side. Signs: anterior tilt, side up, side ahead, flexion, adduction, internal rotation, dorsiflexion
    #: positive; `foot_progression` toes in positive.
    mean_deg: Mapping[str, np.ndarray]
    sd_deg: Mapping[str, np.ndarray]
    source: str  # of the figures
    licence: str

    @property
    def angles(self) -> tuple[str, ...]:
        return tuple(self.mean_deg)

    def curve(
        self,
        angle: str,
        phase_rad: Float[np.ndarray, " T"],
        speed: float | Float[np.ndarray, " T"],
        *,
        sd: bool = False,
    ) -> Float[np.ndarray, " T"]:
        """The mean (or standard deviation) of an angle (deg) at phases of the cycle and dimensionless speeds."""
        return harmonic_sum(self.coefficients(angle, speed, sd=sd), phase_rad)

    def coefficients(self, angle: str, speed: float | np.ndarray, *, sd: bool = False) -> np.ndarray:
        """Mean and harmonics (..., 1 + 2 K) of an angle (deg) at dimensionless speeds."""
        return self._at((self.sd_deg if sd else self.mean_deg)[angle], speed)

    def cadence_at(self, speed: float) -> float:
        """Steps per sqrt(L / g) at a dimensionless speed: also below the slowest group, where it falls towards 0."""
        walk_ratio = self.cadence[0] / np.sqrt(self.speed[0])
        if speed < self.speed[0]:
            return float(walk_ratio * np.sqrt(speed))
        return float(self._at(self.cadence, speed))

    def foot_off_at(self, speed: float) -> float:
        """Fraction of the cycle at which the foot leaves the floor."""
        return float(self._at(self.foot_off, speed))

    def _at(self, table: np.ndarray, speed: float | np.ndarray) -> np.ndarray:
        return PchipInterpolator(self.speed, table)(np.clip(speed, self.speed[0], self.speed[-1]))


def harmonic_sum(coefficients: np.ndarray, phase_rad: np.ndarray) -> np.ndarray:
    """Mean and harmonics, given as (..., 1 + 2 K), at phases (...)."""
    k = np.arange(1, coefficients.shape[-1] // 2 + 1)
    turns = np.asarray(phase_rad)[..., None] * k
    return (
        coefficients[..., 0]
        + np.sum(coefficients[..., 1::2] * np.cos(turns), axis=-1)
        + np.sum(coefficients[..., 2::2] * np.sin(turns), axis=-1)
    )


@functools.cache
def gait_norm() -> GaitNorm:
    """The norm that ships with the package (`curves/schwartz_2008.json`, written by `build_schwartz.py`)."""
    raw = json.loads(shipped_text("gait/normative/curves/schwartz_2008.json"))
    return GaitNorm(
        groups=tuple(raw["groups"]),
        speed=np.array(raw["speed"]),
        cadence=np.array(raw["cadence"]),
        foot_off=np.array(raw["foot_off"]),
        mean_deg={name: np.array(a["mean_deg"]) for name, a in raw["angles"].items()},
        sd_deg={name: np.array(a["sd_deg"]) for name, a in raw["angles"].items()},
        source=raw["source"],
        licence=raw["licence"],
    )
