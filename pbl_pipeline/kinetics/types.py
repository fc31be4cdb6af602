"""Results of the stage: curves and measures of gait cycles, and the measures of a visit with their intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from pbl_pipeline import words
from pbl_pipeline.gait import GaitCycle, GaitEvents
from pbl_pipeline.qc import Check
from pbl_pipeline.results.forces import KineticMeasure

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
MEASURES = tuple(words.KINETICS)


@dataclasses.dataclass(frozen=True)
class KineticsParams:
    """Parameters of the stage."""

    cutoff_hz: float = 6.0  # of the low-pass of the joint values
    samples: int = 20  # number of motions that are drawn from the fit's uncertainty for the intervals
    varying_turns: float = 0.05  # fraction of the variance that varies over a walk, of joint angles
    varying_slides: float = 0.002  # the same of the position of the pelvis
    memory_s: float = 0.2  # correlation time of the error
    vertical_model: str = "vertical-force-2"  # model of the vertical force of one camera (`load_vertical_model`)


class Walk(Protocol):
    """The parts of a trial's gait that the stage reads, such as of a `TrialMetrics`."""

    @property
    def events(self) -> GaitEvents: ...

    @property
    def cycles(self) -> tuple[GaitCycle, ...]: ...

    @property
    def pooled(self) -> bool: ...


@dataclasses.dataclass(frozen=True)
class CycleKinetics:
    """Kinetics of one gait cycle."""

    number: int  # this and `side` as in its `GaitCycle`
    side: str
    used: bool
    #: Names of `CURVES` -> (51,) at 0, 2, ..., 100 % of the cycle.
    curves: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    curves_sd: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    measures: Mapping[str, float] = dataclasses.field(default_factory=dict)  # the known ones of `MEASURES`
    missing: str = ""  # reason of missing results


@dataclasses.dataclass(frozen=True)
class Series:
    """Kinetics over N times of a trial, per kilogram; world frame (z up). NaN where contact is not known."""

    time_s: np.ndarray  # (N,)
    force_bw: np.ndarray  # (N, 2, 3) of [left, right], in body weights
    centre_m: np.ndarray  # (N, 2, 3) centres of pressure
    moment_nm_per_kg: np.ndarray  # (N, 2, 6) of `joints.MOMENTS`
    power_w_per_kg: np.ndarray  # (N, 2, 6)
    residual_bw: np.ndarray  # (N, 3) force that no foot carries
    residual_nm_per_kg: np.ndarray  # (N, 3) moment that no foot carries
    centre_of_mass_m: np.ndarray  # (N, 3)
    ahead: np.ndarray  # (N, 2) direction that the pelvis faces
    knee_adduction_nm_per_kg: np.ndarray  # (N, 2) of `joints.knee_adduction`


@dataclasses.dataclass(frozen=True)
class TrialKinetics:
    """Kinetics of one trial. `code` and `reason` explain missing results, otherwise both are empty."""

    name: str
    status: str
    code: str
    reason: str
    cycles: tuple[CycleKinetics, ...] = ()
    series: Series | None = dataclasses.field(default=None, compare=False, repr=False)
    samples: np.ndarray | None = dataclasses.field(default=None, compare=False, repr=False)


@dataclasses.dataclass(frozen=True)
class Kinetics:
    """Kinetics of a visit: measures over all used cycles of its trials, and the trials."""

    status: str
    code: str
    reason: str
    measures: Mapping[str, KineticMeasure]
    reasons: Mapping[str, str]  # of each missing measure
    mass_kg: float | None  # the stated mass; all numbers are per body weight or per kilogram and do not need it
    residual_bw: float | None  # root mean square of the force that no foot carries, over the used cycles
    method: str
    params_hash: str
    trials: tuple[TrialKinetics, ...]
    qc: tuple[Check, ...] = ()
