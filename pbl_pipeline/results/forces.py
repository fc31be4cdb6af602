"""A kinetic measure of a visit."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.records import column

#: Half of a 90 % interval in standard deviations.
WIDTH_SD = 1.645


@dataclasses.dataclass(frozen=True)
class KineticMeasure:
    """Means over the used cycles of each side and over both sides, with their standard deviations (None: not known).

    The error is that of the fit, by sampling, that of the method, by force plates, of one camera what its fit loses in
    any walk, by known walks, and the spread of the cycles; `interval` is the 90 % interval of `mean`.
    `asymmetry_percent` is 100 (right - left) / ((right + left) / 2), None for what is not a measure of one leg, where
    one camera saw the same leg behind the other, and where its standard deviation is more than
    `compute.MAX_ASYMMETRY_SD`.
    """

    left: float | None = column("{}_left", "in the unit (see {0}_measure)")
    right: float | None = column("{}_right", "in the unit (see {0}_measure)")
    mean: float = column("{}_mean", "in the unit (see {0}_measure): both sides", null=True, before="left")
    sd_left: float | None = column("{}_sd_left", "in the unit (see {0}_measure)")
    sd_right: float | None = column("{}_sd_right", "in the unit (see {0}_measure)")
    sd: float | None = column(
        "{}_sd", "in the unit (see {0}_measure): standard deviation of the error of {0}_mean", before="sd_left"
    )
    n: int = column("{}_n", "values", "int16", before="(end)")
    asymmetry_percent: float | None = column(
        "{}_asymmetry", "(percent) right minus left, of their mean; null where too uncertain", default=None
    )
    asymmetry_sd: float | None = column("{}_asymmetry_sd", "(percent) standard deviation of its error", default=None)

    @property
    def interval(self) -> tuple[float, float] | None:
        """90 % interval of the mean."""
        return None if self.sd is None else (self.mean - WIDTH_SD * self.sd, self.mean + WIDTH_SD * self.sd)

    def to_dict(self) -> dict[str, Any]:
        """Return the measure for JSON."""
        own = {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}
        interval = dataclasses.replace(self, **own).interval
        return {**own, "interval": None if interval is None else [round(v, 4) for v in interval]}
