"""A fit against a reference: the errors of every joint they share, over time and over gait cycles, and their nIQR."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from pbl_pipeline.body import PELVIS_TURNS
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import Z90, GaitCycle, trial_poses
from pbl_pipeline.records import column, record
from pbl_pipeline.results import JointError, TrialError

from .align import (
    MAX_GAP_S,
    MIN_COMMON,
    about_vertical,
    align_path,
    at_times,
    best_lag,
    unwrapped,
    vertical_turn,
    wrapped,
)
from .reference import (
    JOINTS_OPENCAP,
    JOINTS_PAPER,
    Reference,
    pelvis_angles_deg,
    pelvis_rotations,
    split_side,
    view_of_fit,
)
from .sources import fit_angles, fit_angles_sd

#: Most values of a Shapiro-Wilk test: beyond 5,000 its p is not accurate.
_MOST_TESTED = 5000


def median_niqr(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Median and nIQR = IQR * 0.7413 of the finite values; quartiles interpolate linearly.

    NaN without a value; the nIQR is NaN with one, because one value has no spread.
    """
    return _median(values), niqr(values)


def niqr(values: Sequence[float] | np.ndarray) -> float:
    """IQR * 0.7413 of the finite values; NaN with fewer than two."""
    from pbl_pipeline.stats import niqr as niqr_of_all  # loads scipy.stats, which every command would wait for

    v = _finite(values)
    return niqr_of_all(v) if v.size >= 2 else float("nan")


