"""Forces of synthetic walkers seen by a phone against those of their exact motion.

    python -m research.benchmarks.kinetics_phone
    python -m research.benchmarks.kinetics_phone --markers bml_movi_87 --first 0 --people 8

Walks of 5 s, seen obliquely or from the side by a phone that stands, with the body height stated and no log. Both the
fit and the exact motion go through the stage, so what is printed is what phone, detector and fit add: for each measure
the true mean, the error's mean and root mean square over both sides, the stated standard deviation and how many of the
90 % intervals hold the truth. What the fit of one camera loses of a measure in any walk (`ONE_CAMERA_SD`) was chosen on
the seeds 0 to 7; the default is other people. Exit code 1 where the vertical force is further off than the bar.
"""

from __future__ import annotations

import dataclasses
import sys

import click
import numpy as np

from pbl_pipeline.body import load_body, stature_m
from pbl_pipeline.fit import TrialFit, default_fit, fit_session
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.kinetics import METHODS, Kinetics, segment_inertia, visit_kinetics
from pbl_pipeline.kinetics.compute import trial_series
from pbl_pipeline.kinetics.types import WIDTH_SD
from pbl_pipeline.synthetic import Synthetic, SynthSpec, synthesise

#: Marker set -> largest root mean square of the vertical force (% BW).
BARS = {"bml_movi_87": 6.0, "blazepose_33": 10.0}


def walked(seed: int, markers: str) -> tuple[Synthetic, TrialFit, Kinetics, TrialFit, Kinetics]:
    """Return a walk, its fit with kinetics, and the exact motion in the form of a fit with its kinetics."""
    spec = SynthSpec(
        seed=seed,
        view="sagittal" if seed % 2 else "oblique",
        marker_set=markers,
        noise="memory" if markers == "blazepose_33" else "benchmark",
    )
    made = synthesise(spec)
    points, method = made.keypoints, METHODS.find()
    height = stature_m(load_body(), made.truth.scale)
    chosen = default_fit((points.marker_set, points.root_relative))
    session = fit_session([points], [f"seed{seed}"], chosen, "static", height_m=height)
    fit = session.trials[0]
    exact = dataclasses.replace(
        fit,
        qpos=np.where(np.isfinite(fit.qpos), made.truth.qpos, np.nan),
        qpos_sd=np.full_like(fit.qpos, np.nan),
        scale=made.truth.scale,
        orientation_source="measured: phone",
    )
    seen = visit_kinetics([fit], gait_metrics([fit], fit_checks=session.qc).trials, method)
    return made, fit, seen, exact, visit_kinetics([exact], gait_metrics([exact]).trials, method)


def vertical_rms(made: Synthetic, fit: TrialFit, exact: TrialFit) -> float:
    """Return the root mean square error of the vertical force of a foot on the floor (% BW), under the true events."""
    body, cutoff = load_body(), METHODS.find().params.cutoff_hz
    ours, true = (
        trial_series(body, f, segment_inertia(body, f.scale), np.asarray(f.qpos, float), made.truth.events, cutoff)
        for f in (fit, exact)
    )
    assert ours is not None
    assert true is not None
    up = np.stack([np.interp(true.time_s, ours.time_s, ours.force_bw[:, k, 2]) for k in (0, 1)], axis=1)
    on = true.force_bw[..., 2] > 0.02
    return float(100.0 * np.sqrt(np.nanmean((up - true.force_bw[..., 2])[on] ** 2)))


@click.command()
@click.option("--markers", type=click.Choice(tuple(BARS)), default="blazepose_33", show_default=True)
@click.option("--first", default=100, show_default=True, help="Seed of the first walker.")
@click.option("--people", default=8, show_default=True, help="How many walkers.")
def main(markers: str, first: int, people: int) -> None:
    """Print the table."""
    errors: dict[str, list[tuple[float, float, float]]] = {}
    rms = []
    for seed in range(first, first + people):
        made, fit, seen, exact, true = walked(seed, markers)
        if not seen.measures:
            click.echo(f"seed {seed}: {seen.code} {seen.reason}")
            continue
        rms.append(vertical_rms(made, fit, exact))
        for name, measure in seen.measures.items():
            for side in ("left", "right"):
                value, truth = getattr(measure, side), getattr(true.measures.get(name), side, None)
                if value is not None and truth is not None:
                    errors.setdefault(name, []).append((truth, value - truth, getattr(measure, f"sd_{side}")))
    mean, n = float(np.mean(rms)), len(rms)
    click.echo(f"{markers}: vertical force {mean:.1f} % BW (bar {BARS[markers]:g}), {n} of {people} walkers")
    click.echo(f"{'':42}{'true':>9}{'mean':>9}{'rms':>9}{'sd':>9}{'held':>7}")
    for name, rows in errors.items():
        truth, error, sd = np.array(rows).T
        held = np.mean(np.abs(error) < WIDTH_SD * sd)
        cells = (truth.mean(), error.mean(), np.sqrt(np.mean(error**2)), sd.mean())
        click.echo(f"{name:42}" + "".join(f"{c:9.3f}" for c in cells) + f"{100 * held:6.0f}%")
    sys.exit(int(not rms or mean > BARS[markers]))


if __name__ == "__main__":
    main()
