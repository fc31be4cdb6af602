"""Variation of the vertical force of walking between people, for `pbl_pipeline/kinetics/vertical.py`.

    python -m research.vertical_force --adults FOLDER            # print how well it does on persons held out
    python -m research.vertical_force --adults FOLDER --write    # also write the model that ships

Two sources, half of the persons of each held out:

- children: the walks of `research.benchmarks.kinetics` on two plates (mcgillmotionlab/biomechzoo, MIT);
- adults: 10 persons with 60 steps each at 0.7 to 2.2 m/s on a pressure plate (Pataky et al. 2008, J Biomech
  41:1987-1994), the files `ex_grf_subj*.npy` and `ex_grf_speeds.npy` that the Python package spm1d carries; FOLDER
  holds them. Only mean curves and their components are kept here. The plate's scale is unknown: each step is scaled so
  that its impulse carries the weight. Times of stance and double support at each speed, and the stature, are not in the
  files: they are means of adults (Bovi et al. 2011, Gait Posture 33:6-13).
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import click
import numpy as np
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import load_body, stature_m
from pbl_pipeline.kinetics import GRAVITY, contact_of, inverse_dynamics, smooth_motion
from pbl_pipeline.kinetics import vertical as stage
from pbl_pipeline.kinetics.dynamics import GRID_HZ
from pbl_pipeline.results.measures import Z90
from research.benchmarks.kinetics import FOLDER, TUNING, fit_walk, read_walk, steps_of

TARGET = Path(stage.__file__).with_name("vertical_models") / "vertical-force-2.json"
#: Phases of the model: middles of equal parts of double and of single support.
PHASE = np.concatenate([(np.arange(10) + 0.5) / 10, 1.0 + (np.arange(20) + 0.5) / 20])
#: Of adults at four speeds (statures a second): stance and first double support, fractions of the cycle.
BOVI = ((0.493, 0.698, 0.873, 1.154), (0.6536, 0.6267, 0.6171, 0.5913), (0.1529, 0.1279, 0.1190, 0.0947))
STATURE_M = 1.72
#: Adults on whom the model is fitted.
TUNING_ADULTS = (0, 2, 4, 6, 8)
N_COMPONENTS = 20
#: How long an error of a phone's force stays alike: its autocorrelation over the tuning clips of
#: `research.benchmarks.kinetics_phone` falls to 0.6 in this time.
ERROR_MEMORY_S = 0.02
#: Chosen by the least error of the vertical force of tuning persons, here and in `research.benchmarks.kinetics_phone`
#: (research/reports/2026-11-29_forces.md).
CHOSEN = {
    "step_sd": 0.04,
    "step_memory_s": 0.06,
    "noise_memory_s": 0.02,
    "noise": {"blazepose_33": (0.1, 0.95, 1.3, 0.04)},
}
#: Standard deviation (body weights) and correlation length (of single support; three times as much of double support)
#: of forces of people unlike any combination of the few on whom the model is fitted. Chosen as those above.
UNLIKE = (0.06, 0.09)


@dataclasses.dataclass(frozen=True)
class Person:
    """Total vertical force of a person's steps (N, P) over `PHASE` in body weights, at dimensionless speeds (N,)."""

    name: str
    tuning: bool
    speed: np.ndarray
    force: np.ndarray


def adults(folder: Path) -> list[Person]:
    """Return the adults."""
    speeds = np.load(folder / "ex_grf_speeds.npy")
    people = []
    for k in range(speeds.shape[1]):
        stance, double = (np.interp(speeds[:, k] / STATURE_M, BOVI[0], BOVI[i]) for i in (1, 2))
        steps = np.load(folder / f"ex_grf_subj{k:03d}.npy")
        percent = np.linspace(0.0, 1.0, steps.shape[1])
        mean = np.trapezoid(steps, percent, axis=1)
        total = []
        for step, share, scale in zip(steps, double / stance, 0.5 / stance / mean, strict=True):
            own = np.where(PHASE < 1.0, PHASE * share, share + (PHASE - 1.0) * (1.0 - 2.0 * share))
            other = np.interp(1.0 - share + PHASE * share, percent, step)
            total.append(scale * (np.interp(own, percent, step) + np.where(PHASE < 1.0, other, 0.0)))
        dimensionless = speeds[:, k] / np.sqrt(GRAVITY * STATURE_M)
        people.append(Person(f"adult {k}", k in TUNING_ADULTS, dimensionless, np.array(total)))
    return people


