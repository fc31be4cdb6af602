"""A gait cycle with its curves and its lengths on the floor."""

from __future__ import annotations

import dataclasses

import numpy as np

from ._exclusion import Exclusion
from .normative import BODY_ANGLES

#: Why a cycle without a fit has no lengths.
NO_POSITIONS = "no positions on the floor"


@dataclasses.dataclass(frozen=True)
class Lengths:
    """Lengths (m) of one cycle, None where not known (`missing` says why).

    `stride_length_m` between two places of the own foot; `step_length_m` of the step that ends the cycle, from the
    other foot to the own one along the stride; `step_width_m` between that other foot and the line of the stride.
    `metric` is False where the metres are those of a detector that guesses how tall a person is; where her height was
    stated they are hers, but the step width stays unknown.
    """

    stride_length_m: float | None = None
    step_length_m: float | None = None
    step_width_m: float | None = None
    missing: str = ""
    metric: bool = False


@dataclasses.dataclass(frozen=True)
class GaitCycle:
    """One stride: foot down to the next foot down of the same side.

    Times in seconds of the trial. In order: `start_s` (foot down), `opposite_foot_up_s`, `opposite_foot_down_s`,
    `foot_up_s`, `end_s`. `number` counts the cycles of a trial in order of time, both sides together, from 0.
    `used` is False for the cycles that touch the first or last step of their walking bout, for those that are far
    longer or shorter than the others and not one stride (`odd_length`) or whose curves are far from the others'
    (`odd_curves`), and for all of a recording of which a check failed; `exclusion` says why, `excluded` in words.
    `curves` maps names of `ANGLE_NAMES` to (51,) degrees at 0, 2, ..., 100 % of the cycle; empty where there is
    no fit or frames are missing (`curves_missing` says which); `curves_sd` maps them to their standard deviation (deg),
    where it is known. `angle_model` says how the angles are defined.
    `lengths` are those on the floor, None with the reason where they are not known. `far_leg`: "left" or "right" where
    one camera saw that leg behind the other, else empty. `error_model`: the measured model of the error of such
    curves (`measurement.model_names`), empty where there is none.
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
        """Whether the cycle takes part in the measures."""
        return not self.exclusion

    @property
    def excluded(self) -> str:
        """Why the cycle is left out, in words; empty where it is used."""
        return self.exclusion.text

    @property
    def odd_length(self) -> bool:
        """Whether the cycle is left out because of its length."""
        return self.exclusion.length_ratio is not None

    @property
    def odd_curves(self) -> bool:
        """Whether the cycle is left out because of its curves."""
        return self.exclusion.curve_distance_deg is not None

    @property
    def check_failed(self) -> bool:
        """Whether the cycle is left out because a check of its recording failed."""
        return bool(self.exclusion.failed_checks)

    @property
    def stride_time_s(self) -> float:
        """Foot down to the next foot down of the same side."""
        return self.end_s - self.start_s
