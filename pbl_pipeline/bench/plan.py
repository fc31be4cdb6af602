"""Which cases a benchmark of the fit runs. Imports nothing heavy: the parent process stays small and off the GPU."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence

SOLVERS = ("gauss-newton", "implicit-adam")
#: The paramset that stands for a solver.
PARAMSET_OF = {"gauss-newton": "gauss-newton", "implicit-adam": "paper-2025"}
MOTIONS = ("static", "handheld")
MARKER_SET = "bml_movi_87"
FPS = 30.0

#: What `--robust` does to the data: fraction of outliers, a marker that is never seen, a time with nothing seen.
TROUBLES = ("none", "outliers", "marker", "span", "all")
OUTLIER_SHARE, NEVER_SEEN, UNSEEN_S = 0.30, "LBigToe", (4.5, 5.5)
#: The joint that mostly hangs on `NEVER_SEEN`.
AFFECTED_JOINT = "mtp_angle_l"


@dataclasses.dataclass(frozen=True)
class Data:
    """What is observed: `n_sessions` people, each with `n_trials` walks of `n_frames` frames at 30 Hz, in an upright
    picture with a shorter side of `short_side_px`."""

    n_trials: int = 1
    motion: str = "static"
    n_frames: int = 300
    trouble: str = "none"
    n_sessions: int = 3
    short_side_px: int = 1080

    @property
    def key(self) -> str:
        """A name for the folder of these data."""
        return hashlib.sha256(json.dumps(dataclasses.asdict(self), sort_keys=True).encode()).hexdigest()[:12]


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: a solver on some data.

    batch: sessions fitted at once, 1: one by one; repeat: warm runs; adam_steps: in place of the paramset's, or None.
    """

    section: str
    solver: str
    data: Data
    batch: int = 1
    repeat: int = 3
    adam_steps: int | None = None


def speed_cases(
    solvers: Sequence[str],
    trials: Sequence[int],
    motions: Sequence[str],
    batches: Sequence[int],
    n_seeds: int,
    repeat: int,
    adam_steps: int | None,
) -> list[Case]:
    """Solver x trials x camera x batch; batches of more than one only where a solver has them."""
    cases = []
    for solver in solvers:
        for n in trials:
            for motion in motions:
                for batch in batches:
                    if batch > 1 and solver == "implicit-adam":
                        continue
                    sessions = batch if batch > 1 else n_seeds
                    data = Data(n_trials=n, motion=motion, n_sessions=sessions)
                    cases.append(Case("speed", solver, data, batch, repeat, _steps(solver, adam_steps)))
    return cases


def long_cases(solvers: Sequence[str], motions: Sequence[str], repeat: int, adam_steps: int | None) -> list[Case]:
    """Six minutes of walking and half of it, one trial of one person."""
    return [
        Case("long", s, Data(motion=m, n_frames=n, n_sessions=1), 1, repeat, _steps(s, adam_steps))
        for s in solvers
        for m in motions
        for n in (5_400, 10_800)
    ]


def robust_cases(
    solvers: Sequence[str], motions: Sequence[str], n_seeds: int, repeat: int, adam_steps: int | None
) -> list[Case]:
    """The benchmark's trial with each trouble alone and with all of them."""
    return [
        Case("robust", s, Data(motion=m, trouble=t, n_sessions=n_seeds), 1, repeat, _steps(s, adam_steps))
        for s in solvers
        for m in motions
        for t in TROUBLES
    ]


def quick_cases(solvers: Sequence[str], adam_steps: int) -> list[Case]:
    """A minute on two cores: one trial each, the paper's solver for few steps and with a camera that stands only."""
    cases = []
    for solver in solvers:
        for motion in MOTIONS if solver != "implicit-adam" else MOTIONS[:1]:
            data = Data(motion=motion, n_sessions=1)
            cases.append(Case("speed", solver, data, 1, 1, _steps(solver, adam_steps)))
    return cases


def _steps(solver: str, adam_steps: int | None) -> int | None:
    return adam_steps if solver == "implicit-adam" else None
