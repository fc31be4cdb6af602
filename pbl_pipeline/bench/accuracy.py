"""How far a fit is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.body import joint_of
from pbl_pipeline.validation import JOINTS_PAPER

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: The joints of the paper's validation (Statistics): hips, knees, ankles, lumbar, neck, shoulders without rotation,
#: elbows.
PAPER_JOINTS = tuple(joint_of(angle)[0] for angle in JOINTS_PAPER)
MAIN_JOINTS = tuple(j for j in PAPER_JOINTS if j.startswith(("hip_", "knee_", "ankle_", "lumbar_")))


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
    return float(np.mean([errors[n] for n in joints]))


def trial_accuracy(fit: TrialFit, true_rad: np.ndarray) -> dict[str, Any]:
    """Return the figures of one trial against its true joint values (T, 40): `joints_deg` by name, `all_deg`,
    `main_deg`, and the fraction of the frames without a result, `unknown_share`."""
    joints = joint_errors_deg(fit.qpos, true_rad, fit.joint_names)
    return {
        "joints_deg": joints,
        "all_deg": mean_over(joints, PAPER_JOINTS),
        "main_deg": mean_over(joints, MAIN_JOINTS),
        "unknown_share": float(np.mean(~np.all(np.isfinite(fit.qpos), axis=1))),
    }


def summary(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the mean over trials of `trial_accuracy`; what is NaN in a trial is left out of the mean."""
    out: dict[str, Any] = {k: _mean([t[k] for t in trials]) for k in trials[0] if k != "joints_deg"}
    out["joints_deg"] = {n: _mean([t["joints_deg"][n] for t in trials]) for n in trials[0]["joints_deg"]}
    return out


def _mean(values: Sequence[float]) -> float:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.mean(finite)) if finite else float("nan")
