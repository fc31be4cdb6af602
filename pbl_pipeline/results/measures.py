"""A gait measure of a trial or a visit."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

from pbl_pipeline.records import Column

#: A 90 % interval of a normal error, in standard deviations.
Z90 = 1.6449
#: Fields of `Measure` that those of a visit have, not those of a trial.
OF_VISIT = ("error_sd", "minimal_change")


@dataclasses.dataclass(frozen=True)
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

    left: Annotated[float | None, Column("{}_left", "float64", "in the unit (see {})", null=True)]
    right: Annotated[float | None, Column("{}_right", "float64", "in the unit (see {})", null=True)]
    mean: Annotated[float, Column("{}_mean", "float64", "in the unit (see {}): both sides", null=True, before="left")]
    sd: Annotated[
        float | None, Column("{}_sd", "float64", "in the unit (see {}): n - 1, null for one value", null=True)
    ]
    n: Annotated[int, Column("{}_n", "int16", "values", before="error_sd")]
    variability: Annotated[
        float | None,
        Column(
            "{}_variability",
            "float64",
            "in the unit (see {}): sd within a side, null below two values of a side",
            null=True,
        ),
    ] = None
    cv_percent: Annotated[float | None, Column("{}_cv", "float64", "(percent) variability of the mean", null=True)] = (
        None
    )
    asymmetry_percent: Annotated[
        float | None,
        Column(
            "{}_asymmetry",
            "float64",
            "(percent) right minus left, of their mean; null where it means nothing",
            null=True,
        ),
    ] = None
    error_sd: Annotated[
        float | None,
        Column("{}_error", "float64", "in the unit (see {}): standard deviation of the error of the mean", null=True),
    ] = None
    minimal_change: Annotated[
        float | None,
        Column(
            "{}_minimal_change", "float64", "in the unit (see {}): minimal detectable change (90 percent)", null=True
        ),
    ] = None

    def to_dict(self) -> dict:
        return {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}

    @property
    def interval(self) -> tuple[float, float] | None:
        """90 % interval of the mean: of its whole error if that was measured (`error_sd`). Else over repetitions,
        mean +- t sd / sqrt(n) by Student's t, from the spread of the cycles: a constant error of camera, detector and
        fit is not contained.

        The sd is `variability` if it is known (n - 2 degrees of freedom), else `sd` (n - 1); None without either.
        """
        if self.error_sd is not None:
            return self.mean - Z90 * self.error_sd, self.mean + Z90 * self.error_sd
        from scipy.stats import t  # takes longer to import than most commands run

        sd, freedom = (self.variability, self.n - 2) if self.variability is not None else (self.sd, self.n - 1)
        if sd is None or freedom < 1:
            return None
        half = float(t.isf(0.05, freedom)) * sd / math.sqrt(self.n)
        return self.mean - half, self.mean + half
