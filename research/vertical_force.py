"""How the vertical force of walking varies between people, for `pbl_pipeline/kinetics/vertical.py`.

    python -m research.vertical_force --adults FOLDER            # print how well it does on persons held out
    python -m research.vertical_force --adults FOLDER --write    # also write the model that ships

Two sources, half of the persons of each held out:

- children: the walks of `research.benchmarks.kinetics` on two plates (mcgillmotionlab/biomechzoo, MIT);
- adults: 10 persons with 60 steps each at 0.7 to 2.2 m/s on a pressure plate (Pataky et al. 2008, J Biomech
  41:1987-1994), the files `ex_grf_subj*.npy` and `ex_grf_speeds.npy` that the Python package spm1d carries; FOLDER
  holds them. Only mean curves and their components are kept here. The plate's scale is unknown: each step is scaled so
  that its impulse carries the weight. Times of stance and double support at each speed, and the stature, which the files do not
  tell, are means of adults (Bovi et al. 2011, Gait Posture 33:6-13).
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.body import load_body, stature_m
from pbl_pipeline.kinetics import GRAVITY, contact_of, inverse_dynamics, segment_inertia, smooth_motion
from pbl_pipeline.kinetics import vertical as stage
from research.benchmarks.kinetics import FOLDER, TUNING, fit_walk, read_walk, steps_of

TARGET = Path(stage.__file__).with_name("vertical_models") / "vertical-force-1.json"
#: Phases of the model: middles of equal parts of double and of single support.
PHASE = np.concatenate([(np.arange(10) + 0.5) / 10, 1.0 + (np.arange(20) + 0.5) / 20])
#: Of adults at four speeds (statures a second): stance and first double support, fractions of the cycle.
BOVI = ((0.493, 0.698, 0.873, 1.154), (0.6536, 0.6267, 0.6171, 0.5913), (0.1529, 0.1279, 0.1190, 0.0947))
STATURE_M = 1.72
#: Adults on whom the model is fitted.
TUNING_ADULTS = (0, 2, 4, 6, 8)
N_COMPONENTS = 6
#: Chosen on tuning persons by the least error of the vertical force (docs/kinetics.md).
CHOSEN = {
    "step_sd": 0.04,
    "step_memory_s": 0.06,
    "noise_memory_s": 0.02,
    "noise": {"blazepose_33": (0.08, 0.85, 1.0), "bml_movi_87": (0.02, 1.0, 1.0)},
}


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
        centre = inverse_dynamics(body, fit.scale, segment_inertia(body, fit.scale), motion).centre_m
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
    values, vectors = np.linalg.eigh(np.transpose(own) @ own / (len(people) - 2))
    components = vectors[:, ::-1][:, :N_COMPONENTS] * np.sqrt(values[::-1][:N_COMPONENTS])
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


def write(model: stage.VerticalModel, path: Path) -> None:
    """Write the model that ships."""
    content = {
        k: np.round(v, 4).tolist() if isinstance(v, np.ndarray | float | tuple) else v
        for k, v in dataclasses.asdict(model).items()
    }
    path.write_text(json.dumps({"made_by": "python -m research.vertical_force", **content}) + "\n", encoding="utf-8")
