"""`python -m research.corpus.passes`: mean curves of many passes of known walks, with the detector's errors drawn anew.

What the measurement model of the index is estimated from (`research.corpus.measurement`): each walk is seen at two
visits, in two passes from every view, each a session. Nothing random is common to two passes but where the points lie
on the person's body, and the picture's size to those of one visit.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, SessionInput, TrialFit, default_fit, fit_sessions
from pbl_pipeline.gait import MEASURES, detect_events, feet_from_fit, find_cycles, spatiotemporal
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.synthetic import IMPAIRMENTS
from research.corpus.walks import (
    CAMERAS,
    SEVERITIES,
    VIEWS,
    Case,
    Walk,
    detector_model,
    is_held_out,
    recorded_walks,
    synthetic_seeds,
    synthetic_walk,
)

#: Walks whose passes are fitted together.
GROUP = 24
#: Visits of a walk, and passes in each view at each of them.
VISITS, PASSES = 2, 2
#: Angles of the index, in its order.
ANGLES = ("hip_flexion", "hip_adduction", "knee_flexion")
#: Degrees of a stored integer.
STEP_DEG = 0.01


def walks_of(people: int, tuning: int, motions: Path | None) -> Iterator[tuple]:
    """Arguments of `walk_of`: of `people` synthetic ones, half of them held out, and `tuning` further ones who are not,
    healthy and with each impairment at two severities, and of the recorded ones of a folder."""
    seeds = synthetic_seeds(people // 2)
    further = [s for s in synthetic_seeds(people // 2 + tuning) if s not in seeds and not is_held_out(f"synthetic {s}")]
    for seed in seeds + further:
        yield ("synthetic", seed, "", 0.0)
        for name in IMPAIRMENTS:
            for severity in SEVERITIES:
                yield ("synthetic", seed, name, severity)
    if motions is not None:
        for i in range(len(recorded_walks(motions))):
            yield ("recorded", str(motions), i)


def walk_of(which: tuple) -> Walk:
    """A walk by the arguments that `walks_of` gives."""
    if which[0] == "synthetic":
        return synthetic_walk(*which[1:])
    return recorded_walks(which[1])[which[2]]


def cases_of(walk: Walk, detector: str, views: Iterable[str]) -> list[Case]:
    """Each pass of a walk. The camera is held at one visit and stands at the other."""
    first = len(walk.person) + int(10 * walk.severity)
    return [
        Case(walk, view, CAMERAS[(first + visit) % 2], detector, visit, 1 + number)
        for visit in range(VISITS)
        for view in views
        for number in range(PASSES)
    ]


def observed(which: tuple, detector: str, views: Sequence[str]) -> list[tuple[Case, Keypoints]]:
    """Each pass of a walk and what the detector sees of it."""
    return [(c, c.keypoints()) for c in cases_of(walk_of(which), detector, views)]


def _curves(cycles: Sequence) -> dict[str, np.ndarray]:
    """Curves (N, 3, 51) of the used cycles as integers of `STEP_DEG`, their sides, and the mean sd of each side."""
    used = [c for c in cycles if c.used and all(a in c.curves for a in ANGLES)]
    values = np.array([[c.curves[a] for a in ANGLES] for c in used]).reshape(-1, 3, 51)
    sides = np.array([c.side == "right" for c in used], bool)
    spread = np.full((2, 3, 51), np.nan)
    if used and all(a in c.curves_sd for c in used for a in ANGLES):
        sd = np.array([[c.curves_sd[a] for a in ANGLES] for c in used])
        for k in (0, 1):
            if (sides == k).any():
                spread[k] = sd[sides == k].mean(axis=0)
    return {"curves": np.round(values / STEP_DEG).astype(np.int16), "right": sides, "sd": spread.astype(np.float32)}


def _measures(cycles: Sequence) -> np.ndarray:
    found = spatiotemporal(cycles).measures
    return np.array([np.nan if (m := found.get(name)) is None else m.mean for name in MEASURES], np.float32)


def row_of(case: Case, trial: TrialFit) -> dict[str, Any]:
    """Curves and measures of a fitted pass, with the true and with detected events, beside the true ones."""
    walk = case.walk
    try:
        detected = find_cycles(detect_events(feet_from_fit(trial)).events, trial)
    except PblError:
        detected = []
    cycles = {
        "known": find_cycles(walk.events, trial),
        "detected": detected,
        "true": find_cycles(walk.events, walk.fit()),
    }
    row = {"person": walk.person, "held_out": walk.held_out, "source": walk.source, "condition": walk.condition}
    row |= {"severity": walk.severity, "view": case.view, "camera": case.camera, "visit": case.visit}
    row |= {"recording": case.recording, "measures": _measures(detected), "true_measures": _measures(cycles["true"])}
    return row | {f"{name}_{k}": v for name, found in cycles.items() for k, v in _curves(found).items()}


def save_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write rows as one compressed file: ragged columns one after another, with their lengths."""
    out: dict[str, np.ndarray] = {}
    for key in rows[0]:
        values = [r[key] for r in rows]
        if np.ndim(values[0]) == 0:
            out[key] = np.array(values)
        elif key.endswith(("_curves", "_right")):
            out[key] = np.concatenate(values)
            out[f"{key}_n"] = np.array([len(v) for v in values])
        else:
            out[key] = np.stack(values)
    np.savez_compressed(path, allow_pickle=False, **out)


