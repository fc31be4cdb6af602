"""`python -m research.corpus.passes`: mean curves of many passes of known walks, with the detector's errors drawn anew.

What the measurement model of the index is estimated from (`research.corpus.measurement`): each walk is seen at two
visits, in two passes from every view. Nothing random is common to two passes but where the points lie on the person's
body, and the picture's size to those of one visit. A pass is fitted alone and in sessions of several, with one body for
all: the same passes, so that what the common body changes is not mixed with chance.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from multiprocessing.pool import AsyncResult
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import complete_file
from pbl_pipeline.fit import METHODS, SessionInput, TrialFit, default_fit, fit_sessions
from pbl_pipeline.gait import MEASURES, detect_events, feet_from_fit, find_cycles, spatiotemporal
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.synthetic import IMPAIRMENTS
from research.corpus.walks import (
    ANYWHERE,
    CAMERAS,
    LONG_SECONDS,
    SECONDS,
    SEVERITIES,
    THERE_AND_BACK,
    Case,
    Walk,
    detector_model,
    is_held_out,
    recorded_walks,
    synthetic_seeds,
    synthetic_walk,
    there_and_back,
)

#: Walks whose passes are fitted in one call.
GROUP = 32
#: Visits of a walk, and passes in each view at each of them.
VISITS, PASSES = 2, 2
#: Sessions of one visit: how many passes of each view. Of those with one pass of each view there are `PASSES`.
SESSIONS: dict[str, dict[str, int]] = {
    "left": {"sagittal": 1},
    "right": {"sagittal_right": 1},
    "front": {"frontal": 1},
    "back": {"rear": 1},
    "obliquely": {"oblique": 1},
    "from anywhere": {ANYWHERE: 1},
    "there and back": {THERE_AND_BACK: 1},
    "both sides": {"sagittal": 1, "sagittal_right": 1},
    "both sides twice": {"sagittal": 2, "sagittal_right": 2},
    "sides, front, back": {"sagittal": 1, "sagittal_right": 1, "frontal": 1, "rear": 1},
}
#: Angles of the index, in its order.
ANGLES = ("hip_flexion", "hip_adduction", "knee_flexion")
#: Degrees of a stored integer.
STEP_DEG = 0.01


def walks_of(people: int, tuning: int, motions: Path | None, impaired: int | None = None) -> Iterator[tuple]:
    """Arguments of `walk_of`: of `people` synthetic ones, half of them held out, and `tuning` further ones who are not,
    healthy and with each impairment at two severities, or with so many (`impaired`) of these, drawn for each person,
    and of the recorded ones of a folder."""
    seeds = synthetic_seeds(people // 2)
    further = [s for s in synthetic_seeds(people // 2 + tuning) if s not in seeds and not is_held_out(f"synthetic {s}")]
    for seed in seeds + further:
        yield ("synthetic", seed, "", 0.0)
        each = [(name, severity) for name in IMPAIRMENTS for severity in SEVERITIES]
        drawn = np.random.default_rng([seed, 43]).permutation(len(each))
        for i in sorted(drawn[:impaired]):
            yield ("synthetic", seed, *each[i])
    if motions is not None:
        for walk in recorded_walks(motions):
            yield ("recorded", str(motions), walk.person)


def walk_of(which: tuple, seconds: float = SECONDS) -> Walk | None:
    """A walk by the arguments that `walks_of` gives; None for a recorded person without one that is so long."""
    if which[0] == "synthetic":
        return synthetic_walk(*which[1:], seconds=seconds)
    return next((w for w in recorded_walks(which[1], seconds) if w.person == which[2]), None)


class Fitted(NamedTuple):
    """A session: its kind (of `SESSIONS`), which one of its kind at the visit, its passes and what is seen in them."""

    kind: str
    number: int
    cases: Sequence[Case]
    keypoints: Sequence[Keypoints]

    def as_input(self) -> SessionInput:
        names = [f"{c.view} {c.recording}" for c in self.cases]
        return SessionInput(self.keypoints, names, self.cases[0].camera)


def observed(which: tuple, detector: str, kinds: Sequence[str]) -> list[Fitted]:
    """The sessions of a walk at each visit. The camera is held at one visit and stands at the other."""
    walk, longer = walk_of(which), walk_of(which, LONG_SECONDS) if "there and back" in kinds else None
    if walk is None:
        return []
    first = len(walk.person) + int(10 * walk.severity)
    walks = {THERE_AND_BACK: None if longer is None else there_and_back(longer)}
    out = []
    for visit in range(VISITS):
        views = dict.fromkeys(v for kind in kinds for v in SESSIONS[kind] if walks.get(v, walk) is not None)
        cases = {
            v: [
                Case(w, v, CAMERAS[(first + visit) % 2], detector, visit, 1 + i)
                for i in range(PASSES)
                if (w := walks.get(v, walk)) is not None
            ]
            for v in views
        }
        seen = {v: [c.keypoints() for c in cases[v]] for v in views}
        for kind in kinds:
            wanted = SESSIONS[kind]
            if not set(wanted) <= set(views):
                continue
            for number in range(PASSES + 1 - max(wanted.values())):
                own = [(v, number + i) for v, n in wanted.items() for i in range(n)]
                out.append(Fitted(kind, number, [cases[v][i] for v, i in own], [seen[v][i] for v, i in own]))
    return out


def _curves(cycles: Sequence) -> dict[str, np.ndarray]:
    """Curves (N, 3, 51) of the used cycles in order of time, as integers of `STEP_DEG`, their sides, and the leg behind
    the other in each (`GaitCycle.far_leg`)."""
    used = [c for c in cycles if c.used and all(a in c.curves for a in ANGLES)]
    values = np.array([[c.curves[a] for a in ANGLES] for c in used]).reshape(-1, 3, 51)
    sides = np.array([c.side == "right" for c in used], bool)
    far = np.array([c.far_leg for c in used], "<U5")
    return {"curves": np.round(values / STEP_DEG).astype(np.int16), "right": sides, "far_leg": far}


def _measures(cycles: Sequence) -> np.ndarray:
    found = spatiotemporal(cycles).measures
    return np.array([np.nan if (m := found.get(name)) is None else m.mean for name in MEASURES], np.float32)


def rows_of(session: Fitted, trials: Sequence[TrialFit]) -> list[dict[str, Any]]:
    """A row for each pass of a fitted session: curves and measures with detected events, beside the true ones."""
    walk = session.cases[0].walk
    true = find_cycles(walk.events, walk.fit())
    rows = []
    for case, trial in zip(session.cases, trials, strict=True):
        try:
            detected = find_cycles(detect_events(feet_from_fit(trial)).events, trial)
        except PblError:
            detected = []
        row = {"person": walk.person, "held_out": walk.held_out, "source": walk.source, "condition": walk.condition}
        row |= {"severity": walk.severity, "session": session.kind, "number": session.number, "view": case.view}
        row |= {"camera": case.camera, "visit": case.visit, "recording": case.recording}
        row |= {"measures": _measures(detected), "true_measures": _measures(true)}
        for name, found in (("detected", detected), ("true", true)):
            row |= {f"{name}_{k}": v for k, v in _curves(found).items()}
        rows.append(row)
    return rows


def save_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write rows as one compressed file: ragged columns one after another, with their lengths."""
    out: dict[str, np.ndarray] = {}
    for key in rows[0]:
        values = [r[key] for r in rows]
        if np.ndim(values[0]) == 0:
            out[key] = np.array(values)
        elif key.endswith(("_curves", "_right", "_far_leg")):
            out[key] = np.concatenate(values)
            out[f"{key}_n"] = np.array([len(v) for v in values])
        else:
            out[key] = np.stack(values)
    with complete_file(path) as part:
        np.savez_compressed(part, allow_pickle=False, **out)


