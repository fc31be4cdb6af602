"""One measured case in a process of its own: `python -m pbl_pipeline.bench._case JSON`.

The JSON names the case, the folder of its data, the file for the result, the stage and the time at which the process
was started. Stage "cold" ends after the first result. Stage "warm" goes on: repeated runs, all seeds, accuracy.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError

from . import data
from .machine import machine, peak_rss
from .plan import PARAMSET_OF, Case, Data

if TYPE_CHECKING:
    from pbl_pipeline.fit import Params, SessionFit
    from pbl_pipeline.keypoints import Keypoints
    from pbl_pipeline.methods import Method

Sessions = list["SessionFit | PblError"]


def main() -> None:
    """Entry of the process."""
    spec = json.loads(sys.argv[1])
    case = Case(**{**spec["case"], "data": Data(**spec["case"]["data"])})
    try:
        result = measure(case, Path(spec["folder"]), spec["stage"], spec["started"])
    except PblError as error:
        result = {"error": error.code, "error_text": error.text()}
    except Exception as error:  # noqa: BLE001 - the table shows what went wrong in a case and goes on
        result = {"error": type(error).__name__, "error_text": str(error)}
    Path(spec["result"]).write_text(json.dumps(result | machine()), encoding="utf-8")


def measure(case: Case, folder: Path, stage: str, started: float) -> dict[str, Any]:
    """Figures of one stage; see `docs/benchmarks.md`. `started` is `time.time()` when the process was started."""
    paramset = paramset_of(case.solver, case.adam_steps)
    groups = _groups(case)
    loaded = {i: _data.read(folder, case.data, i) for i in groups[0]}
    run = _runner(case, paramset)
    first = run([loaded[i][0] for i in groups[0]])
    out: dict[str, Any] = {"first_seconds": time.time() - started, "paramset": paramset.name}
    done: dict[int, SessionFit | PblError] = dict(zip(groups[0], first, strict=True))
    if stage == "cold":
        return out | _failures(done) | memory()

    loaded |= {i: _data.read(folder, case.data, i) for g in groups[1:] for i in g}
    seconds = []
    for group in _order(case, groups):
        begin = time.perf_counter()
        fits = run([loaded[i][0] for i in group])
        if group == groups[0] or case.solver == "implicit-adam":  # whose time does not depend on the data
            seconds.append(time.perf_counter() - begin)
        done |= dict(zip(group, fits, strict=True))
    # Before anything else is computed, so that it is the fit's own.
    out |= {"warm_seconds": min(seconds), "warm_seconds_each": seconds} | memory()
    out |= _failures(done) | _accuracy(done, loaded)
    if case.batch > 1:
        out |= _against_one(case, paramset, done, loaded)
    return out


def paramset_of(solver: str, adam_steps: int | None) -> Method[Params]:
    """The method of a solver that is measured. Raises `PblError` SOLVER_UNKNOWN."""
    from pbl_pipeline.fit import METHODS

    base = METHODS.find(PARAMSET_OF[solver])
    params: Any = base.params
    if adam_steps is None or adam_steps == getattr(params, "steps", None):
        return base
    fewer = dataclasses.replace(params, steps=adam_steps)
    return METHODS.make(f"{base.name}, {adam_steps} steps", base.version, fewer)


def memory() -> dict[str, Any]:
    """Peak memory (bytes) of this process so far, and on the device where its backend says (else None)."""
    import jax

    stats = jax.local_devices()[0].memory_stats() or {}
    return {"host_bytes": peak_rss(), "device_bytes": stats.get("peak_bytes_in_use")}


def _groups(case: Case) -> list[list[int]]:
    """Numbers of the sessions that are fitted in one call, one list for each call."""
    if case.batch > 1:
        return [list(range(case.batch))]
    return [[i] for i in range(case.data.n_sessions)]


def _order(case: Case, groups: list[list[int]]) -> list[list[int]]:
    """The calls of the warm stage: the first group `repeat` times for its best time, then the others.

    `implicit-adam` takes as long on any data, so there the others count among the repeats.
    """
    others = groups[1:]
    again = max(case.repeat - len(others), 0) if case.solver == "implicit-adam" else case.repeat
    return [*others, *[groups[0]] * again] if case.solver == "implicit-adam" else [*[groups[0]] * again, *others]


def _runner(case: Case, paramset: Method[Params]) -> Callable[[list[list[Keypoints]]], Sessions]:
    """A function from the trials of some sessions to their fits. An error of one session is its result."""
    from pbl_pipeline import fit

    names = [f"trial{k}" for k in range(case.data.n_trials)]

    def one_by_one(sessions: list[list[Keypoints]]) -> Sessions:
        out: Sessions = []
        for trials in sessions:
            try:
                out.append(fit.fit_session(trials, names, paramset, case.data.motion))
            except PblError as error:
                out.append(error)
        return out

    def together(sessions: list[list[Keypoints]]) -> Sessions:
        inputs = [fit.SessionInput(trials=t, names=names, camera_motion=case.data.motion) for t in sessions]
        return fit.fit_sessions(inputs, paramset)

    return together if case.batch > 1 else one_by_one


def _failures(done: dict[int, SessionFit | PblError]) -> dict[str, Any]:
    errors = [f for f in done.values() if isinstance(f, PblError)]
    if not errors:
        return {}
    what = errors[0].code if len(errors) == len(done) else f"{errors[0].code} in {len(errors)} of {len(done)}"
    return {"error": what, "error_text": errors[0].text()}


def _accuracy(done: dict[int, SessionFit | PblError], loaded: dict[int, Any]) -> dict[str, Any]:
    from pbl_pipeline.fit import paper_objective

    from .accuracy import summary, trial_accuracy

    trials, losses, checks = [], [], {}
    for i, fit in done.items():
        if isinstance(fit, PblError):
            continue
        keypoints, truth = loaded[i]
        trials += [trial_accuracy(t, x) for t, x in zip(fit.trials, truth, strict=True)]
        losses.append(paper_objective(fit, keypoints))
        for check in fit.qc:
            if check.outcome not in ("PASS", "EMPTY"):
                checks[check.check] = check.outcome
    if not trials:
        return {}
    loss = sum(losses) / len(losses)
    return {"accuracy": summary(trials), "n_sessions": len(done), "paper_loss": loss, "checks": checks}


def _against_one(case: Case, paramset: Method[Params], done: dict[int, Any], loaded: dict[int, Any]) -> dict[str, Any]:
    """The largest difference (rad) of the first session of a batch to the same session fitted alone."""
    import numpy as np

    alone = _runner(dataclasses.replace(case, batch=1), paramset)([loaded[0][0]])[0]
    if isinstance(alone, PblError) or isinstance(done[0], PblError):
        return {}
    pairs = zip(alone.trials, done[0].trials, strict=True)
    return {"batch_difference_rad": float(max(np.nanmax(np.abs(a.qpos - b.qpos)[:, 3:]) for a, b in pairs))}


if __name__ == "__main__":
    main()
