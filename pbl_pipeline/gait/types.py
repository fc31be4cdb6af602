"""The activity of a trial, and the Movement Analysis Profile."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from pbl_pipeline.names import check_label
from pbl_pipeline.results.events import LEFT, RIGHT, SIDES
from pbl_pipeline.results.index import MovementProfile
from pbl_pipeline.texts import code_of

from .normative import NINE_ANGLES, NormativeSet

_PELVIS = ("pelvis_tilt", "pelvis_obliquity", "pelvis_rotation")


def feature_vector(curves: Mapping[str, np.ndarray], variables: Sequence[str], percent: np.ndarray) -> np.ndarray:
    """The curves (deg) of some angles one after another, each at these percents of the cycle."""
    phase = np.linspace(0.0, 100.0, len(next(iter(curves.values()))))
    return np.concatenate([np.interp(percent, phase, curves[v]) for v in variables])


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


#: Usual activities and paces; others are allowed.
ACTIVITIES = ("walking", "tug", "sit_to_stand", "fsst", "tandem", "standing", "stairs", "squat", "running")
PACES = ("self_selected", "fast", "slow", "dual_task")
SELF_SELECTED = "self_selected"
#: As the pace of a method: walking at any pace.
ANY_PACE = "any"
UNKNOWN = "unknown"
#: Words of an activity that is walking over the floor or a treadmill.
_WALKING = ("walk", "gait", "overground")


@dataclasses.dataclass(frozen=True)
class Condition:
    """Activity and pace of a trial. Unknown counts as walking, and as the pace that the person chose.

    Case, spaces, hyphens and the language make no difference: "Sit-to-stand" is "sit_to_stand". Raises `PblError`
    USAGE for a label of more than 32 characters.
    """

    activity: str = UNKNOWN
    pace: str = UNKNOWN

    def __post_init__(self) -> None:
        for name in ("activity", "pace"):
            stated = code_of(name, str(getattr(self, name) or UNKNOWN))
            text = "_".join(stated.lower().replace("-", " ").replace("_", " ").split())
            check_label(name, text, 32)
            object.__setattr__(self, name, text or UNKNOWN)

    @property
    def walks(self) -> bool:
        """True if the activity is walking."""
        return self.activity == UNKNOWN or any(word in self.activity for word in _WALKING)

    @property
    def pool(self) -> str:
        """The pace under which a method pools this trial; "" unless it is walking."""
        if not self.walks:
            return ""
        return SELF_SELECTED if self.pace == UNKNOWN else self.pace

    def pooled(self, pace: str) -> bool:
        """True if a method with this pace pools the trial."""
        return bool(self.pool) and pace in (ANY_PACE, self.pool)

    def __str__(self) -> str:
        return self.activity if self.pace == UNKNOWN else f"{self.activity}, {self.pace}"
