"""The original Gait Deviation Index on the gait cycles of eleven children, as a laboratory measured them.

    python -m research.benchmarks.gdi
    python -m research.benchmarks.gdi --events phase-transformer
    python -m research.benchmarks.gdi --conventions

Reads `../shared/data/real/gait_lab_c3d` (see the README there for source and licence): one walk of each child, angles
by Plug-in Gait, events labelled from force plates. Prints each child's index (`gillette-2008`), profile score and
cycles, the mean over the children, and the means of the index of three angles. `--events METHOD` finds the events
from the markers. `--conventions` prints what other conventions would make of the same walks, and how unlike the
controls the children's curves then are.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np
from scipy.io import loadmat
from scipy.signal import resample

from pbl_pipeline.gait import (
    EVENT_METHODS,
    NINE_ANGLES,
    GaitMetrics,
    LabTrial,
    detect_events,
    gait_metrics,
    load_norm,
    read_lab_trial,
)
from research.paths import SHARED

#: Angles whose sign is a convention. Tilt and flexions cannot be taken for their opposite.
SIGNED = ("pelvis_obliquity", "pelvis_rotation", "hip_adduction", "hip_rotation", "foot_progression")
#: Principal components of the controls in which a cycle is compared with them (99 % of their variance).
COMPONENTS = 45


def walks(shared: Path) -> list[LabTrial]:
    """One walk of each child."""
    return [read_lab_trial(p) for p in sorted((shared / "real" / "gait_lab_c3d").glob("Straight_*.c3d.gz"))]


def children(
    shared: Path, norm: str = "gillette-166-nine-angles", events: str = "labels"
) -> Iterator[tuple[str, GaitMetrics]]:
    """Name and measures of each child's walk."""
    for trial in walks(shared):
        if events != "labels" and trial.feet is not None:
            trial = dataclasses.replace(trial, events=detect_events(trial.feet, events))
        yield trial.name.removeprefix("Straight_"), gait_metrics([trial], norm)


#: Cycles of a child: side, and the curves (9, 51) in degrees.
Cycles = list[tuple[str, np.ndarray]]


def curves(trial: LabTrial, shift_s: float = 0.0, fourier: bool = False) -> Cycles:
    """Return all cycles from label to label, shifted in time; by Fourier resampling from 101 points, as the program
    that was published with the index does it, instead of interpolation."""
    out, time = [], trial.series.time_s
    for side in ("left", "right"):
        angles = trial.series.of_side(side)
        for a, b in itertools.pairwise(np.array(trial.events.times(side, "foot_down")) + shift_s):
            if fourier:
                first, last = (round((t - time[0]) / (time[1] - time[0])) for t in (a, b))
                made = [resample(angles[n][first : last + 1], 101)[::2] for n in NINE_ANGLES]
            else:
                made = [np.interp(np.linspace(a, b, 51), time, angles[n]) for n in NINE_ANGLES]
            out.append((side, np.array(made)))
    return out


def flipped(cycles: Cycles, angle: str, sides: tuple[str, ...]) -> Cycles:
    """The sign of one angle turned on some sides."""
    sign = np.where(np.array(NINE_ANGLES) == angle, -1.0, 1.0)[:, None]
    return [(side, c * sign if side in sides else c) for side, c in cycles]


def unlike_controls(shared: Path) -> Callable[[np.ndarray], float]:
    """Mahalanobis distance of curves (9, 51) to the 166 controls, in the controls' own principal components, most of
    which the index does not look at; the controls' own is 6.4 (median)."""
    data = loadmat(shared / "real" / "gdi_gillette" / "GDI_Calc_Fast_Data.mat")["all_ctrl_gait_vectors"].T
    mean = data.mean(axis=0)
    _, singular, rows = np.linalg.svd(data - mean, full_matrices=False)
    sd = singular[:COMPONENTS] / np.sqrt(len(data) - 1)
    return lambda c: float(np.linalg.norm(rows[:COMPONENTS] @ (c.ravel() - mean) / sd))


def conventions(shared: Path, say: Callable[[str], None] = click.echo) -> dict[str, tuple[float, float, float]]:
    """Return for each convention mean and sd of the index over the children, and the median distance to the
    controls."""
    trials, norm, distance = walks(shared), load_norm("gillette-166-nine-angles"), unlike_controls(shared)
    plain = [curves(t) for t in trials]
    made = {
        "as it is": plain,
        "labels one frame later": [curves(t, 0.01) for t in trials],
        "labels one frame earlier": [curves(t, -0.01) for t in trials],
        "as the program published with the index": [curves(t, -0.01, fourier=True) for t in trials],
        "mean curve of each side": [
            [(s, np.mean([c for side, c in child if side == s], axis=0)) for s in ("left", "right")] for child in plain
        ],
        "left cycles only": [[c for c in child if c[0] == "left"] for child in plain],
        "right cycles only": [[c for c in child if c[0] == "right"] for child in plain],
    }
    for angle in SIGNED:
        made[f"{angle} turned"] = [flipped(child, angle, ("left", "right")) for child in plain]
        made[f"{angle} turned, left only"] = [flipped(child, angle, ("left",)) for child in plain]
    out = {}
    say(f"{'convention':<42}{'mean':>7}{'sd':>6}{'distance':>10}")
    for name, cycles in made.items():
        index = [np.mean(norm.index(np.array([c.ravel() for _, c in child]))) for child in cycles]
        away = float(np.median([distance(c) for child in cycles for _, c in child]))
        out[name] = float(np.mean(index)), float(np.std(index, ddof=1)), away
        say(f"{name:<42}{out[name][0]:>7.1f}{out[name][1]:>6.1f}{away:>10.1f}")
    return out


@click.command()
@click.option("--events", type=click.Choice(["labels", *EVENT_METHODS]), default="labels", show_default=True)
@click.option("--conventions", "others", is_flag=True, help="What other conventions would make of the walks.")
def main(events: str, others: bool) -> None:
    """Print index and profile score of each child, and their means."""
    if others:
        conventions(SHARED)
        return
    click.echo(f"{'child':<12}{'cycles':>7}{'left':>8}{'right':>8}{'GDI':>8}{'GPS':>7}")
    for norm in ("gillette-166-nine-angles", "gillette-166-three-angles"):
        sessions, cycles = [], []
        for name, metrics in children(SHARED, norm, events):
            g = metrics.gdi
            if g.mean is None:
                click.echo(f"{name:<12}{g.n:>7}  {g.reason}")
                continue
            sessions.append(g.mean)
            cycles += [c.gdi for c in g.cycles]
            gps = g.profile.gps if g.profile is not None else None
            if gps is not None:
                click.echo(f"{name:<12}{g.n:>7}{g.left:>8.1f}{g.right:>8.1f}{g.mean:>8.1f}{gps:>7.1f}")
        for what, values in (("children", sessions), ("cycles", cycles)):
            mean, sd = np.mean(values), np.std(values, ddof=1)
            click.echo(f"{norm}: {mean:.1f}, sd {sd:.1f} over {len(values)} {what}")


if __name__ == "__main__":
    main()
