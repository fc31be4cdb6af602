"""Kinetics of gait cycles, trials and a visit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from pbl_pipeline.qc import Check
from pbl_pipeline.records import column, plain, record

from .measures import interval_90


@record
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
        return interval_90(self.mean, self.sd)

    def to_dict(self) -> dict[str, Any]:
        """Return the measure for JSON."""
        own = plain(self, 4)
        return {**own, "interval": plain(dataclasses.replace(self, **own).interval, 4)}


@record
class CycleKinetics:
    """Kinetics of one gait cycle."""

    number: int = column("cycle_no", type="int16", key=True)  # this and `side` as in its `GaitCycle`
    side: str
    used: bool
    #: Names of `kinetics.CURVES` -> (51,) at 0, 2, ..., 100 % of the cycle.
    curves: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    curves_sd: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict, compare=False, repr=False)
    measures: Mapping[str, float] = dataclasses.field(default_factory=dict)  # the known ones of `kinetics.MEASURES`
    missing: str = column("forces_missing", "why they are null", "varchar(1000)", cut=True, default="")


@record
class Series:
    """Kinetics over N times of a trial, per kilogram; world frame (z up). NaN where contact is not known."""

    time_s: np.ndarray  # (N,)
    force_bw: np.ndarray  # (N, 2, 3) of [left, right], in body weights
    centre_m: np.ndarray  # (N, 2, 3) centres of pressure
    moment_nm_per_kg: np.ndarray  # (N, 2, 6) of `kinetics.joints.MOMENTS`
    power_w_per_kg: np.ndarray  # (N, 2, 6)
    residual_bw: np.ndarray  # (N, 3) force that no foot carries
    residual_nm_per_kg: np.ndarray  # (N, 3) moment that no foot carries
    centre_of_mass_m: np.ndarray  # (N, 3)
    ahead: np.ndarray  # (N, 2) direction that the pelvis faces
    knee_adduction_nm_per_kg: np.ndarray  # (N, 2) of `kinetics.joints.knee_adduction`


@record
class TrialKinetics:
    """Kinetics of one trial. `code` and `reason` explain missing results, otherwise both are empty."""

    name: str
    status: str = column("trial_forces_status", type="enum('PASS', 'EMPTY')")
    code: str = column("trial_forces_code", "why EMPTY", "varchar(32)")
    reason: str = column("trial_forces_reason", "the code in words", "varchar(1000)", cut=True)
    cycles: tuple[CycleKinetics, ...] = ()
    series: Series | None = dataclasses.field(default=None, compare=False, repr=False)
    samples: np.ndarray | None = dataclasses.field(default=None, compare=False, repr=False)


@record
class Kinetics:
    """Kinetics of a visit: measures over all used cycles of its trials, and the trials."""

    status: str = column("forces_status", type="enum('PASS', 'EMPTY')")
    code: str = column("forces_code", "why EMPTY, such as AID or VERTICAL_UNKNOWN", "varchar(32)")
    reason: str = column("forces_reason", "the code in words", "varchar(1000)", cut=True)
    measures: Mapping[str, KineticMeasure]
    reasons: Mapping[str, str]  # of each missing measure
    #: All numbers are per body weight or per kilogram and do not need it.
    mass_kg: float | None = column("forces_mass", "(kg) body mass as it was stated, null: not known")
    #: Over the used cycles.
    residual_bw: float | None = column(
        "forces_residual", "(body weight) root mean square of the force that no foot carries"
    )
    method: str
    params_hash: str
    trials: tuple[TrialKinetics, ...]
    qc: tuple[Check, ...] = ()
