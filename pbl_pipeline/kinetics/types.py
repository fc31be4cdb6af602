"""Names of curves and measures, parameters, and what the stage reads of a trial's gait."""

from __future__ import annotations

import dataclasses
from typing import Protocol

from pbl_pipeline import words
from pbl_pipeline.gait import GaitCycle, GaitEvents

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