@click.command(epilog="Example: python -m research.corpus.passes --motions motions --people 12 --out passes")
@click.option("--motions", type=click.Path(path_type=Path), metavar="DIR", help="Recorded motions, with index.csv.")
@click.option("--people", default=12, show_default=True, help="Synthetic people, half of them held out.")
@click.option("--tuning", default=0, show_default=True, help="Further synthetic people who are not held out.")
@click.option("--impaired", type=int, help="Walks of each synthetic person with an impairment (default: all).")
@click.option("--detector", default="blazepose-heavy", show_default=True, metavar="NAME", help="Error model.")
@click.option(
    "--session", "kinds", multiple=True, type=click.Choice(list(SESSIONS)), help="Kind of session (default: all)."
)
@click.option("--processes", default=os.cpu_count(), help="Processes that see the walks and measure the fits.")
@click.option("--seconds", default=1e9, help="Begin no further group of walks after so many seconds.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    metavar="DIR",
    help="Write passes-N.npz there, but for those that are there.",
)
def main(
    motions: Path | None,
    people: int,
    tuning: int,
    impaired: int | None,
    detector: str,
    kinds: Sequence[str],
    processes: int,
    seconds: float,
    out: Path,
) -> None:
    """Fit every session and keep the curves and measures of its passes beside the true ones."""
    begin = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    model = detector_model(detector)
    method = METHODS[default_fit((model.marker_set, model.root_relative))]
    walks = list(walks_of(people, tuning, motions, impaired))
    walks = [walks[i] for i in np.random.default_rng(0).permutation(len(walks))]  # any part of them has all kinds
    os.environ["JAX_PLATFORMS"] = "cpu"  # of the processes, which leave a GPU to this one
    with multiprocessing.get_context("spawn").Pool(processes) as pool:

        def file_of(first: int) -> Path:
            return out / f"passes-{first}.npz"

        def see(first: int) -> AsyncResult[list[list[Fitted]]]:
            some = [(w, detector, kinds or tuple(SESSIONS)) for w in walks[first : first + GROUP]]
            return pool.starmap_async(observed, some, chunksize=1)

        def keep(first: int, measured: AsyncResult[list[list[dict]]]) -> None:
            rows = [row for of_session in measured.get() for row in of_session]
            save_rows(file_of(first), rows)
            click.echo(f"{min(first + GROUP, len(walks))} of {len(walks)} walks: {len(rows)} passes are kept")

        # While a group is fitted, the next one is seen and the one before is measured.
        left = [first for first in range(0, len(walks), GROUP) if not file_of(first).exists()]
        ahead, before = see(left[0] if left else len(walks)), None
        for first, following in zip(left, [*left[1:], len(walks)], strict=True):
            if time.perf_counter() - begin > seconds:
                break
            seen, ahead = [s for found in ahead.get() for s in found], see(following)
            ready = time.perf_counter()
            fits = fit_sessions([s.as_input() for s in seen], method)
            done = [(s, f.trials) for s, f in zip(seen, fits, strict=True) if not isinstance(f, PblError)]
            click.echo(
                f"{len(done)} of {len(seen)} sessions, {method.key}: seen at {ready - begin:.0f} s, "
                f"fitted {time.perf_counter() - ready:.0f} s"
            )
            for s, failed in zip(seen, fits, strict=True):
                if isinstance(failed, PblError):
                    click.echo(f"{s.cases[0].walk.person}, {s.kind} {s.number}: {failed.code}, {failed.found}")
            if before is not None:
                keep(*before)
            before = first, pool.starmap_async(rows_of, done, chunksize=4)
        if before is not None:
            keep(*before)
        pool.terminate()


if __name__ == "__main__":
    main()
