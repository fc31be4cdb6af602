"""`<name>.angles.csv`: the fitted joint angles as a table that any program reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pbl_pipeline.body import angle_of, joint_angles
from pbl_pipeline.csv_cells import frame_to_csv
from pbl_pipeline.errors import PblError

from .results import TrialFit

if TYPE_CHECKING:
    import pandas as pd


def angles_table(fit: TrialFit) -> pd.DataFrame:
    """One row per frame: `time_s`, then one column per joint under its OpenSim name, in the order of `qpos`.

    Angles in degrees, `pelvis_tx/ty/tz` in metres (world frame, origin at the camera). OpenSim's knee is negative in
    flexion; `knee_flexion_r/_l`, positive, stands beside `knee_angle_r/_l`. NaN where the person is out of view, and
    for joints that were not observed (`TrialFit.not_observed`).

    Raises `PblError` FILE_FORMAT when times, joint names and `qpos` do not belong together.
    """
    qpos = np.asarray(fit.qpos, float)
    wanted = (len(fit.time_s), len(fit.joint_names))
    if qpos.shape != wanted:
        raise PblError(
            "FILE_FORMAT",
            found=f"qpos of shape {qpos.shape} for {wanted[0]} frames and {wanted[1]} joint names",
            expected=f"shape {wanted}",
            next_step="fit the trial again; this fit is damaged",
            key=fit.name,
        )
    import pandas as pd  # not at the top: the walk is measured before it is needed

    columns: dict[str, np.ndarray] = {"time_s": np.asarray(fit.time_s, float)}
    angles = joint_angles(fit.joint_names, fit.observed_qpos)
    for joint, values in zip(fit.joint_names, qpos.T, strict=True):
        name, sign = angle_of(joint)
        columns[joint] = sign * angles[name] if name in angles else values
        if name != joint:
            columns[name] = angles[name]
    return pd.DataFrame(columns)


def write_angles_csv(fit: TrialFit, path: str | Path) -> Path:
    """Write `angles_table(fit)` as CSV (UTF-8, comma, point, six decimals, empty cells for NaN); returns the path."""
    path = Path(path)
    # Adding zero turns the -0.0 of a straight knee into 0.0.
    path.write_bytes(frame_to_csv(angles_table(fit) + 0.0, "%.6f").encode())
    return path
