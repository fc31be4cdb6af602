"""One measured case in a separate process: `python -m pbl_pipeline.bench.case JSON`.

The JSON names the case, the folder of its data, the file for the result, the stage and the time at which the process
was started. Stage "cold" ends after the first result. Stage "warm" goes on: repeated runs, all sessions, accuracy.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.body import joint_of
from pbl_pipeline.errors import PblError
from pbl_pipeline.validation import JOINTS_PAPER

from .data import read_keypoints, read_truth, sessions
from .machine import peak_rss, write_result

if TYPE_CHECKING:
    from pbl_pipeline.fit import Params, SessionFit, TrialFit
    from pbl_pipeline.keypoints import Keypoints
    from pbl_pipeline.methods import Method

#: Joints of the paper's validation (Statistics): hips, knees, ankles, lumbar, neck, shoulders without rotation, elbows.
PAPER_JOINTS = tuple(joint_of(angle)[0] for angle in JOINTS_PAPER)
MAIN_JOINTS = tuple(j for j in PAPER_JOINTS if j.startswith(("hip_", "knee_", "ankle_", "lumbar_")))


def joint_errors_deg(fitted_rad: np.ndarray, true_rad: np.ndarray, joint_names: Sequence[str]) -> dict[str, float]:
    """Median absolute error (deg) of each of `PAPER_JOINTS` over the frames of one trial that have a result.

    fitted_rad, true_rad : (T, 40) in the order of `joint_names`. NaN if no frame has a result.
    """
    known = np.all(np.isfinite(fitted_rad), axis=1)
    if not known.any():
        return dict.fromkeys(PAPER_JOINTS, float("nan"))
    names = list(joint_names)
    error = np.rad2deg(np.abs(fitted_rad[known] - true_rad[known]))
    return {n: float(np.median(error[:, names.index(n)])) for n in PAPER_JOINTS}


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


#: From the folder of each session that was fitted and its fit to the figures of their accuracy.
Judge = Callable[[Mapping[Path, "SessionFit"]], dict[str, Any]]


def main(judge: Judge | None = None) -> None:
    """Measure the case of the command line and write its result; `judge` instead of `accuracy_of`."""
    spec = json.loads(sys.argv[1])
    case = {k: spec["case"][k] for k in ("method", "batch", "repeat", "camera_motion")}
    folder, judge = Path(spec["folder"]), judge or accuracy_of
    write_result(spec["result"], lambda: measure(folder, spec["stage"], spec["started"], **case, judge=judge))


def measure(
    folder: Path,
    stage: str,
    started: float,
    *,
    method: str,
    batch: int,
    repeat: int,
    camera_motion: str,
    judge: Judge,
) -> dict[str, Any]:
    """Return the figures of one stage (docs/benchmarks.md). `started`: `time.time()` when the process was started."""
    from pbl_pipeline.fit import METHODS
    from pbl_pipeline.method_file import named_or_file

    chosen = named_or_file(METHODS, method)
    known = sessions(folder)
    groups = [known] if batch > 1 else [[session] for session in known]
    trials = {session: read_keypoints(session) for session in groups[0]}
    fits = _fitted(trials, chosen, camera_motion)
    out: dict[str, Any] = {"first_seconds": time.time() - started, "paramset": chosen.name}
    if stage == "cold":
        return out | _failures(fits) | memory()

    seconds = []
    for _ in range(repeat):
        begin = time.perf_counter()
        fits = _fitted(trials, chosen, camera_motion)
        seconds.append(time.perf_counter() - begin)
    for group in groups[1:]:
        fits |= _fitted({session: read_keypoints(session) for session in group}, chosen, camera_motion)
    # Before anything else is computed, so that it is that of the fit.
    out |= {"warm_seconds": min(seconds), "warm_seconds_each": seconds, "n_sessions": len(fits)} | memory()
    good = {session: fit for session, fit in fits.items() if not isinstance(fit, PblError)}
    out |= _failures(fits) | (judge(good) if good else {})
    out["checks"] = {c.check: c.outcome for f in good.values() for c in f.qc if c.outcome not in ("PASS", "EMPTY")}
    if batch > 1:
        out |= _against_one(known[0], fits[known[0]], trials, chosen, camera_motion)
    return out


def memory() -> dict[str, Any]:
    """Return the peak memory (bytes) of this process so far, and on the device where its backend reports it."""
    import jax

    stats = jax.local_devices()[0].memory_stats() or {}
    return {"host_bytes": peak_rss(), "device_bytes": stats.get("peak_bytes_in_use")}


def accuracy_of(fits: Mapping[Path, SessionFit]) -> dict[str, Any]:
    """Return the mean over all trials of `trial_accuracy` as `accuracy`."""
    pairs = [p for session, fit in fits.items() for p in zip(fit.trials, read_truth(session), strict=True)]
    return {"accuracy": summary([trial_accuracy(trial, truth) for trial, truth in pairs])}


def _fitted(
    trials: Mapping[Path, Sequence[Keypoints]], method: Method[Params], camera_motion: str
) -> dict[Path, SessionFit | PblError]:
    """Fit some sessions, several together; an error of one session is its result."""
    from pbl_pipeline import fit

    names = {session: [f"trial{k}" for k in range(len(of))] for session, of in trials.items()}
    if len(trials) > 1:
        inputs = [fit.SessionInput(trials=t, names=names[s], camera_motion=camera_motion) for s, t in trials.items()]
        return dict(zip(trials, fit.fit_sessions(inputs, method), strict=True))
    ((session, of),) = trials.items()
    try:
        return {session: fit.fit_session(of, names[session], method, camera_motion)}
    except PblError as error:
        return {session: error}


def _failures(fits: Mapping[Path, SessionFit | PblError]) -> dict[str, Any]:
    errors = [f for f in fits.values() if isinstance(f, PblError)]
    if not errors:
        return {}
    what = errors[0].code if len(errors) == len(fits) else f"{errors[0].code} in {len(errors)} of {len(fits)}"
    return {"error": what, "error_text": errors[0].text()}


def _against_one(session: Path, together: SessionFit | PblError, trials: Any, *how: Any) -> dict[str, Any]:
    """Largest difference (rad) between a session fitted in a batch and the same session fitted alone."""
    alone = _fitted({session: trials[session]}, *how)[session]
    if isinstance(alone, PblError) or isinstance(together, PblError):
        return {}
    pairs = zip(alone.trials, together.trials, strict=True)
    return {"batch_difference_rad": float(max(np.nanmax(np.abs(a.qpos - b.qpos)[:, 3:]) for a, b in pairs))}


if __name__ == "__main__":
    main()