@click.command(epilog="Example: python -m research.corpus.passes --motions motions --people 12 --out passes")
@click.option("--motions", type=click.Path(path_type=Path), metavar="DIR", help="Recorded motions, with index.csv.")
@click.option("--people", default=12, show_default=True, help="Synthetic people, half of them held out.")
@click.option("--tuning", default=0, show_default=True, help="Further synthetic people who are not held out.")
@click.option("--detector", default="blazepose-heavy", show_default=True, metavar="NAME", help="Error model.")
@click.option("--views", default=",".join(VIEWS), metavar="VIEW,...", help="Which of them (default: all).")
@click.option("--processes", default=os.cpu_count(), help="Processes that see the walks and measure the fits.")
@click.option("--seconds", default=1e9, help="Begin no further group of walks after so many seconds.")
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Write passes-N.npz there.")
def main(
    motions: Path | None, people: int, tuning: int, detector: str, views: str, processes: int, seconds: float, out: Path
) -> None:
    """Fit every pass as a session and keep its curves and measures beside the true ones."""
    begin = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    model = detector_model(detector)
    method = METHODS[default_fit((model.marker_set, model.root_relative))]
    walks = list(walks_of(people, tuning, motions))
    walks = [walks[i] for i in np.random.default_rng(0).permutation(len(walks))]  # any part of them has all kinds
    os.environ["JAX_PLATFORMS"] = "cpu"  # of the processes, which leave a GPU to this one
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        jobs = [pool.apply_async(observed, (w, detector, views.split(","))) for w in walks]
        for number, first in enumerate(range(0, len(jobs), GROUP)):
            if time.perf_counter() - begin > seconds:
                break
            seen = [found for job in jobs[first : first + GROUP] for found in job.get()]
            ready = time.perf_counter()
            fits = fit_sessions([SessionInput([k], ["pass"], c.camera) for c, k in seen], method)
            fitted = time.perf_counter()
            done = [(c, f.trials[0]) for (c, _), f in zip(seen, fits, strict=True) if not isinstance(f, PblError)]
            rows = pool.starmap(row_of, done, chunksize=4)
            save_rows(out / f"passes-{number}.npz", rows)
            click.echo(
                f"{min(first + GROUP, len(walks))} of {len(walks)} walks, {len(rows)} passes of {len(seen)}, "
                f"{method.key}: seen at {ready - begin:.0f} s, fitted {fitted - ready:.0f} s, "
                f"measured {time.perf_counter() - fitted:.0f} s"
            )
        pool.terminate()


if __name__ == "__main__":
    main()
