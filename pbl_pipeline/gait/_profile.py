"""Movement Analysis Profile and Gait Profile Score: how far each angle is from the norm, in degrees."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from .events import LEFT, RIGHT, SIDES
from .normative import NINE_ANGLES, NormativeSet

_PELVIS = ("pelvis_tilt", "pelvis_obliquity", "pelvis_rotation")


@dataclasses.dataclass(frozen=True)
class MovementProfile:
    """Gait Variable Scores (deg) per side and angle: together the Movement Analysis Profile.

    A score is the root mean square, over the cycle, of the distance from the normative mean curve; of several cycles
    their mean. `gps_left`, `gps_right` are the Gait Profile Scores of a side and `gps` that of the person, None unless
    the norm has all nine angles (`NINE_ANGLES`). Empty sides have no scores.
    """

    left: dict[str, float]
    right: dict[str, float]
    gps_left: float | None
    gps_right: float | None
    gps: float | None

    def of_side(self, side: str) -> dict[str, float]:
        """The scores of "left" or "right"."""
        return self.right if side == RIGHT else self.left

    def to_dict(self) -> dict:
        """`profile_deg` of metrics.json."""
        return {k: _rounded(v) for k, v in dataclasses.asdict(self).items()}


def variable_scores(vectors: np.ndarray, norm: NormativeSet) -> np.ndarray:
    """Gait Variable Scores (N, V) in degrees of feature vectors (N, V * P) of the norm's angles."""
    away = np.atleast_2d(vectors) - norm.mean_deg
    return np.sqrt(np.mean(away.reshape(len(away), len(norm.variables), -1) ** 2, axis=2))


def movement_profile(scores: Mapping[str, np.ndarray], norm: NormativeSet) -> MovementProfile:
    """Profile of a person from the scores (N, V) of the cycles of each side (`variable_scores`).

    Baker et al. 2009, Gait & Posture 30:265-269. The Gait Profile Score of a side is the root mean square of its nine
    scores; that of the person is over 15: the nine of the left side and, of the right, all but those of the pelvis,
    which both sides share.
    """
    means = {side: np.mean(scores[side], axis=0) for side in SIDES if side in scores and len(scores[side])}
    named = {side: dict(zip(norm.variables, map(float, m), strict=True)) for side, m in means.items()}
    whole = set(norm.variables) == set(NINE_ANGLES)
    gps = {side: _rms(list(v.values())) if whole else None for side, v in named.items()}
    both = None
    if whole and len(named) == 2:
        legs = [v for angle, v in named[RIGHT].items() if angle not in _PELVIS]
        both = _rms([*named[LEFT].values(), *legs])
    return MovementProfile(named.get(LEFT, {}), named.get(RIGHT, {}), gps.get(LEFT), gps.get(RIGHT), both)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _rounded(value: float | dict | None) -> float | dict | None:
    if isinstance(value, dict):
        return {k: round(v, 3) for k, v in value.items()}
    return None if value is None else round(value, 3)
