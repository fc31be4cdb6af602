"""Agreement of the standard deviations of a fit (`TrialFit.qpos_sd`) with its errors, on synthetic people.

    python -m research.benchmarks.uncertainty
    python -m research.benchmarks.uncertainty --params blazepose

Fits recordings whose truth is known, with all factors 1 and no least standard deviation, and finds per group of joints
what makes a 90 % interval, 1.645 standard deviations to either side, hold the truth in 90 % of the samples of these
recordings; then it counts what the intervals hold on others, of other people.

`gauss-newton`: walks of 6 s with the benchmark's noise, half of them by a static phone and half by one in the hand,
both with the phone's log. The residuals tell these errors, so a factor is found (`SD_FACTOR_METRABS`).
`blazepose`: 5 s of walking, standing up or squats at 30 and 60 Hz with BlazePose's own errors (`BLAZEPOSE_NOISE`,
points 25 mm from the marker set's places), half by a phone that stands tilted by some degrees without a log. Most of
these errors are the same in many frames and in no residual, so a least standard deviation is found
(`SD_FLOOR_BLAZEPOSE`).

Prints them as they stand in pbl_pipeline/fit/params.py. Exit code 1 where a group holds less than 85 % or more than
95 % of the other recordings' samples.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import click
import numpy as np

from pbl_pipeline.body import SLIDES, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, GaussNewtonParams, SessionInput, fit_sessions
from pbl_pipeline.fit.per_frame import by_joint, floors_of
from pbl_pipeline.methods import Method
from pbl_pipeline.results.measures import Z90
from pbl_pipeline.synthetic import CORRELATED_NOISE, SynthSpec, synthesise
from research.walker.detectors import BLAZEPOSE_NOISE
from research.walker.observe import observe
from research.walker.walk import person, walk_qpos

#: Prefixes of joint names, one factor each; of two that fit, the later one counts.
GROUPS = (
    "pelvis_t",
    "pelvis_ty",
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
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
#: Share of the errors in a 90 % interval.
SHARE = 0.90
BAND = (0.85, 0.95)
TIME_S = np.arange(180) / 30
#: Held-out walks have seeds from here on.
HELD_OUT = 1000


def bare(method: Method[Any]) -> Method[Any]:
    """The same fit with every factor 1 and no least standard deviation."""
    assert isinstance(method.params, GaussNewtonParams)
    params = dataclasses.replace(method.params, sd_factor=(), sd_floor=())
    return METHODS.make(method.name, method.version, params)


def group_of(joint: str) -> str:
    """The group of a joint."""
    return [g for g in GROUPS if joint.startswith(g)][-1]


def walk(seed: int) -> tuple[SessionInput, np.ndarray]:
    """A session of one trial and its true qpos (T, 40); odd seeds hold the phone in the hand."""
    motion = "handheld" if seed % 2 else "static"
    scale, offset = person(seed)
    qpos = walk_qpos(TIME_S, seed)
    tilt = tuple(np.random.default_rng([seed, 9]).uniform(-8, 8, 2)) if motion == "static" else (0.0, 0.0)
    seen = observe(
        qpos,
        TIME_S,
        scale=scale,
        site_offset_m=offset,
        seed=seed,
        camera_motion=motion,
        tilt_deg=tilt,
        with_phone=True,
        noise=CORRELATED_NOISE,
    )
    return SessionInput([seen.keypoints], [f"walk {seed}"], motion), qpos


#: Tasks and views of the recordings with BlazePose's errors, one after the other.
SCENES = (
    ("walk", "frontal"),
    ("walk", "oblique"),
    ("walk", "sagittal"),
    ("sit_to_stand", "frontal"),
    ("sit_to_stand", "oblique"),
    ("squat", "frontal"),
)


def clip(seed: int) -> tuple[SessionInput, np.ndarray]:
    """The same with BlazePose's errors; seeds take turns at scene, frame rate, and a phone that stands or is held."""
    task, view = SCENES[seed % len(SCENES)]
    fps, held = (30.0, 60.0)[seed // 6 % 2], bool(seed // 12 % 2)
    ground = "treadmill" if view == "sagittal" else "overground"  # no one walks out of a phone's upright picture
    truth = synthesise(
        SynthSpec(task, seed, view=view, fps=fps, marker_set="blazepose_33", ground=ground, seconds=5.0)
    ).truth
    rng = np.random.default_rng([seed, 9])
    seen = observe(
        truth.qpos,
        truth.time_s,
        marker_set="blazepose_33",
        scale=truth.scale,
        site_offset_m=rng.normal(0, 0.025, (33, 3)),
        noise=BLAZEPOSE_NOISE,
        seed=seed,
        camera_motion="handheld" if held else "static",
        tilt_deg=(0.0, 0.0) if held else tuple(rng.normal(0, 3, 2)),
    )
    return SessionInput([seen.keypoints], [f"{task} {seed}"], "handheld" if held else "static"), truth.qpos


def errors_and_sd(
    recordings: Iterable[tuple[SessionInput, np.ndarray]], method: Method[Any]
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """|error| and standard deviation (N, 40) of all frames in m and rad, and the joints' names."""
    errors, sds, names = [], [], ()
    recordings = list(recordings)
    fits = fit_sessions([r for r, _ in recordings], method)
    for (given, truth), fit in zip(recordings, fits, strict=True):
        if isinstance(fit, PblError):
            click.echo(f"  {given.names[0]} left out: {fit}", err=True)
            continue
        trial = fit.trials[0]
        names = trial.joint_names
        known = np.isfinite(trial.qpos).all(axis=1)
        error = trial.qpos[known] - truth[known]
        turns = np.array([n not in SLIDES for n in names])
        errors.append(np.abs(np.where(turns, np.angle(np.exp(1j * error)), error)))
        sds.append(trial.qpos_sd[known])
    return np.concatenate(errors), np.concatenate(sds), names


def columns(names: Sequence[str], group: str) -> list[int]:
    """Joints of a group."""
    return [i for i, n in enumerate(names) if group_of(n) == group]


def factors_of(errors: np.ndarray, sds: np.ndarray, names: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """(group, factor) with which `SHARE` of the samples lie within the interval."""
    ratios = errors / sds / Z90
    return tuple((g, round(float(np.quantile(ratios[:, columns(names, g)], SHARE)), 2)) for g in GROUPS)


def floors_for(errors: np.ndarray, sds: np.ndarray, names: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """(group, least standard deviation in deg or cm) with which `SHARE` of the samples lie within the interval."""
    found = []
    for group in GROUPS:
        at = columns(names, group)
        # A sample lies within from the floor on that makes up for what its own standard deviation lacks.
        lack = np.sqrt(np.maximum((errors[:, at] / Z90) ** 2 - sds[:, at] ** 2, 0.0))
        unit = 100.0 if names[at[0]] in SLIDES else np.rad2deg(1.0)
        found.append((group, round(float(np.quantile(lack, SHARE)) * unit, 1)))
    return tuple(found)


def coverage(errors: np.ndarray, sds: np.ndarray, names: Sequence[str], params: GaussNewtonParams) -> dict[str, float]:
    """Share of the samples of each group within the interval."""
    factor, floor = by_joint(names, params.sd_factor, 1.0), floors_of(load_body(), params.sd_floor)
    inside = errors < Z90 * np.sqrt((sds * factor) ** 2 + floor**2)
    return {g: float(np.mean(inside[:, columns(names, g)])) for g in GROUPS}


@click.command()
@click.option("--seeds", default=48, show_default=True, help="Recordings to calibrate on, and as many others to check.")
@click.option("--params", default="gauss-newton", show_default=True, type=click.Choice(["gauss-newton", "blazepose"]))
def main(seeds: int, params: str) -> None:
    """Print what calibrates, and coverage; exit code 1 where a group's on other recordings is outside the band."""
    given = METHODS[params]
    now = given.params
    assert isinstance(now, GaussNewtonParams)
    record = clip if params == "blazepose" else walk
    known, known_sd, names = errors_and_sd(map(record, range(seeds)), bare(given))
    other, other_sd, _ = errors_and_sd(map(record, range(HELD_OUT, HELD_OUT + seeds)), bare(given))
    if params == "blazepose":
        what, found = "SD_FLOOR_BLAZEPOSE", floors_for(known, known_sd, names)
        calibrated = dataclasses.replace(now, sd_factor=(), sd_floor=found)
    else:
        what, found = "SD_FACTOR_METRABS", factors_of(known, known_sd, names)
        calibrated = dataclasses.replace(now, sd_factor=found)
    new, old = coverage(other, other_sd, names, calibrated), coverage(other, other_sd, names, now)
    click.echo(f"{params}: {seeds} recordings to calibrate on ({len(known)} frames), {seeds} others ({len(other)})")
    column = what.rsplit("_", 1)[0].lower()
    click.echo(f"  {'group':16}{column:>10}{'held out':>10}{'now':>8}   median |error| held out")
    bad = []
    for group, value in found:
        error = float(np.median(other[:, columns(names, group)]))
        unit = f"{1000 * error:.1f} mm" if group in ("pelvis_t", "pelvis_ty") else f"{np.rad2deg(error):.2f} deg"
        good = BAND[0] <= new[group] <= BAND[1]
        bad += [] if good else [group]
        mark = "" if good else "   OUTSIDE THE BAND"
        click.echo(f"  {group:16}{value:10.2f}{new[group]:10.1%}{old[group]:8.1%}   {unit}{mark}")
    click.echo(f"\n{what}: tuple[tuple[str, float], ...] = (")
    for group, value in found:
        click.echo(f'    ("{group}", {value}),')
    click.echo(")")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
