"""One measured case of `research.benchmarks.fit`: python -m research.benchmarks.fit_case JSON

The process of `pbl_pipeline.bench.case`, whose figures of accuracy also hold the paper's objective and, of a held
phone, the camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.bench import case
from pbl_pipeline.bench.data import read_keypoints, read_truth
from pbl_pipeline.fit import SessionFit
from research.paper_objective import paper_objective


def camera_error_deg(quat_wxyz: np.ndarray, R_nc: np.ndarray) -> float:
    """Median over the frames of the angle between fitted (T, 4) and true (T, 3, 3) camera orientation."""
    known = np.all(np.isfinite(quat_wxyz), axis=1)
    if not known.any():
        return float("nan")
    fitted = Rotation.from_quat(quat_wxyz[known], scalar_first=True)
    return float(np.rad2deg(np.median((fitted.inv() * Rotation.from_matrix(R_nc[known])).magnitude())))


def accuracy_of(fits: Mapping[Path, SessionFit]) -> dict[str, Any]:
    """Return the figures of `pbl_pipeline.bench.case.accuracy_of` and, as means over trials, `camera_deg` and the error
    of the clock offset, `clock_ms`; `paper_loss`, the mean of the paper's objective over sessions."""
    out = case.accuracy_of(fits)
    camera, clock = [], []
    for session, fit in fits.items():
        for trial, R_nc, offset in zip(
            fit.trials, read_truth(session, "R_nc"), read_truth(session, "clock_offset_s"), strict=True
        ):
            camera.append(camera_error_deg(trial.phone_quat_wxyz, R_nc))
            clock.append(1e3 * abs(trial.phone_clock_offset_s - float(offset)))
    out["accuracy"] |= {"camera_deg": float(np.mean(camera)), "clock_ms": float(np.mean(clock))}
    return out | {"paper_loss": float(np.mean([paper_objective(f, read_keypoints(s)) for s, f in fits.items()]))}


if __name__ == "__main__":
    case.main(accuracy_of)
