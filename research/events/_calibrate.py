"""Calibration of the events' probability, and what the filter's parameters are worth, on sequences held out.

Each sequence is augmented as in training (`seen_joints`) and then goes the way of any recording: grid, network,
walking, filter, events. An event that lies within `NEAR_S` of a true one of its kind is real. The curve is fitted to
one half of the sequences and measured on the other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from pbl_pipeline.gait.events import PHASE_ORDER, PhaseParams, candidates
from pbl_pipeline.gait.events.network.predict import Grid, Phases, on_grid, predict

from ._augment import _MIRRORED, seen_joints
from ._corpus import HELD_OUT_EVERY, UNIT_M, Corpus
from ._sequence import GRID_HZ

#: An event is real where a true one of its kind is this near (s).
NEAR_S = 0.1
#: Sequences are cut to a multiple of so many frames.
_STEP = 150
_UP = np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One sequence as the network sees it, and the truth: times (s) of the four events in `PHASE_ORDER`."""

    grid: Grid
    phases: Phases
    true_s: tuple[np.ndarray, ...]
    kind: str


def cases(corpus: Corpus, numbers: np.ndarray, p: PhaseParams, seed: int) -> Iterator[Case]:
    """Sequences `numbers` of the corpus, augmented by `seed`, with the network's phases as the method takes them. Those
    in which hips and feet are hardly seen are left out, as detection refuses them."""
    see = jax.jit(seen_joints)
    for number in numbers:
        # Few different lengths: each is compiled.
        length = int(corpus.length[number]) // _STEP * _STEP
        cut = slice(int(corpus.start[number]), int(corpus.start[number]) + length)
        key = jax.random.fold_in(jax.random.key(seed), int(number))
        joints, known, mirror = (np.asarray(x) for x in see(key, jnp.asarray(UNIT_M * corpus.points[cut])))
        phase = corpus.phase[cut][:, _MIRRORED] if mirror else corpus.phase[cut]
        time = np.arange(len(phase)) / GRID_HZ
        grid = on_grid(time, np.where(known[..., None], joints, np.nan), _UP)
        if not np.isfinite(grid.leg_m) or np.count_nonzero(grid.known[:, 0].all(axis=1)) < GRID_HZ:
            continue
        seen: np.ndarray = np.logical_and.reduce(grid.known[:, 0], axis=1)
        true = tuple(_wraps(phase[:, k], time) for k in range(4))
        near = tuple(t[seen[np.clip(np.round(t * GRID_HZ).astype(int), 0, len(seen) - 1)]] for t in true)
        yield Case(grid, predict(grid, p.model, p.mirrored), near, str(corpus.kind[number]))


def held_out(corpus: Corpus) -> np.ndarray:
    """Numbers of the sequences that training leaves out."""
    return np.arange(0, len(corpus.start), HELD_OUT_EVERY)


