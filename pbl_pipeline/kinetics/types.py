"""Results of the stage: curves and measures of gait cycles, and the measures of a visit with their intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from pbl_pipeline.gait import GaitCycle, GaitEvents
from pbl_pipeline.qc import Check

from .joints import MOMENTS

#: Curves of the force on the own foot, in body weights: up, forward (where the pelvis faces) and towards the other
#: foot.
FORCES = ("force_vertical_bw", "force_forward_bw", "force_medial_bw")
#: All curves of a cycle: forces, moments (Nm/kg) and powers (W/kg).
CURVES = (
    *FORCES,
    *(f"{name}_moment_nm_per_kg" for name in MOMENTS),
    *(f"{name}_power_w_per_kg" for name in ("hip_flexion", "knee_flexion", "ankle_angle")),
)
#: Measures of a cycle; the unit is in the name.
MEASURES = (
    "vertical_peak_loading_bw",
    "vertical_peak_push_off_bw",
    "vertical_impulse_bw_s",
    "braking_impulse_bw_s",
    "propulsion_impulse_bw_s",
    "knee_extension_moment_peak_nm_per_kg",
    "knee_adduction_moment_peak_nm_per_kg",
    "ankle_push_off_power_w_per_kg",
    "hip_work_j_per_kg",
    "knee_work_j_per_kg",
    "ankle_work_j_per_kg",
    "centre_of_mass_excursion_m",
)
#: Half of a 90 % interval in standard deviations.
WIDTH_SD = 1.645


@dataclasses.dataclass(frozen=True)
class KineticsParams:
    """Parameters of the stage.

    cutoff_hz: of the low-pass of the joint values; samples: how many motions are drawn from the fit's uncertainty for
    the intervals; varying_turns, varying_slides: the fraction of its variance that varies over a walk, of joint angles
    and of the pelvis' place; memory_s: how long an error stays alike; vertical_model: against which the vertical force
    of one camera is weighed (`vertical.load_vertical_model`).
    """

    cutoff_hz: float = 6.0
    samples: int = 20
    varying_turns: float = 0.05
    varying_slides: float = 0.002
    memory_s: float = 0.2
    vertical_model: str = "vertical-force-1"


class Walk(Protocol):
    """Gait of a trial as far as the stage reads it; a `TrialMetrics` is one."""

    @property
    def events(self) -> GaitEvents: ...

    @property
    def cycles(self) -> tuple[GaitCycle, ...]: ...

    @property
    def pooled(self) -> bool: ...


@dataclasses.dataclass(frozen=True)
class KineticMeasure:
    """Means over the used cycles of each side and over both sides, with their standard deviations (None: not known).

    The error is that of the fit, by sampling, that of the method, by force plates, and of one camera what its fit loses
    in any walk, by synthetic walkers; `interval` is the 90 % interval of `mean`. `asymmetry_percent` is 100 (right -
    left) / ((right + left) / 2), None for what is not a
    measure of one leg and where its standard deviation is more than `compute.MAX_ASYMMETRY_SD`.
    """

    left: float | None
    right: float | None
    mean: float
    sd_left: float | None
    sd_right: float | None
    sd: float | None
    n: int
    asymmetry_percent: float | None = None
    asymmetry_sd: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """90 % interval of the mean."""
        return None if self.sd is None else (self.mean - WIDTH_SD * self.sd, self.mean + WIDTH_SD * self.sd)

    def to_dict(self) -> dict[str, Any]:
        """Return the measure for JSON."""
        own = {k: round(v, 4) if isinstance(v, float) else v for k, v in dataclasses.asdict(self).items()}
        interval = dataclasses.replace(self, **own).interval
        return {**own, "interval": None if interval is None else [round(v, 4) for v in interval]}


@dataclasses.dataclass(frozen=True)
class CycleKinetics:
    """Of one gait cycle (`number` and `side` are those of its `GaitCycle`).

    curves and curves_sd map names of `CURVES` to (51,) at 0, 2, ..., 100 % of the cycle; measures maps names of
    `MEASURES` to numbers, of those that are known. Where there are none `missing` says why.
    """

    number: int
    side: str
    used: bool
    curves: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    curves_sd: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    measures: Mapping[str, float] = dataclasses.field(default_factory=dict)
    missing: str = ""


@dataclasses.dataclass(frozen=True)
class Series:
    """Over N times of a trial, per kilogram; world frame (z up). NaN where contact is not known.

    time_s (N,); force_bw (N, 2, 3) in body weights and centre_m (N, 2, 3) of [left, right]; moment_nm_per_kg,
    power_w_per_kg (N, 2, 6) of `joints.MOMENTS`; residual_bw (N, 3), residual_nm_per_kg (N, 3): what no foot carries;
    centre_of_mass_m (N, 3); ahead (N, 2): where the pelvis
    faces; knee_adduction_nm_per_kg (N, 2): `joints.knee_adduction`.
    """

    time_s: np.ndarray
    force_bw: np.ndarray
    centre_m: np.ndarray
    moment_nm_per_kg: np.ndarray
    power_w_per_kg: np.ndarray
    residual_bw: np.ndarray
    residual_nm_per_kg: np.ndarray
    centre_of_mass_m: np.ndarray
    ahead: np.ndarray
    knee_adduction_nm_per_kg: np.ndarray


@dataclasses.dataclass(frozen=True)
class TrialKinetics:
    """Of one trial. `code` and `reason` say why there is nothing, both empty where there is something."""

    name: str
    status: str
    code: str
    reason: str
    cycles: tuple[CycleKinetics, ...] = ()
    series: Series | None = dataclasses.field(default=None, compare=False, repr=False)
    samples: np.ndarray | None = dataclasses.field(default=None, compare=False, repr=False)


@dataclasses.dataclass(frozen=True)
class Kinetics:
    """Of a visit: measures over all used cycles of its trials, and the trials.

    `reasons` says of each measure that is absent from `measures` why. `mass_kg`: the person's stated mass, None where
    it was not stated; all numbers are per body weight or per kilogram, so none of them needs it. `residual_bw`: root
    mean square of the force that no foot carries, over the used cycles.
    """

    status: str
    code: str
    reason: str
    measures: Mapping[str, KineticMeasure]
    reasons: Mapping[str, str]
    mass_kg: float | None
    residual_bw: float | None
    method: str
    params_hash: str
    trials: tuple[TrialKinetics, ...]
    qc: tuple[Check, ...] = ()
