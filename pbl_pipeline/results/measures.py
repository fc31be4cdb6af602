"""A gait measure of a trial or a visit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

from pbl_pipeline.records import column, record
from pbl_pipeline.words import MEASURES

#: A 90 % interval of a normal error, in standard deviations.
Z90 = 1.6449


def minimal_change_of(sd_anew: float, confidence: float = 0.9) -> float:
    """Return z sqrt(2) sd: two values of one thing, whose new errors have the standard deviation `sd_anew` each, differ
    by more in 1 - confidence of cases (minimal detectable change; Weir 2005, J Strength Cond Res 19:231)."""
    from scipy.special import ndtri  # the tables import this module, and compute nothing

    return float(-ndtri((1 - confidence) / 2) * math.sqrt(2) * sd_anew)


def interval_90(mean: float | None, sd: float | None) -> tuple[float, float] | None:
    """The 90 % interval of a value whose error has the standard deviation `sd`; None if one is not known."""
    if mean is None or sd is None or not math.isfinite(sd):
        return None
    return mean - Z90 * sd, mean + Z90 * sd


#: Meaning of a column `minimal_change`.
MINIMAL_CHANGE = "minimal detectable change (90 percent)"
#: Fields of `Measure` that those of a visit have, not those of a trial.
OF_VISIT = ("error_sd", "minimal_change")
#: Fields of `Spatiotemporal` that stand in the row of the cycles.
COUNTS = ("n_cycles_found", "n_cycles_used")


@record
class Measure:
    """Mean and sd (n - 1; None for one value) over the n values of both sides; `left`, `right` are means of a side.

    `variability` is the sd within a side, both sides together: the root of the mean of their variances (n - 1), which
    does not contain an asymmetry; None with fewer than two values of a side. `cv_percent` is that in percent of the
    mean. `asymmetry_percent` is 100 (right - left) / ((right + left) / 2), None for measures that are not `SIDED` and
    if one camera saw the same leg behind the other in most cycles (`far_leg_of`).
    `error_sd` is the standard deviation of the error of `mean`: the measured error of camera, detector and fit, and the
    sampling error of n values; `minimal_change` the minimal detectable change (90 %) between two visits filmed alike.
    None if the error was not measured.
    """

    left: float | None = column("{}_left", "in the unit (see {})", meaning="mean of the left side")
    right: float | None = column("{}_right", "in the unit (see {})", meaning="mean of the right side")
    mean: float = column(
        "{}_mean", "in the unit (see {}): both sides", null=True, before="left", meaning="mean over both sides"
    )
    sd: float | None = column(
        "{}_sd", "in the unit (see {}): n - 1, null for one value", meaning="standard deviation over both sides (n - 1)"
    )
    n: int = column("{}_n", "values", "int16", before="error_sd", meaning="number of values")
    variability: float | None = column(
        "{}_variability",
        "in the unit (see {}): sd within a side, null below two values of a side",
        meaning="standard deviation within a side",
        default=None,
    )
    cv_percent: float | None = column(
        "{}_cv", "(percent) variability of the mean", meaning="variability in percent of the mean", default=None
    )
    asymmetry_percent: float | None = column(
        "{}_asymmetry",
        "(percent) right minus left, of their mean; null where it means nothing",
        meaning="100 (right - left) / mean of both",
        default=None,
    )
    error_sd: float | None = column(
        "{}_error",
        "in the unit (see {}): standard deviation of the error of the mean",
        meaning="standard deviation of the error of the mean",
        default=None,
    )
    minimal_change: float | None = column(
        "{}_minimal_change",
        f"in the unit (see {{}}): {MINIMAL_CHANGE}",
        meaning="minimal detectable change (90 %) between two visits filmed alike",
        default=None,
    )

    @property
    def errors(self) -> tuple[float | None, float | None]:
        """Standard deviation of the error and minimal detectable change."""
        return self.error_sd, self.minimal_change

    @property
    def interval(self) -> tuple[float, float] | None:
        """90 % interval of the mean: of its whole error if that was measured (`error_sd`). Else over repetitions,
        mean +- t sd / sqrt(n) by Student's t, from the spread of the cycles: a constant error of camera, detector and
        fit is not contained.

        The sd is `variability` if it is known (n - 2 degrees of freedom), else `sd` (n - 1); None without either.
        """
        if self.error_sd is not None:
            return interval_90(self.mean, self.error_sd)
        from scipy.special import stdtrit  # not `scipy.stats`, which takes longer to import than most commands run

        sd, freedom = (self.variability, self.n - 2) if self.variability is not None else (self.sd, self.n - 1)
        if sd is None or freedom < 1:
            return None
        half = float(-stdtrit(freedom, 0.05)) * sd / math.sqrt(self.n)
        return self.mean - half, self.mean + half


@record
class Spatiotemporal:
    """Measures by name (`MEASURES`); None if one cannot be trusted, with the reason in `reasons`.

    In a trial of a task the measures of the task (`TASK_MEASURES`) follow, whatever the `status`, which is that of
    walking.

    `reasons["spread"]`, if present, is the reason why no measure has a spread. `n_cycles_found` and `n_cycles_used`
    count before and after the exclusions of `find_cycles`.
    """

    status: str = column("measures_status", type="enum('PASS', 'EMPTY')")
    reason: str = column("measures_reason", "why EMPTY", "varchar(1000)", cut=True)
    measures: dict[str, Measure | None]
    reasons: dict[str, str]
    n_cycles_found: int = column("n_cycles", "all complete cycles", "int16")
    n_cycles_used: int = column("n_cycles_used", "without first and last steps, odd lengths and odd curves", "int16")
    n_steps_used: int = column("n_steps_used", type="int16")

    def __getitem__(self, name: str) -> Measure | None:
        return self.measures.get(name)

    @property
    def of_task(self) -> dict[str, Measure | None]:
        """The measures of a task; empty for a trial of walking and for a session."""
        return {name: m for name, m in self.measures.items() if name not in MEASURES}

    def with_task(self, measures: Mapping[str, Measure | None], reasons: Mapping[str, str]) -> Spatiotemporal:
        both = {**self.measures, **measures}, {**self.reasons, **reasons}
        return dataclasses.replace(self, measures=both[0], reasons=both[1])