def _wraps(phase: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Times at which a phase (T,) in turns is whole; just before its first and after its last frame as well."""
    out = []
    known = np.flatnonzero(np.isfinite(phase))
    for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        if len(run) < 2:
            continue
        p, t = phase[run].astype(float), time[run]
        first, last = p[0] - (p[1] - p[0]), p[-1] + (p[-1] - p[-2])
        whole = np.arange(np.ceil(first - 1e-3), np.floor(last + 1e-3) + 1)
        out.append(np.interp(whole, [first, *p, last], [t[0] - 1 / GRID_HZ, *t, t[-1] + 1 / GRID_HZ]))
    return np.concatenate(out) if out else np.array([])


def evidence(found: list[Case], p: PhaseParams) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence for each event that is found (N, E), and whether it is real (N,)."""
    rows, real = [], []
    for case in found:
        for _, k, at, values in _events(case, p):
            true = case.true_s[k]
            rows.append(values)
            real.append(bool(len(true) and np.min(np.abs(true - at)) < NEAR_S))
    return np.array(rows), np.array(real)


def fit_logistic(x: np.ndarray, real: np.ndarray) -> dict[str, Any]:
    """Intercept and slope of the logistic curve, with a weak pull of the slope to 0."""
    mean, sd = x.mean(axis=0), x.std(axis=0) + 1e-9
    z, y = (x - mean) / sd, real.astype(float)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        score = w[0] + z @ w[1:]
        off = 1 / (1 + np.exp(-np.clip(score, -40, 40))) - y
        value = float(np.mean(np.logaddexp(0, score) - y * score) + 1e-4 * np.sum(w[1:] ** 2))
        return value, np.concatenate([[off.mean()], z.T @ off / len(y) + 2e-4 * w[1:]])

    w = minimize(loss, np.zeros(x.shape[1] + 1), jac=True).x
    slope = w[1:] / sd
    return {"intercept": float(w[0] - slope @ mean), "slope": [float(s) for s in slope]}


def probability(x: np.ndarray, curve: dict[str, Any]) -> np.ndarray:
    """Return the probability of each row of `evidence`."""
    return 1 / (1 + np.exp(-np.clip(curve["intercept"] + x @ np.array(curve["slope"]), -30, 30)))


def reliability(stated: np.ndarray, real: np.ndarray) -> dict[str, Any]:
    """Return the calibration of stated probabilities: mean stated and fraction of real events in each band, Brier
    score, expected calibration error."""
    edges = np.array([0, 0.2, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0 + 1e-9])
    band = np.digitize(stated, edges) - 1
    rows, error = [], 0.0
    for b in range(len(edges) - 1):
        own = band == b
        if own.any():
            rows.append([float(stated[own].mean()), float(real[own].mean()), int(own.sum())])
            error += own.mean() * abs(rows[-1][0] - rows[-1][1])
    brier = float(np.mean((stated - real) ** 2))
    return {"events": len(real), "brier": brier, "expected_error": float(error), "bands": rows}


def score(found: list[Case], p: PhaseParams) -> dict[str, float]:
    """Fraction of the true events that are found and of the found ones that are real; mean and sd of the error (ms)."""
    off, n_true, n_found = [], 0, 0
    for case in found:
        times: list[list[float]] = [[], [], [], []]
        for _, k, at, _ in _events(case, p):
            times[k].append(at)
        for k in range(4):
            n_true += len(case.true_s[k])
            n_found += len(times[k])
            if times[k]:
                near = [min((t - true for t in times[k]), key=abs) for true in case.true_s[k]]
                off += [d for d in near if abs(d) < NEAR_S]
    if not off:
        return {"true": float(n_true), "invented": float(n_found)}
    ms = 1000 * np.array(off)
    scatter = 1.4826 * np.median(np.abs(ms - np.median(ms)))
    return {
        "true": float(n_true),
        "invented": float(n_found - len(ms)),
        "found": len(ms) / max(n_true, 1),
        "real": len(ms) / max(n_found, 1),
        "mean_ms": float(ms.mean()),
        "sd_ms": float(ms.std()),
        "mad_ms": float(scatter),
    }


def calibrate(found: list[Case], p: PhaseParams, say: Callable[[str], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The curve (fitted to all cases) and its reliability (fitted to every other case, measured on the rest)."""
    half = fit_logistic(*evidence(found[::2], p))
    x, real = evidence(found[1::2], p)
    measured = reliability(probability(x, half), real)
    say(
        f"probability on {measured['events']} held-out events: Brier {measured['brier']:.4f}, "
        f"expected error {measured['expected_error']:.4f}"
    )
    for stated, fraction, n in measured["bands"]:
        say(f"  stated {stated:.3f}  real {fraction:.3f}  n {n}")
    return fit_logistic(*evidence(found, p)), measured


def _events(case: Case, p: PhaseParams) -> Iterator[tuple[int, int, float, np.ndarray]]:
    """Stretch, kind (place in `PHASE_ORDER`), time, evidence of each event before probability is asked for."""
    for number, stretch in enumerate(candidates(case.grid, case.phases, p)[0]):
        for c in stretch:
            yield number, PHASE_ORDER.index((c.side, c.event)), c.time_s, c.evidence
