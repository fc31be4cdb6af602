"""The pose prior of the fit: postures of people who walk, squat, stand up and lift, recorded by other laboratories.

    python -m research.poses ../shared/data/real/motions
    python -m research.poses ../shared/data/real/motions --everybody --out all.json

A mixture of two normal distributions over the joints of pelvis, lumbar spine and legs, the pelvis against the vertical
(`joint_terms.posture`). The covariance of each is that within a recording (around the person's own mean, by expectation
maximisation, because no laboratory measured all joints) plus that between people, which so few of them cannot tell and
which is set by anatomy: a pelvis that is tilted stands under an upright trunk and over upright legs, and who walks with
bent knees bends hips and ankles by half as much, on both sides. Means are round figures near those of recorded walks;
they and how differently bent people walk were chosen on the persons of `research.corpus` who are not held out. Left
and right are alike: every recording counts once as it is and once mirrored, and who squats or sits bends both hips and
knees together (hips of two persons who squat: 0.4 and 1.4 deg apart in the mean), also in the postures that stand
beside the recorded ones. The spine of the LBMC recordings is another joint than the body's and counts as unknown.
Persons whom `research.corpus` holds out are left out.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import click
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import PELVIS_TURNS, load_body
from pbl_pipeline.fit.joint_terms import rises
from pbl_pipeline.fit.priors import DATA
from research.corpus.motions import Motion, read_motions
from research.corpus.walks import is_held_out

MIDDLE = ("pelvis_tilt", "pelvis_list", "lumbar_extension", "lumbar_bending", "lumbar_rotation")
SIDED = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle")
JOINTS = (*MIDDLE, *(f"{name}_{side}" for name in SIDED for side in "rl"))
#: Joints whose sign turns in a mirror.
ODD = ("pelvis_list", "lumbar_bending", "lumbar_rotation")
#: Frames that are taken of a recording.
FRAMES = 60
#: Spines that these persons' recordings do not have.
OTHER_SPINE = "LBMC"
#: Standard deviations (deg) between people of the joints of `MIDDLE` and `SIDED`, without what goes with the tilt.
BETWEEN_DEG = (0, 2, 7, 3, 3, 5, 4, 8, 6, 5, 6)


class Component(NamedTuple):
    """A component of the mixture. `sd_deg` and `mean_deg`: a value for each of `MIDDLE` and `SIDED`."""

    weight: float
    activities: tuple[str, ...]
    #: Recordings of independent joints that stand beside the recorded ones, their standard deviations, and how far a
    #: joint of `SIDED` in them is correlated with that of the other side.
    pseudo: float
    sd_deg: tuple[float, ...]
    alike: tuple[float, ...]
    mean_deg: tuple[float, ...]
    #: Between people: standard deviation of the tilt (deg), how far hips and lumbar spine go with it, and how large the
    #: other joints' are against `BETWEEN_DEG`.
    tilt_sd_deg: float
    hips: float
    lumbar: float
    factor: float
    #: Between people: standard deviation (deg) of how bent both knees are, thighs and shanks leaning alike.
    bent_sd_deg: float


COMPONENTS = (
    Component(
        weight=0.6,
        activities=("walk",),
        pseudo=1.0,
        sd_deg=(2, 3, 3, 5, 5, 14, 5, 5, 19, 9, 6),
        alike=(0, 0, 0, 0, 0, 0),
        mean_deg=(0, 0, -7, 0, 0, 7, 0, 0, -22, 3, 0),
        tilt_sd_deg=7.0,
        hips=-1.0,
        lumbar=-0.7,
        factor=1.0,
        bent_sd_deg=8.0,
    ),
    Component(
        weight=0.4,
        activities=("squat", "sit_to_stand", "lift"),
        pseudo=1.5,
        sd_deg=(10, 3, 12, 5, 5, 30, 5, 5, 35, 9, 6),
        alike=(0.97, 0.7, 0, 0.9, 0, 0),
        mean_deg=(0, 0, -7, 0, 0, 30, 0, 0, -40, 5, 0),
        tilt_sd_deg=15.0,
        hips=-1.0,
        lumbar=-0.4,
        factor=1.5,
        bent_sd_deg=0.0,
    ),
)


def of_joints(values: Collection[float]) -> np.ndarray:
    """One value per joint of `JOINTS` from one per name of `MIDDLE` and `SIDED`."""
    middle, sided = np.split(np.asarray(list(values), float), [len(MIDDLE)])
    return np.concatenate([middle, np.repeat(sided, 2)])


def postures_deg(motion: Motion) -> Float[np.ndarray, "T J"]:
    """Joints of a recording, the pelvis against the vertical; NaN where they were not recorded."""
    names = list(load_body().joint_names)
    q, known = motion.qpos.copy(), motion.known.copy()
    pelvis = [names.index(n) for n in PELVIS_TURNS]
    q[:, pelvis[:2]] = np.arcsin(rises(jnp.asarray(q[:, pelvis])))
    if motion.person.startswith(OTHER_SPINE):
        known[[names.index(n) for n in MIDDLE if n.startswith("lumbar")]] = False
    index = [names.index(n) for n in JOINTS]
    step = max(1, len(q) // FRAMES)
    return np.degrees(np.where(known, q, np.nan)[::step, index])


def mirrored(x: Float[np.ndarray, "T J"]) -> Float[np.ndarray, "T J"]:
    """The same postures in a mirror."""
    other = {"_r": "_l", "_l": "_r"}
    order = [JOINTS.index(n[:-2] + other[n[-2:]]) if n[-2:] in other else i for i, n in enumerate(JOINTS)]
    return x[:, order] * np.where(np.isin(JOINTS, ODD), -1.0, 1.0)


def recordings(motions: Collection[Motion], activities: Collection[str]) -> Mapping[tuple[str, str], np.ndarray]:
    """Postures (deg) of each person in each activity, with those in a mirror."""
    out: dict[tuple[str, str], list[np.ndarray]] = {}
    for m in motions:
        if m.activity in activities:
            out.setdefault((m.person, m.activity), []).append(postures_deg(m))
    return {k: np.concatenate([x := np.concatenate(v), mirrored(x)]) for k, v in out.items()}


def covariance_beside(c: Component) -> Float[np.ndarray, "J J"]:
    """Covariance (deg^2) of the recordings that stand beside the recorded ones."""
    sd, correlation = of_joints(c.sd_deg), np.eye(len(JOINTS))
    for name, alike in zip(SIDED, c.alike, strict=True):
        right, left = (JOINTS.index(f"{name}_{side}") for side in "rl")
        correlation[right, left] = correlation[left, right] = alike
    return correlation * np.outer(sd, sd)


def covariance_within(
    groups: Collection[np.ndarray], beside: np.ndarray, pseudo: float, rounds: int = 60
) -> Float[np.ndarray, "J J"]:
    """Covariance (deg^2) around each group's own mean, joints that were not recorded filled in by what the others tell
    of them; each group counts as one and `pseudo` groups of the covariance `beside` stand beside them."""
    S = beside
    for _ in range(rounds):
        total = pseudo * beside
        for x in groups:
            x = x - x.mean(axis=0)
            seen = np.isfinite(x[0])
            gain = S[np.ix_(~seen, seen)] @ np.linalg.inv(S[np.ix_(seen, seen)])
            full = np.where(seen, x, 0.0)
            full[:, ~seen] = x[:, seen] @ gain.T
            total = total + full.T @ full / len(x)
            total[np.ix_(~seen, ~seen)] += S[np.ix_(~seen, ~seen)] - gain @ S[np.ix_(seen, ~seen)]
        S = total / (len(groups) + pseudo)
    return S


def covariance_between(c: Component) -> Float[np.ndarray, "J J"]:
    """Covariance (deg^2) of people's own means."""
    ways = (
        (c.tilt_sd_deg, of_joints([1, 0, c.lumbar, 0, 0, c.hips, *[0] * 5])),
        (c.bent_sd_deg, of_joints([*[0] * 5, 0.5, 0, 0, -1, 0.5, 0])),
    )
    return np.diag((c.factor * of_joints(BETWEEN_DEG)) ** 2) + sum(sd**2 * np.outer(way, way) for sd, way in ways)


