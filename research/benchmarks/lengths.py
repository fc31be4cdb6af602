"""Stride length, step length, step width and speed of fits against synthetic walkers whose footprints are known.

    python -m research.benchmarks.lengths
    python -m research.benchmarks.lengths --seeds 2

One camera that stands still, three views, two marker sets with the noise of `pbl bench fit`; then markers of a
laboratory with 4 mm of noise. The detector knows how large the person is: what a real one gets wrong there is not in
these errors.
Prints for each the largest error of a person (length and speed in percent, step width in cm) and its mean.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import click
import numpy as np

from pbl_pipeline.fit import METHODS, TrialFit, fit_session
from pbl_pipeline.gait import GaitEvent, detect_events, feet_from_fit, find_cycles
from pbl_pipeline.keypoints import WorldMarkers
from pbl_pipeline.synthetic import Synthetic, SynthSpec, synthesise

MARKER_SD_M = 0.004
NAMES = ("stride_length_m", "step_length_m", "step_width_m")


def lengths(fit: TrialFit, events: Sequence[GaitEvent]) -> np.ndarray:
    """Mean stride length, step length, step width (m) and speed (m/s), the width whatever the fit is made of."""
    cycles = find_cycles(events, dataclasses.replace(fit, orientation_source="measured: calibration"), keep_ends=True)
    rows = [
        [*(getattr(c.lengths, n) for n in NAMES), c.lengths.stride_length_m / c.stride_time_s]
        for c in cycles
        if c.lengths.stride_length_m is not None
    ]
    return np.mean(np.array(rows, float), axis=0)


def errors(made: Synthetic, fit: TrialFit) -> np.ndarray:
    """Stride (%), step (%), width (cm), speed (%) of a fit with the events found in it against the truth's."""
    truth = made.truth
    true = lengths(dataclasses.replace(fit, qpos=truth.qpos, scale=truth.scale), truth.events)
    found = lengths(fit, detect_events(feet_from_fit(fit)).events)
    return np.where([1, 1, 0, 1], 100 * (found / true - 1), 100 * (found - true))


def seen(made: Synthetic) -> TrialFit:
    """Fit of what one camera sees."""
    return fit_session([made.keypoints], ["walk"]).trials[0]


def measured(made: Synthetic) -> TrialFit:
    """Fit of markers in a laboratory."""
    truth, k = made.truth, made.keypoints
    noise = np.random.default_rng(0).normal(0, MARKER_SD_M, truth.markers_world_m.shape)
    xyz = truth.markers_world_m + noise
    markers = WorldMarkers(truth.time_s, k.names, k.marker_set, xyz, np.ones(xyz.shape[:2]))
    return fit_session([markers], ["walk"], METHODS["markers"]).trials[0]


@click.command()
@click.option("--seeds", type=click.IntRange(1), default=4, show_default=True, help="People.")
def main(seeds: int) -> None:
    """Print the errors of each case."""
    click.echo(f"{'case':<28}{'stride %':>16}{'step %':>16}{'width cm':>16}{'speed %':>16}   (mean, largest)")
    for points in ("blazepose_33", "bml_movi_87"):
        for view in ("frontal", "oblique", "sagittal"):
            specs = [SynthSpec(seed=s, view=view, marker_set=points) for s in range(1, seeds + 1)]
            _row(f"{points} {view}", [errors(m, seen(m)) for m in map(synthesise, specs)])
    specs = [SynthSpec(seed=s, view="sagittal", marker_set="bml_movi_87", noise="none") for s in range(1, seeds + 1)]
    _row("markers of a laboratory", [errors(m, measured(m)) for m in map(synthesise, specs)])


def _row(name: str, found: list[np.ndarray]) -> None:
    table = np.array(found)
    worst = table[np.abs(table).argmax(axis=0), range(table.shape[1])]
    cells = (f"{m:+.1f}, {w:+.1f}" for m, w in zip(table.mean(axis=0), worst, strict=True))
    click.echo(f"{name:<28}" + "".join(f"{c:>16}" for c in cells))


if __name__ == "__main__":
    main()
