"""Parameters of the session fit and the named paramsets."""

from __future__ import annotations

import dataclasses

from pbl_pipeline.paramset import Paramset


@dataclasses.dataclass(frozen=True)
class CostParams:
    """Weights and Huber widths of the cost terms (defaults: the paper, section Model Fitting)."""

    weight_3d: float = 1.0
    weight_2d: float = 0.1
    weight_offset_per_m2: float = 100.0
    huber_3d_cm: float = 10.0
    huber_2d_px: float = 5.0


@dataclasses.dataclass(frozen=True)
class ViewParams:
    """Which frames count: whole person in view, shorter gaps of partial view bridged (paper, Keypoint Detection)."""

    #: Mean over the markers of a frame.
    min_confidence: float = 0.5
    max_gap_s: float = 1.0
    min_in_view_s: float = 1.0


@dataclasses.dataclass(frozen=True)
class ImplicitAdamParams:
    """Solver `implicit-adam`: one network per trial, one body per session, Adam (defaults: the paper)."""

    steps: int = 25_000
    samples_per_trial: int = 300
    learning_rate_start: float = 1e-3
    learning_rate_end: float = 1e-6
    adam_b1: float = 0.8
    weight_decay: float = 1e-5
    clip_norm: float = 0.1
    hidden: tuple[int, ...] = (256, 256, 256, 256)
    n_skip: int = 2
    max_frequency_rad_s: float = 80.0
    pairs_per_octave: int = 2
    #: "paper": pelvis `start_distance_m` ahead of the camera, every angle at the middle of its range.
    #: "keypoints": pelvis position and heading from the keypoints, every other angle at the standing pose.
    start: str = "paper"
    start_distance_m: float = 1.5
    seed: int = 0
    cost: CostParams = CostParams()
    view: ViewParams = ViewParams()


PAPER_2025 = ImplicitAdamParams()
#: For BlazePose on two CPU cores: fewer steps from a start near the answer. The detector's depth is much less certain
#: than its pixels, so its 3D counts less than MeTRAbs's in the paper (shared notes: full weight 13 deg, 0.1-0.3 8-9 deg
#: mean joint error on a phone clip with mocap).
DEMO = ImplicitAdamParams(
    steps=4_000,
    samples_per_trial=160,
    start="keypoints",
    cost=CostParams(weight_3d=0.2),
)

PARAMSETS: dict[str, Paramset] = {
    "paper-2025": Paramset.of("fit", "paper-2025", 1, PAPER_2025),
    "blazepose-quick": Paramset.of("fit", "blazepose-quick", 1, DEMO),
}
DEFAULT = "blazepose-quick"


def params_of(paramset: Paramset) -> ImplicitAdamParams:
    """The parameter object of a stored paramset (the inverse of `Paramset.of`)."""
    values = dict(paramset.params)
    return ImplicitAdamParams(
        **{
            **values,
            "hidden": tuple(values["hidden"]),
            "cost": CostParams(**values["cost"]),
            "view": ViewParams(**values["view"]),
        }
    )
