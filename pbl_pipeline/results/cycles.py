"""A gait cycle with its curves, its lengths and why it is left out."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from pbl_pipeline.qc import CADENCE
from pbl_pipeline.records import column, record, stored

#: Angles of the fitted body: the pelvis' forward axis is level in neutral standing, because Delp's frame of the pelvis
#: (OpenSim's) has its frontal plane through the anterior spines and the pubic symphysis.
BODY_ANGLES = "pbl_body"


@record
class Exclusion:
    """Reasons against a cycle; none if it is used.

    `first_step`, `last_step`: it touches the first or last step of its walking bout. `length_ratio`: its length over
    the typical stride's, if that is odd and the feet do not show one stride; `length_unproven`: the feet are not known,
    so it may be one. `curve_distance_deg`: distance of its curves from the median curves of the `n_curves` cycles of
    its side, if that is large. `failed_checks`: checks of the fit that FAIL, or `CADENCE`.
    """

    first_step: bool = column("cycle_first_step", "touches the first step of its walking bout", "bool", default=False)
    last_step: bool = column("cycle_last_step", "touches the last step of its walking bout", "bool", default=False)
    length_ratio: float | None = column(
        "cycle_length_ratio", "(1) length over the typical stride's, null unless left out for it", default=None
    )
    length_unproven: bool = column(
        "cycle_length_unproven",
        "no feet show whether a step was missed; null: not left out for its length, or not known",
        "bool",
        null=True,
        default=False,
    )
    curve_distance_deg: float | None = column(
        "cycle_curve_distance", "(deg) from its side's median curves, null unless left out for it", default=None
    )
    n_curves: int | None = column("cycle_curves_n", "cycles of that median, null with it", "int16", default=None)
    failed_checks: tuple[str, ...] = column(
        "cycle_failed_checks", "names of the checks of the fit that FAIL, such as []", "json", default=()
    )

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


class Curves(NamedTuple):
    """Fields of a `GaitCycle` in its file of curves, not in metrics.json."""

    curves: dict[str, np.ndarray]
    curves_sd: dict[str, np.ndarray]
    error_model: str


#: Reason why a cycle without a fit has no lengths.
NO_POSITIONS = "no positions on the floor"


@record
class Lengths:
    """Lengths (m) of one cycle, None if not known (`missing`: the reason).

    `stride_length_m` between two positions of the same foot; `step_length_m` of the step that ends the cycle, from the
    other foot to this one along the stride; `step_width_m` between the other foot and the line of the stride. `metric`
    is False if the metres are a detector's, which guesses the person's height; with a stated height they are true, but
    the step width stays unknown.
    """

    stride_length_m: float | None = column("cycle_stride_length", "(m) over the floor", default=None)
    step_length_m: float | None = column("cycle_step_length", "(m) of the step that ends the cycle", default=None)
    step_width_m: float | None = column("cycle_step_width", "(m) null unless the metres were measured", default=None)
    missing: str = column(
        "cycle_lengths_missing", "why there are no lengths", "varchar(1000)", old="", cut=True, default=""
    )
    metric: bool = column(
        "cycle_lengths_metric",
        "false: as large as the detector takes the person to be",
        "bool",
        null=True,
        before="missing",
        default=False,
    )


@record
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
    number: int = column("cycle_no", "in order of time, both sides together, from 0", "int16", key=True)
    bout: int = column("cycle_bout", "walking bout, from 0", "int16")
    side: str = column("cycle_side", type="enum('left', 'right')", before="bout")
    start_s: float = column("cycle_start", "(s) foot down", meaning="initial contact")
    opposite_foot_up_s: float = column("opposite_foot_up", "(s)", meaning="toe-off of the other foot")
    opposite_foot_down_s: float = column("opposite_foot_down", "(s)", meaning="initial contact of the other foot")
    foot_up_s: float = column("cycle_foot_up", "(s)", meaning="toe-off")
    end_s: float = column("cycle_end", "(s) next foot down of the same side", meaning="next initial contact")
    exclusion: Exclusion = dataclasses.field(default_factory=Exclusion)
    curves: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    curves_missing: str = column("curves_missing", "why it has no curves", "varchar(1000)", cut=True, default="")
    curves_sd: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    lengths: Lengths = dataclasses.field(default_factory=lambda: Lengths(missing=NO_POSITIONS))
    angle_model: str = BODY_ANGLES
    far_leg: str = column(
        "cycle_far_leg",
        "the leg that one camera saw behind the other, if one",
        "enum('left', 'right')",
        null=True,
        meaning="leg that the other hid from the camera",
        before="lengths",
        default="",
    )
    error_model: str = ""

    @property
    @stored("cycle_used", "false where one of the next six says why", "bool", before="exclusion")
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
