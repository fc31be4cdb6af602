"""How far a fit is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .data import Truth
from .plan import AFFECTED_JOINT, UNSEEN_S

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

_SIDES = ("r", "l")
MAIN_JOINTS: tuple[str, ...] = (
    *(f"hip_{n}_{s}" for n in ("flexion", "adduction", "rotation") for s in _SIDES),
    *(f"{n}_angle_{s}" for n in ("knee", "ankle") for s in _SIDES),
    *(f"lumbar_{n}" for n in ("extension", "bending", "rotation")),
)
#: The joints of the paper's validation (Statistics): those above, neck, shoulders without rotation, elbows.
PAPER_JOINTS: tuple[str, ...] = (
    *MAIN_JOINTS,
    *(f"neck_{n}" for n in ("extension", "bending", "rotation")),
    *(f"arm_{n}_{s}" for n in ("flex", "add") for s in _SIDES),
    *(f"elbow_flex_{s}" for s in _SIDES),
)


def joint_errors_deg(
    fitted_rad: np.ndarray, true_rad: np.ndarray, joint_names: Sequence[str], wanted: Sequence[str] = PAPER_JOINTS
) -> dict[str, float]:
    """Median absolute error (deg) over the frames of one trial of each joint; frames without a result do not count.

    fitted_rad, true_rad : (T, 40) in the order of `joint_names`. NaN where no frame has a result.
    """
    known = np.all(np.isfinite(fitted_rad), axis=1)
    if not known.any():
        return dict.fromkeys(wanted, float("nan"))
    names = list(joint_names)
    error = np.rad2deg(np.abs(fitted_rad[known] - true_rad[known]))
    return {n: float(np.median(error[:, names.index(n)])) for n in wanted}


def mean_over(errors: dict[str, float], joints: Sequence[str]) -> float:
    """Mean over `joints`."""
    return float(np.mean([errors[n] for n in joints]))


def camera_error_deg(quat_wxyz: np.ndarray, R_nc: np.ndarray) -> float:
    """Median over the frames of the angle between fitted (T, 4) and true (T, 3, 3) camera orientation."""
    from scipy.spatial.transform import Rotation

    known = np.all(np.isfinite(quat_wxyz), axis=1)
    if not known.any():
        return float("nan")
    fitted = Rotation.from_quat(quat_wxyz[known], scalar_first=True)
    return float(np.rad2deg(np.median((fitted.inv() * Rotation.from_matrix(R_nc[known])).magnitude())))


def trial_accuracy(fit: TrialFit, truth: Truth) -> dict[str, Any]:
    """Figures of one trial: `joints_deg` by name, `all_deg`, `main_deg`, `camera_deg`, `clock_ms`, and what is known
    of uncertainty (`sd_*_deg`, `unknown_share`, `unknown_share_span`). NaN where there is nothing to say."""
    joints = joint_errors_deg(fit.qpos, truth.qpos, fit.joint_names)
    sd = np.rad2deg(fit.qpos_sd[:, [fit.joint_names.index(n) for n in PAPER_JOINTS]])
    hidden = ~np.all(np.isfinite(fit.qpos), axis=1)
    span = (fit.time_s >= UNSEEN_S[0]) & (fit.time_s < UNSEEN_S[1])
    return {
        "joints_deg": joints,
        "all_deg": mean_over(joints, PAPER_JOINTS),
        "main_deg": mean_over(joints, MAIN_JOINTS),
        "camera_deg": camera_error_deg(fit.phone_quat_wxyz, truth.R_nc),
        "clock_ms": 1e3 * abs(fit.phone_clock_offset_s - truth.clock_offset_s),
        "sd_all_deg": _median(sd),
        "sd_span_deg": _median(sd[span]),
        "sd_outside_deg": _median(sd[~span]),
        "sd_affected_deg": _median(np.rad2deg(fit.qpos_sd[:, fit.joint_names.index(AFFECTED_JOINT)])),
        "unknown_share": float(hidden.mean()),
        "unknown_share_span": float(hidden[span].mean()) if span.any() else float("nan"),
    }


def summary(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The mean over trials of what `trial_accuracy` gives; what is NaN in a trial is left out of the mean."""
    out: dict[str, Any] = {k: _mean([t[k] for t in trials]) for k in trials[0] if k != "joints_deg"}
    out["joints_deg"] = {n: _mean([t["joints_deg"][n] for t in trials]) for n in trials[0]["joints_deg"]}
    return out


def _mean(values: Sequence[float]) -> float:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.mean(finite)) if finite else float("nan")


def _median(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
