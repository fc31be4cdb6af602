"""Joint angles of fit and reference over the same gait cycles, in pairs, ready for a paired SPM{t} test."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from pbl_pipeline.body import PELVIS_TURNS
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitCycle

from .align import MAX_GAP_S, unwrapped
from .compare import KinematicErrors, compare
from .reference import Reference, split_side
from .sources import fit_angles

#: Phases of the curves in percent of the cycle: 101 points, as SPM1D's examples have.
CURVE_PERCENT = np.linspace(0.0, 100.0, 101)
CURVE_COLUMNS = ("trial", "cycle", "side", "joint", "percent", "fit_deg", "reference_deg")


def cycle_curves(
    fit: TrialFit, reference: Reference, cycles: Iterable[GaitCycle], errors: KinematicErrors | None = None
) -> pd.DataFrame:
    """Each joint of fit and reference at 0, 1, ..., 100 % of each gait cycle, side by side, in degrees.

    One row per cycle, joint and phase (`CURVE_COLUMNS`). Both are read at the same moments: those of the cycle in the
    video, less the lag for the reference. A cycle holds the joints of its own side and those of the middle; `joint` is
    without side. Cubic splines through the samples; a cycle in which fit or reference lacks a joint for longer than
    0.1 s has no pair for that joint. Angles of the pelvis against the world are left out: the worlds differ.

    Raises `PblError` REFERENCE_INPUT, GAIT_INPUT as `compare`.

    Parameters
    ----------
    cycles
        Of `pbl_pipeline.gait.find_cycles`; only those with `used`.
    errors
        Of `compare(fit, reference)`, for its lag; computed where absent.
    """
    lag = (errors or compare(fit, reference)).lag_s
    ours = fit_angles(fit, reference.convention)
    parts = []
    for cycle in (c for c in cycles if c.used):
        at = cycle.start_s + CURVE_PERCENT / 100.0 * (cycle.end_s - cycle.start_s)
        for name, theirs in reference.angles_deg.items():
            joint, side = split_side(name)
            if name not in ours or name in PELVIS_TURNS or side not in ("", cycle.side[0]):
                continue
            here = _curve(fit.time_s, ours[name], at)
            there = _curve(reference.time_s, theirs, at - lag)
            if here is None or there is None:
                continue
            here = here - 360.0 * np.round(np.mean(here - there) / 360.0)
            values = (fit.name, cycle.number, cycle.side, joint, CURVE_PERCENT, here, there)
            parts.append(pd.DataFrame(dict(zip(CURVE_COLUMNS, values, strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def save_curves(frame: pd.DataFrame, path: str | Path) -> Path:
    """Write the pairs of one or several trials as .npz: `percent` (101,) and for each joint `<joint>_fit` and
    `<joint>_reference` (N, 101) in degrees, row n of both from the same cycle, named in `<joint>_cycle` (N,).

    With the package spm1d (which this project does not depend on) the paired test of a joint is
    `spm1d.stats.ttest_paired(data["knee_flexion_fit"], data["knee_flexion_reference"]).inference(0.05)`.
    """
    arrays: dict[str, np.ndarray] = {"percent": CURVE_PERCENT}
    for joint in dict.fromkeys(frame["joint"]):
        of_joint = frame.loc[np.asarray(frame["joint"] == joint), :]
        pairs = list(of_joint.groupby(["trial", "cycle", "side"], sort=False))
        for column, name in (("fit_deg", "fit"), ("reference_deg", "reference")):
            arrays[f"{joint}_{name}"] = np.array([np.asarray(part[column], float) for _, part in pairs])
        arrays[f"{joint}_cycle"] = np.array(["/".join(str(k) for k in key) for key, _ in pairs], dtype=str)
    np.savez_compressed(path, allow_pickle=False, **arrays)
    return Path(path)


def _curve(time_s: np.ndarray, angle_deg: np.ndarray, at_s: np.ndarray) -> np.ndarray | None:
    """(101,) degrees at `at_s`, or None where samples are missing for longer than `MAX_GAP_S` or at an end."""
    known = np.isfinite(angle_deg)
    time, angle = np.asarray(time_s, float)[known], np.asarray(angle_deg, float)[known]
    first, last = np.searchsorted(time, at_s[0], side="right") - 1, np.searchsorted(time, at_s[-1], side="left")
    if first < 0 or last >= len(time) or np.max(np.diff(time[first : last + 1])) > MAX_GAP_S:
        return None
    part = slice(max(0, first - 3), last + 4)
    return CubicSpline(time[part], unwrapped(angle[part, None])[:, 0])(at_s)