def normality_p(values: Sequence[float] | np.ndarray) -> float:
    """p of the Shapiro-Wilk test of the finite values against a normal distribution (scipy).

    Of more than 5,000 values every second, third ... counts. NaN with fewer than three or where all are the same.
    """
    from pbl_pipeline.stats import shapiro_wilk

    v = _finite(values)
    try:
        return shapiro_wilk(v[:: -(-v.size // _MOST_TESTED) or 1]).p
    except PblError:
        return float("nan")


def _finite(values: Sequence[float] | np.ndarray) -> np.ndarray:
    v = np.asarray(values, float)
    return v[np.isfinite(v)]


#: Fields of `KinematicErrors` that stand in the rows of trial and reference, not in that of the errors.
OF_OTHERS = ("residual_2d_px", "residual_3d_cm", "trial", "reference", "source", "convention")


@record(kw_only=True)
class KinematicErrors(TrialError):
    """Errors of one trial against its reference."""

    joints: tuple[JointError, ...]  # one entry per joint that both know, in the order of the reference
    #: Medians of the fit's residuals over frames and markers.
    residual_2d_px: float = column("trial_residual_2d", null=True, default=float("nan"))
    residual_3d_cm: float = column("trial_residual_3d", null=True, default=float("nan"))
    #: Names of fit and reference, and of what kind the reference is.
    trial: str = column("trial_name", type="varchar(255)", default="")
    reference: str = column("reference_name", type="varchar(255)", default="")
    source: str = column("reference_source", type="varchar(64)", default="")
    convention: str = column("reference_convention", type="varchar(64)", default="")

    @property
    def lag_at_limit(self) -> bool:
        """True if the best lag is the largest that was tried: the true one may be larger."""
        return self.max_lag_s > 0 and abs(self.lag_s) >= self.max_lag_s - 1e-9

    def joint(self, name: str) -> JointError:
        """The errors of one joint. Raises `PblError` REFERENCE_INPUT where it was not compared."""
        for error in self.joints:
            if error.joint == name:
                return error
        raise _refused(self.trial, f"no joint {name}", f"one of {', '.join(e.joint for e in self.joints)}")

    def mean_abs_deg(self, joints: Sequence[str] = JOINTS_OPENCAP) -> float:
        """Mean over those of `joints` that were compared of their mean absolute errors; NaN where none was."""
        values = [e.mean_abs_deg for e in self.joints if e.joint in joints and np.isfinite(e.mean_abs_deg)]
        return float(np.mean(values)) if values else float("nan")


def compare(
    fit: TrialFit, reference: Reference, max_lag_s: float = 0.1, *, same_world: bool = False
) -> KinematicErrors:
    """Errors of a fit against a reference, aligned in time and space.

    Time: the reference is interpolated linearly at the video's time stamps, shifted by the lag that minimises the
    offset-free rms over all joints together (`best_lag`). Frames outside the reference, in its holes and outside the
    person's view do not count. Space: unless both live in the `same_world`, the pelvis' orientation is turned about
    the vertical by the one angle that fits the reference best before its angles are compared, and the pelvis' path is
    turned about the vertical and shifted (`align_path`).

    Raises `PblError` REFERENCE_INPUT: no common joint, no common time, fewer than 10 common frames. GAIT_INPUT: a fit
    without frames.
    """
    poses = trial_poses(fit)
    result = compare_angles(
        fit.time_s,
        fit_angles(fit, reference.convention, poses),
        reference,
        sd_deg=fit_angles_sd(fit, reference.convention),
        pelvis_m=poses.position_m[:, poses.index("pelvis")],
        max_lag_s=max_lag_s,
        same_world=same_world,
        trial=fit.name,
    )
    return dataclasses.replace(
        result,
        **{f"view_{side}": view for side, view in view_of_fit(fit, poses).items()},
        residual_2d_px=_median(fit.residual_2d_px),
        residual_3d_cm=100 * _median(fit.residual_3d_m),
    )


def compare_angles(
    time_s: np.ndarray,
    angles_deg: Mapping[str, np.ndarray],
    reference: Reference,
    *,
    sd_deg: Mapping[str, np.ndarray] | None = None,
    pelvis_m: np.ndarray | None = None,
    max_lag_s: float = 0.1,
    same_world: bool = False,
    trial: str = "",
) -> KinematicErrors:
    """The errors of angles (T,) at `time_s` (T,) under the reference's names: what `compare` does without a fit.

    Raises `PblError` REFERENCE_INPUT: no common joint, no common time, fewer than 10 common frames.
    """
    names = [n for n in reference.angles_deg if n in angles_deg]
    if not names:
        raise _refused(trial, "no joint that both know", f"some of {', '.join(angles_deg)} in the reference")
    time_s = np.asarray(time_s, float)
    ours = np.column_stack([np.asarray(angles_deg[n], float) for n in names])
    theirs = unwrapped(np.column_stack([reference.angles_deg[n] for n in names]))
    # Angles of the pelvis depend on the world's heading, so the lag is found by the joints wherever there are any.
    moving = [i for i, n in enumerate(names) if n not in PELVIS_TURNS] or list(range(len(names)))
    _check_overlap(trial, time_s, ours, reference, max_lag_s)
    lag = best_lag(time_s, unwrapped(ours[:, moving]), reference.time_s, theirs[:, moving], max_lag_s)
    if not np.isfinite(lag):
        raise _refused(trial, "too few frames in which both know a joint", f"at least {MIN_COMMON}")
    there = at_times(time_s - lag, reference.time_s, theirs)
    if not same_world and all(n in names for n in PELVIS_TURNS):
        ours = _headed_alike(ours, there, [names.index(n) for n in PELVIS_TURNS])
    difference = wrapped(ours - there)
    known = np.isfinite(difference)
    n = int(np.count_nonzero(known.any(axis=1)))
    if n < MIN_COMMON:
        raise _refused(trial, f"{n} frames in which both know a joint", f"at least {MIN_COMMON}")
    sd = sd_deg or {}
    joints = tuple(
        _joint_error(name, difference[:, i], ours[:, i], there[:, i], sd.get(name)) for i, name in enumerate(names)
    )
    paper = difference[:, [i for i, name in enumerate(names) if name in JOINTS_PAPER]]
    return KinematicErrors(
        trial=trial,
        reference=reference.name,
        source=reference.source,
        convention=reference.convention,
        lag_s=lag,
        max_lag_s=max_lag_s,
        n=n,
        joints=joints,
        median_abs_deg=_median(np.abs(paper)),
        rte_m=_rte(time_s - lag, pelvis_m, reference, same_world),
    )


def _joint_error(
    name: str, difference: np.ndarray, ours: np.ndarray, theirs: np.ndarray, sd: np.ndarray | None
) -> JointError:
    known = np.isfinite(difference)
    n = int(known.sum())
    if n == 0:
        return JointError(name, 0, *[float("nan")] * 7)
    error = difference[known]
    inside = float("nan")
    if sd is not None:
        given = known & np.isfinite(sd)
        if given.any():
            inside = float(np.mean(np.abs(difference[given]) <= Z90 * np.asarray(sd)[given]))
    return JointError(
        joint=name,
        n=n,
        median_abs_deg=float(np.median(np.abs(error))),
        mean_abs_deg=float(np.mean(np.abs(error))),
        bias_deg=float(np.mean(error)),
        sd_deg=float(np.std(error)),
        rms_deg=float(np.sqrt(np.mean(error**2))),
        correlation=_correlation(theirs[known] + error, theirs[known]),
        within_90=inside,
        normal_p=normality_p(error),
    )


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if len(a) < 3 or np.std(a) < 1e-6 or np.std(b) < 1e-6:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def _headed_alike(ours: np.ndarray, theirs: np.ndarray, columns: list[int]) -> np.ndarray:
    """`ours` with the angles of the pelvis after one turn about the vertical towards those of the reference."""
    known = np.all(np.isfinite(ours[:, columns]), axis=1)
    both = known & np.all(np.isfinite(theirs[:, columns]), axis=1)
    if not both.any():
        return ours
    turn = vertical_turn(pelvis_rotations(*ours[both][:, columns].T), pelvis_rotations(*theirs[both][:, columns].T))
    out = ours.copy()
    turned = about_vertical(turn) @ pelvis_rotations(*ours[known][:, columns].T)
    out[np.ix_(known, columns)] = pelvis_angles_deg(turned)
    return out


def _rte(at_s: np.ndarray, pelvis_m: np.ndarray | None, reference: Reference, same_world: bool) -> float:
    if pelvis_m is None or reference.pelvis_m is None:
        return float("nan")
    there = at_times(at_s, reference.time_s, reference.pelvis_m)
    known = np.all(np.isfinite(there), axis=1) & np.all(np.isfinite(pelvis_m), axis=1)
    if np.count_nonzero(known) < MIN_COMMON:
        return float("nan")
    here = pelvis_m[known] if same_world else align_path(pelvis_m[known], there[known])
    return float(np.mean(np.linalg.norm(here - there[known], axis=1)))


def _check_overlap(trial: str, time_s: np.ndarray, ours: np.ndarray, reference: Reference, max_lag_s: float) -> None:
    seen = time_s[np.any(np.isfinite(ours), axis=1)]
    if len(seen) < MIN_COMMON or len(reference.time_s) < 2:
        raise _refused(
            trial,
            f"{len(seen)} frames of the fit and {len(reference.time_s)} of the reference with values",
            f"at least {MIN_COMMON} frames of the fit",
        )
    first, last = reference.time_s[0] - max_lag_s, reference.time_s[-1] + max_lag_s
    if not np.any((seen >= first) & (seen <= last)):
        raise _refused(
            trial,
            f"no common time: the fit has {seen[0]:.2f} to {seen[-1]:.2f} s, the reference "
            f"{reference.time_s[0]:.2f} to {reference.time_s[-1]:.2f} s",
            "recordings of the same movement on one clock, within the largest lag",
        )


def _median(values: Sequence[float] | np.ndarray) -> float:
    v = _finite(values)
    return float(np.median(v)) if v.size else float("nan")


def _refused(key: str, found: str, expected: str) -> PblError:
    return PblError(
        "REFERENCE_INPUT",
        found=found,
        expected=expected,
        next_step="check that both are of one movement; set the reference's time stamps to the video's clock",
        key=key or None,
    )


#: Phases of the curves in percent of the cycle: 101 points, as SPM1D's examples have.
CURVE_PERCENT = np.linspace(0.0, 100.0, 101)
CURVE_COLUMNS = ("trial", "cycle", "side", "joint", "percent", "fit_deg", "reference_deg")


def cycle_curves(
    fit: TrialFit, reference: Reference, cycles: Iterable[GaitCycle], errors: KinematicErrors | None = None
) -> pd.DataFrame:
    """Each joint of fit and reference at 0, 1, ..., 100 % of each gait cycle, in degrees.

    One row per cycle, joint and phase (`CURVE_COLUMNS`). Both are taken at the same times: those of the cycle in the
    video, minus the lag for the reference. A cycle has the joints of its side and those of the middle; `joint` is
    without side. Cubic splines through the samples; a cycle in which fit or reference lacks a joint for longer than
    0.1 s has no pair for that joint. Angles of the pelvis in the world are omitted: the worlds differ.

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
        for values, name in (("fit_deg", "fit"), ("reference_deg", "reference")):
            arrays[f"{joint}_{name}"] = np.array([np.asarray(part[values], float) for _, part in pairs])
        arrays[f"{joint}_cycle"] = np.array(["/".join(str(k) for k in key) for key, _ in pairs], dtype=str)
    np.savez_compressed(path, allow_pickle=False, **arrays)
    return Path(path)


def _curve(time_s: np.ndarray, angle_deg: np.ndarray, at_s: np.ndarray) -> np.ndarray | None:
    """(101,) degrees at `at_s`, or None if samples are missing for longer than `MAX_GAP_S` or at an end."""
    known = np.isfinite(angle_deg)
    time, angle = np.asarray(time_s, float)[known], np.asarray(angle_deg, float)[known]
    first, last = np.searchsorted(time, at_s[0], side="right") - 1, np.searchsorted(time, at_s[-1], side="left")
    if first < 0 or last >= len(time) or np.max(np.diff(time[first : last + 1])) > MAX_GAP_S:
        return None
    part = slice(max(0, first - 3), last + 4)
    return CubicSpline(time[part], unwrapped(angle[part, None])[:, 0])(at_s)