def children() -> list[Person]:
    """Return the children, each with the mean of the double and single supports that both plates saw as a whole."""
    people, body = [], load_body()
    for path in sorted(FOLDER.glob("Straight_*.c3d.gz")):
        walk = read_walk(path)
        fit = fit_walk(walk)
        one, two = sorted(steps_of(walk, fit, 6.0), key=lambda s: s.time_s[s.stance][0])
        motion = smooth_motion(fit.time_s, fit.qpos, 6.0)[0]
        centre = inverse_dynamics(body, fit.scale, motion).centre_m
        feet = np.sum(contact_of(motion.time_s, walk.events) == 1, axis=1)
        known = slice(np.flatnonzero(one.alone)[0], np.flatnonzero(two.alone)[-1] + 1)
        phase, total = stage.support_phase(_two(feet))[known], (one.force + two.force)[known, 2] / GRAVITY
        curve = []
        for inside, part in ((phase < 1.0, PHASE < 1.0), (phase >= 1.0, PHASE >= 1.0)):
            edges = np.flatnonzero(np.diff(phase[inside]) < 0) + 1
            seen = zip(np.split(phase[inside], edges), np.split(total[inside], edges), strict=True)
            curve.append(np.mean([np.interp(PHASE[part], p, f) for p, f in seen], axis=0))
        speed = stage.dimensionless_speed(centre, stature_m(body, fit.scale))
        tuning = walk.name.startswith(TUNING)
        people.append(Person(walk.name, tuning, np.array([speed]), np.concatenate(curve)[None]))
    return people


def _two(feet: np.ndarray) -> np.ndarray:
    return np.stack([feet > 0, feet > 1], axis=1)


def fitted(people: list[Person]) -> stage.VerticalModel:
    """Return the model of these persons, each counting as much as another."""
    speed, force = np.concatenate([p.speed for p in people]), np.concatenate([p.force for p in people])
    weight = np.concatenate([np.full(len(p.speed), 1.0 / np.sqrt(len(p.speed))) for p in people])
    middle = float(np.mean([p.speed.mean() for p in people]))
    design = np.stack([np.ones_like(speed), speed - middle], axis=1)
    mean, slope = np.linalg.lstsq(weight[:, None] * design, weight[:, None] * force, rcond=None)[0]
    own = [(p.force - mean - (p.speed - middle)[:, None] * slope).mean(axis=0) for p in people]
    values, vectors = np.linalg.eigh(np.transpose(own) @ own / (len(people) - 2) + _unlike())
    components = vectors[:, ::-1][:, :N_COMPONENTS] * np.sqrt(np.maximum(values, 0.0)[::-1][:N_COMPONENTS])
    chosen = {**CHOSEN, "noise": {k: stage.Noise(*v) for k, v in CHOSEN["noise"].items()}}
    return stage.VerticalModel(
        name=TARGET.stem,
        phase=PHASE,
        mean=mean,
        slope=slope,
        person=components,
        speed=middle,
        speed_range=(float(speed.min()), float(speed.max())),
        **chosen,
    )


def _unlike() -> np.ndarray:
    """Return the covariance of `UNLIKE` between the phases (P, P)."""
    sd, length = UNLIKE
    place = np.where(PHASE < 1.0, PHASE / 3.0, PHASE - 2.0 / 3.0)
    apart = np.abs(place[:, None] - place)
    return sd**2 * np.exp(-0.5 * (np.minimum(apart, 4.0 / 3.0 - apart) / length) ** 2)


def write(model: stage.VerticalModel, path: Path) -> None:
    """Write the model that ships."""
    content = {
        k: np.round(v, 4).tolist() if isinstance(v, np.ndarray | float | tuple) else v
        for k, v in dataclasses.asdict(model).items()
    }
    path.write_text(json.dumps({"made_by": "python -m research.vertical_force", **content}) + "\n", encoding="utf-8")


