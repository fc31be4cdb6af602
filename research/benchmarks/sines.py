"""Iterations of `gauss-newton` on motions that no walker makes: every joint follows a sum of sines.

    python -m research.benchmarks.sines                         # a few minutes on two cores
    python -m research.benchmarks.sines --share 0.95 --people 2

Each person's joints swing about the middle of their ranges, by `--degrees` or up to `--share` of the range, whichever
is less, and are seen as 87 points with the benchmark's noise. Each is fitted as usual and once more until
nothing moves; the table has the iterations of both and by how much the angles differ.
"""

from __future__ import annotations

import dataclasses

import click
import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import SLIDES, load_body
from pbl_pipeline.fit import METHODS, GaussNewtonParams, SessionFit, fit_session
from pbl_pipeline.keypoints import Keypoints
from research.walker.observe import observe
from research.walker.walk import person

#: Sines of a joint, their frequencies (Hz), and how far the pelvis turns (deg) and moves (m).
SINES, FREQUENCIES_HZ = 3, (0.2, 1.2)
PELVIS_DEG, PELVIS_M = 20.0, 0.2
FPS = 30.0


def motion(seed: int, n_frames: int, degrees: float, share: float) -> Float[np.ndarray, "T 40"]:
    """Return the joint values (rad, m) of a person whose joints all move at once."""
    body, rng = load_body(), np.random.default_rng([seed, 71])
    time_s = np.arange(n_frames) / FPS
    free = ~np.isfinite(body.joint_range_rad[:, 0])
    low, high = np.where(free, 0.0, body.joint_range_rad.T)
    middle = 0.5 * (low + high)
    widest = np.where(free, np.where(body.is_slide, PELVIS_M, np.radians(PELVIS_DEG)), 0.5 * share * (high - low))
    size = (SINES, len(low))
    frequency, phase = rng.uniform(*FREQUENCIES_HZ, size), rng.uniform(0, 2 * np.pi, size)
    waves = np.sin(2 * np.pi * frequency * time_s[:, None, None] + phase).mean(axis=1)
    amplitude = np.where(body.is_slide, widest, np.minimum(widest, np.radians(degrees)))
    return middle + amplitude * waves / np.abs(waves).max(axis=0)


def seen(seed: int, n_frames: int, degrees: float, share: float) -> Keypoints:
    """Return the 87 points of such a motion, 4.5 m from a phone that stands."""
    scale, offset = person(seed)
    qpos, time_s = motion(seed, n_frames, degrees, share), np.arange(n_frames) / FPS
    return observe(qpos, time_s, view="oblique", scale=scale, site_offset_m=offset, seed=seed).keypoints


def differences_deg(a: SessionFit, b: SessionFit) -> Float[np.ndarray, " 34"]:
    """Return the largest difference of each angle of two fits of one recording, without the slides."""
    turns = [n not in SLIDES for n in a.trials[0].joint_names]
    return np.degrees(np.nanmax(np.abs(a.trials[0].qpos - b.trials[0].qpos)[:, turns], axis=0))


@click.command(epilog="Example: python -m research.benchmarks.sines --degrees 30 --people 2")
@click.option("--degrees", type=click.FloatRange(0), default=30.0, show_default=True, help="How far joints swing.")
@click.option("--share", type=click.FloatRange(0, 1), default=0.95, show_default=True, help="Most of a joint's range.")
@click.option("--people", type=click.IntRange(1), default=4, show_default=True)
@click.option("--frames", type=click.IntRange(60), default=300, show_default=True)
@click.option("--method", default="gauss-newton", show_default=True)
def main(degrees: float, share: float, people: int, frames: int, method: str) -> None:
    """Print iterations, and angles against a long solve, for each person."""
    params = METHODS.find(method).params
    if not isinstance(params, GaussNewtonParams):
        raise click.UsageError(f"{method} has no iterations to count")
    long = dataclasses.replace(params, tolerance_rad=1e-6, tolerance_cost=-1.0, max_iterations=200)
    click.echo("person  iterations  cost      long: iterations  cost      largest difference deg  joint")
    for seed in range(people):
        keypoints = seen(seed, frames, degrees, share)
        usual, end = (fit_session([keypoints], ["sines"], p) for p in (params, long))
        away = differences_deg(usual, end)
        names = [n for n in usual.trials[0].joint_names if n not in SLIDES]
        costs = (f.loss_trace[-1, 1] for f in (usual, end))
        numbers = zip((usual.iterations, end.iterations), costs, strict=True)
        columns = "  ".join(f"{n:>10}  {cost:9.4f}" for n, cost in numbers)
        click.echo(f"{seed:>6}  {columns}  {away.max():.3f}  {names[int(np.argmax(away))]}")


if __name__ == "__main__":
    main()
