"""How far the standard deviations of a fit (`TrialFit.qpos_sd`) tell its errors, on synthetic walkers.

    python -m tests.benchmarks.uncertainty
    python -m tests.benchmarks.uncertainty --seeds 24 --params blazepose --marker-set blazepose_33

Fits walks of 6 s with the paramset's factors all 1, half of them by a static phone and half by one in the hand, both
with the phone's log. Per group of joints it finds the factor of the standard deviation with which a 90 % interval,
1.645 standard deviations to either side, holds the truth in 90 % of the samples of the calibration walks, and counts
what these intervals hold on other walks by other people. Also counted: the factors that the paramset has now.

Prints the factors as the value of `SD_FACTOR` in pbl_pipeline/fit/_params.py. Exit code 1 where a group with the new
factors holds less than 85 % or more than 95 % of the other walks' samples.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Sequence

import click
import numpy as np

from pbl_pipeline.body import SLIDES
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import PARAMSETS, SessionInput, fit_sessions, params_of
from pbl_pipeline.fit._params import GaussNewtonParams
from pbl_pipeline.fit.solvers.gauss_newton import sd_factors
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.synthetic import observe, person, walk_qpos

#: Prefixes of joint names, one factor each; of two that fit, the later one counts.
GROUPS = (
    "pelvis_t",
    "pelvis_ty",
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "hip",
    "knee",
    "ankle",
    "subtalar",
    "mtp",
    "lumbar",
    "neck",
    "arm",
    "arm_rot",
    "elbow",
    "pro_sup",
    "wrist",
)
#: Standard deviations to either side of a 90 % interval of the normal distribution, and what it should hold.
WIDTH_SD, SHARE = 1.645, 0.90
BAND = (0.85, 0.95)
TIME_S = np.arange(180) / 30
#: Held-out walks have seeds from here on.
HELD_OUT = 1000


def bare(paramset: Paramset) -> Paramset:
    """The same fit with every factor 1."""
    params = dataclasses.replace(params_of(paramset), sd_factor=())
    return Paramset.of(paramset.stage, paramset.name, paramset.version, params)


def group_of(joint: str) -> str:
    """The group of a joint."""
    return [g for g in GROUPS if joint.startswith(g)][-1]


def walk(seed: int, marker_set: str) -> tuple[SessionInput, np.ndarray]:
    """A session of one trial and its true qpos (T, 40); odd seeds hold the phone in the hand."""
    motion = "handheld" if seed % 2 else "static"
    scale, offset = person(seed, marker_set)
    qpos = walk_qpos(TIME_S, seed)
    tilt = tuple(np.random.default_rng([seed, 9]).uniform(-8, 8, 2)) if motion == "static" else (0.0, 0.0)
    seen = observe(
        qpos,
        TIME_S,
        marker_set=marker_set,
        scale=scale,
        site_offset_m=offset,
        seed=seed,
        camera_motion=motion,
        tilt_deg=tilt,
        with_phone=True,
    )
    return SessionInput([seen.keypoints], [f"walk {seed}"], motion), qpos


def standardised(
    seeds: Iterable[int], paramset: Paramset, marker_set: str
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """|error| / sd (N, 40) of all frames of all walks, |error| (N, 40) in m and rad, and the joints' names."""
    ratios, errors, names = [], [], ()
    walks = [walk(s, marker_set) for s in seeds]
    fits = fit_sessions([w for w, _ in walks], paramset)
    for (given, truth), fit in zip(walks, fits, strict=True):
        if isinstance(fit, PblError):
            click.echo(f"  {given.names[0]} left out: {fit}", err=True)
            continue
        trial = fit.trials[0]
        names = trial.joint_names
        known = np.isfinite(trial.qpos).all(axis=1)
        error = trial.qpos[known] - truth[known]
        turns = np.array([n not in SLIDES for n in names])
        error = np.where(turns, np.angle(np.exp(1j * error)), error)
        errors.append(np.abs(error))
        ratios.append(np.abs(error) / trial.qpos_sd[known])
    return np.concatenate(ratios), np.concatenate(errors), names


def columns(names: Sequence[str], group: str) -> list[int]:
    """Joints of a group."""
    return [i for i, n in enumerate(names) if group_of(n) == group]


def factors_of(ratios: np.ndarray, names: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """(group, factor) with which `SHARE` of the samples lie within the interval."""
    quantile = {g: float(np.quantile(ratios[:, columns(names, g)], SHARE)) / WIDTH_SD for g in GROUPS}
    return tuple((g, round(f, 2)) for g, f in quantile.items())


def coverage(ratios: np.ndarray, names: Sequence[str], factors: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Share of the samples of each group within the interval."""
    inside = ratios < WIDTH_SD * sd_factors(names, factors)
    return {g: float(np.mean(inside[:, columns(names, g)])) for g in GROUPS}


@click.command()
@click.option("--seeds", default=48, show_default=True, help="Walks to calibrate on, and as many others to check.")
@click.option("--params", default="gauss-newton", show_default=True, type=click.Choice(sorted(PARAMSETS)))
@click.option("--marker-set", default="bml_movi_87", show_default=True)
def main(seeds: int, params: str, marker_set: str) -> None:
    """Print factors and coverage; exit code 1 where a group's coverage on other walks is outside the band."""
    given = PARAMSETS[params]
    now = params_of(given)
    if not isinstance(now, GaussNewtonParams):
        sys.exit(f"paramset {params} gives no standard deviations")
    known, _, names = standardised(range(seeds), bare(given), marker_set)
    other, errors, _ = standardised(range(HELD_OUT, HELD_OUT + seeds), bare(given), marker_set)
    factors = factors_of(known, names)
    new, old = coverage(other, names, factors), coverage(other, names, now.sd_factor)
    click.echo(f"{params}: {seeds} walks to calibrate on ({len(known)} frames), {seeds} others ({len(other)} frames)")
    click.echo(f"  {'group':16}{'factor':>8}{'held out':>10}{'now':>8}   median |error| held out")
    bad = []
    for group, factor in factors:
        error = float(np.median(errors[:, columns(names, group)]))
        unit = f"{1000 * error:.1f} mm" if group in ("pelvis_t", "pelvis_ty") else f"{np.rad2deg(error):.2f} deg"
        good = BAND[0] <= new[group] <= BAND[1]
        bad += [] if good else [group]
        mark = "" if good else "   OUTSIDE THE BAND"
        click.echo(f"  {group:16}{factor:8.2f}{new[group]:10.1%}{old[group]:8.1%}   {unit}{mark}")
    click.echo("\nSD_FACTOR: tuple[tuple[str, float], ...] = (")
    for group, factor in factors:
        click.echo(f'    ("{group}", {factor}),')
    click.echo(")")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