def learn(motions: Collection[Motion]) -> dict:
    """The mixture, as the file has it."""
    components = []
    for c in COMPONENTS:
        groups, mean = recordings(motions, c.activities), of_joints(c.mean_deg)
        S = covariance_within(list(groups.values()), covariance_beside(c), c.pseudo) + covariance_between(c)
        components.append(
            {"weight": c.weight, "mean_deg": mean.round(3).tolist(), "covariance_deg2": S.round(3).tolist()}
        )
    used = {a for c in COMPONENTS for a in c.activities}
    return {
        "persons": sorted({m.person for m in motions if m.activity in used}),
        "sources": sorted({m.source for m in motions if m.activity in used}),
        "joints": list(JOINTS),
        "components": components,
    }


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--everybody", is_flag=True, help="Also the persons who are held out.")
@click.option("--out", type=click.Path(path_type=Path), default=DATA / "people-3.json", help="Else the shipped.")
def main(folder: Path, everybody: bool, out: Path) -> None:
    motions = [m for m in read_motions(folder) if everybody or not is_held_out(m.person)]
    prior = learn(motions)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(prior, separators=(",", ":")).replace('],"', '],\n"').replace("],[", "],\n[") + "\n")
    click.echo(f"{out}: {len(prior['persons'])} persons")


if __name__ == "__main__":
    main()
