"""A gait cycle with its curves, lengths and exclusion; the activity of a trial; the Movement Analysis Profile."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from pbl_pipeline.names import check_label
from pbl_pipeline.qc import CADENCE
from pbl_pipeline.texts import code_of

from .events import LEFT, RIGHT, SIDES
from .normative import BODY_ANGLES, NINE_ANGLES, NormativeSet

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


def _rounded(value: float | dict | None) -> float | dict | None:
    if isinstance(value, dict):
        return {k: round(v, 3) for k, v in value.items()}
    return None if value is None else round(value, 3)


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


@dataclasses.dataclass(frozen=True)
class Exclusion:
    """Reasons against a cycle; none if it is used.

    `first_step`, `last_step`: it touches the first or last step of its walking bout. `length_ratio`: its length over
    the typical stride's, if that is odd and the feet do not show one stride; `length_unproven`: the feet are not known,
    so it may be one. `curve_distance_deg`: distance of its curves from the median curves of the `n_curves` cycles of
    its side, if that is large. `failed_checks`: checks of the fit that FAIL, or `CADENCE`.
    """

    first_step: bool = False
    last_step: bool = False
    length_ratio: float | None = None
    length_unproven: bool = False
    curve_distance_deg: float | None = None
    n_curves: int | None = None
    failed_checks: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """True if there is a reason."""
        return self != Exclusion()

    @property
    def text(self) -> str:
        """The reasons in words, empty if there is none; of a failed check that alone."""
        if CADENCE in self.failed_checks:
            return "the cadence is unusual for walking, and no one has accepted it"
        if self.failed_checks:
            return f"the fit failed its check {', '.join(self.failed_checks)}"
        reasons = ["first step of the bout"] if self.first_step else []
        reasons += ["last step of the bout"] if self.last_step else []
        if self.length_ratio is not None:
            unproven = ", without feet that show whether a step was missed" if self.length_unproven else ""
            reasons.append(f"{self.length_ratio:.2f} times the typical stride{unproven}")
        if self.curve_distance_deg is not None:
            reasons.append(f"{self.curve_distance_deg:.0f} deg from the median curves of {self.n_curves} cycles")
        return " and ".join(reasons)


#: Reason why a cycle without a fit has no lengths.
NO_POSITIONS = "no positions on the floor"


@dataclasses.dataclass(frozen=True)
class Lengths:
    """Lengths (m) of one cycle, None if not known (`missing`: the reason).

    `stride_length_m` between two positions of the same foot; `step_length_m` of the step that ends the cycle, from the
    other foot to this one along the stride; `step_width_m` between the other foot and the line of the stride. `metric`
    is False if the metres are a detector's, which guesses the person's height; with a stated height they are true, but
    the step width stays unknown.
    """

    stride_length_m: float | None = None
    step_length_m: float | None = None
    step_width_m: float | None = None
    missing: str = ""
    metric: bool = False


@dataclasses.dataclass(frozen=True)
class GaitCycle:
    """One stride: initial contact to the next initial contact of the same side.

    Times in seconds of the trial. In order: `start_s` (initial contact), `opposite_foot_up_s`, `opposite_foot_down_s`,
    `foot_up_s`, `end_s`. `number` counts the cycles of a trial in order of time, both sides together, from 0.
    `used` is False for the cycles that touch the first or last step of their walking bout, for those that are far
    longer or shorter than the others and not one stride (`odd_length`) or whose curves are far from the others'
    (`odd_curves`), and for all of a recording of which a check failed; `exclusion` has the reason, `excluded` in words.
    `curves` maps names of `ANGLE_NAMES` to (51,) degrees at 0, 2, ..., 100 % of the cycle; empty without a fit or if
    frames are missing (`curves_missing`: the reason, also for absent angles); `curves_sd` maps them to their standard
    deviation (deg), if it is known. `angle_model`: the definition of the angles.
    `lengths` are those on the floor, None with the reason if they are not known. `far_leg`: "left" or "right" if one
    camera saw that leg behind the other, else empty. `error_model`: the measured model of the error of such curves
    (`measurement.model_names`), empty if there is none.
    """

    trial: str
    number: int
    bout: int
    side: str
    start_s: float
    opposite_foot_up_s: float
    opposite_foot_down_s: float
    foot_up_s: float
    end_s: float
    exclusion: Exclusion = dataclasses.field(default_factory=Exclusion)
    curves: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    curves_missing: str = ""
    curves_sd: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    lengths: Lengths = dataclasses.field(default_factory=lambda: Lengths(missing=NO_POSITIONS))
    angle_model: str = BODY_ANGLES
    far_leg: str = ""
    error_model: str = ""

    @property
    def used(self) -> bool:
        """True if the cycle takes part in the measures."""
        return not self.exclusion

    @property
    def excluded(self) -> str:
        """Reason why the cycle is left out, in words; empty if it is used."""
        return self.exclusion.text

    @property
    def odd_length(self) -> bool:
        """True if the cycle is left out because of its length."""
        return self.exclusion.length_ratio is not None

    @property
    def odd_curves(self) -> bool:
        """True if the cycle is left out because of its curves."""
        return self.exclusion.curve_distance_deg is not None

    @property
    def check_failed(self) -> bool:
        """True if the cycle is left out because a check of its recording failed."""
        return bool(self.exclusion.failed_checks)

    @property
    def stride_time_s(self) -> float:
        """Initial contact to the next initial contact of the same side."""
        return self.end_s - self.start_s