def degraded(model: stage.VerticalModel, person: Person, noise: stage.Noise, rng: np.random.Generator) -> np.ndarray:
    """Return of 12 steps of a person at nearly one speed: the true force, what a phone's motion would need, the mean of
    the posterior and its standard deviation (4, N). The error is as `ERROR_MEMORY_S` has it."""
    if len(person.speed) == 1:
        chosen = np.zeros(12, int)
    else:
        chosen = np.argsort(np.abs(person.speed - rng.choice(person.speed)))[:12]
    n_double, n_single = 14, 46
    n = 12 * (n_double + n_single)
    inside = np.arange(n) % (n_double + n_single)
    stands = np.stack([np.ones(n, bool), inside < n_double], axis=1)
    phase = stage.support_phase(stands)
    step = np.arange(n) // (n_double + n_single)
    true = np.array([np.interp(p, PHASE, person.force[chosen[k]]) for p, k in zip(phase, step, strict=True)])
    error = gaussian_filter1d(rng.standard_normal(n), GRID_HZ * ERROR_MEMORY_S / np.sqrt(2.0))
    smoothed = gaussian_filter1d(true, GRID_HZ * noise.smoothing_s)
    needed = 1.0 + noise.gain * (smoothed - 1.0) + noise.sd * error / error.std()
    found = stage.vertical_force(needed, stands, float(person.speed[chosen].mean()), model, noise)
    sd = np.std([found.draw(rng) for _ in range(20)], axis=0)
    return np.stack([true, needed, found.mean, sd])


def report(model: stage.VerticalModel, people: list[Person]) -> None:
    """Print errors on both groups of persons, those of a tuning person by the model of the others, and what remains of
    forces unlike those of healthy people."""
    models = {p.name: fitted([q for q in people if q.tuning and q is not p]) for p in people}
    for points, noise in model.noise.items():
        click.echo(
            f"\n{points}: root mean square (% BW) as a phone's motion has it, of the model's mean, of the posterior;"
        )
        click.echo("share of times in the posterior's 90 % interval")
        for kind in ("adult", "child"):
            for tuning in (True, False):
                group = [p for p in people if p.tuning == tuning and p.name.startswith("adult") == (kind == "adult")]
                rng = np.random.default_rng(0)
                rows = [degraded(models[p.name], p, noise, rng) for p in group for _ in range(5)]
                off = [[r[i] - r[0] for i in (1, 2)] for r in rows]
                known = [f - models[p.name].expected(s) for p in group for f, s in zip(p.force, p.speed, strict=True)]
                rms = [
                    100.0 * np.sqrt(np.mean(np.square(v))) for v in ([o[0] for o in off], known, [o[1] for o in off])
                ]
                held = np.mean([np.abs(r[2] - r[0]) < Z90 * r[3] for r in rows])
                name = f"{kind}, {'tuning' if tuning else 'held out'} ({len(group)})"
                click.echo(f"  {name:24}" + "".join(f"{v:8.1f}" for v in rms) + f"{held:8.0%}")
    click.echo("\npart of a departure from the model's mean that remains, root mean square over time")
    usual = Person("", False, np.array([model.speed]), model.expected(model.speed)[None])
    single = np.where(PHASE >= 1.0, PHASE - 1.0, np.nan)
    departures = {
        "no change of force at all": 1.0 - usual.force,
        "loading peak 0.2 BW lower": -0.2 * np.nan_to_num(np.exp(-0.5 * ((single - 0.1) / 0.12) ** 2))[None],
        "push-off peak 0.2 BW lower": -0.2 * np.nan_to_num(np.exp(-0.5 * ((single - 0.85) / 0.12) ** 2))[None],
    }
    for points, noise in model.noise.items():
        for name, by in departures.items():
            true, found = [], []
            for force in (usual.force, usual.force + by):
                person = dataclasses.replace(usual, force=force)
                row = degraded(model, person, noise, np.random.default_rng(1))  # the same errors
                true.append(row[0])
                found.append(row[2])
            kept = np.sum((true[1] - true[0]) * (found[1] - found[0])) / np.sum((true[1] - true[0]) ** 2)
            click.echo(f"  {points:16}{name:32}{kept:6.0%}")


@click.command()
@click.option("--adults", "folder", type=click.Path(exists=True, path_type=Path), required=True)
@click.option("--write", "writes", is_flag=True, help="Write the model that ships.")
def main(folder: Path, writes: bool) -> None:
    """Fit the model on the tuning persons and print its errors on all."""
    if not FOLDER.is_dir():
        sys.exit(f"the recording is absent: {FOLDER}")
    people = adults(folder) + children()
    model = fitted([p for p in people if p.tuning])
    report(model, people)
    if writes:
        write(model, TARGET)


if __name__ == "__main__":
    main()
