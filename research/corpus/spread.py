"""`python -m research.corpus.spread MOTIONS`: spread between the cycles of a person, of gait measures and of forces.

Walks of recorded people as they were recorded (none repeated by strides), at the frame rate of a phone, without errors
of a detector. The sd of a person is that within a side of a walk, over all of their walks; that of people is the root
of the mean of the persons' variances (`gait.cycle_measures.CYCLE_SPREAD`, the column `cycle` of
`kinetics/measure_errors.csv`). Persons without two cycles of a side in one walk are left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
from scipy.interpolate import CubicSpline

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.gait.cycle_measures import MEASURES, cycle_measures
from pbl_pipeline.gait.events import SIDES
from pbl_pipeline.kinetics import MEASURES as FORCES
from pbl_pipeline.kinetics import METHODS, visit_kinetics
from research.corpus.motions import read_motions
from research.corpus.true_fit import fit_of_qpos
from research.corpus.walks import RATE_HZ, SECONDS, lasting

#: Sum of squares about the mean of a side, and its degrees of freedom, by measure.
Squares = dict[str, tuple[float, int]]


def walks_as_recorded(motions: Path) -> Iterator[tuple[str, TrialFit]]:
    """Yield person and motion of each walk; of a long one its straightest part."""
    for motion in read_motions(motions, ["walk"]):
        end = float(motion.time_s[-1])
        if motion.cycle:
            continue
        time = np.arange(0.0, min(end, SECONDS - 1.0 / RATE_HZ) + 1e-9, 1.0 / RATE_HZ)
        qpos = lasting(motion, time) if end >= SECONDS else CubicSpline(motion.time_s, motion.qpos)(time)
        if qpos is not None:
            yield (
                motion.person,
                dataclasses.replace(fit_of_qpos(motion.person, time, qpos), orientation_source="measured: phone"),
            )


def squares_of(fit: TrialFit) -> Squares:
    """Return the spread between the cycles of each side of a walk, in the mean of both."""
    gait = gait_metrics([fit])
    forces = visit_kinetics([fit], gait.trials, METHODS.find()).trials[0].cycles
    values = [
        (c.side, cycle_measures(c) | {"step_time_s": c.end_s - c.opposite_foot_down_s}) for c in gait.cycles if c.used
    ]
    values += [(c.side, c.measures) for c in forces if c.used]
    out: Squares = {}
    for name in (*MEASURES, *FORCES):
        sides = [np.array([m[name] for s, m in values if s == side and name in m]) for side in SIDES]
        out[name] = (
            float(sum(np.sum((v - v.mean()) ** 2) for v in sides if len(v))),
            sum(len(v) - 1 for v in sides if len(v)),
        )
    return out


@click.command(epilog="Example: python -m research.corpus.spread ../shared/data/real/motions")
@click.argument("motions", type=click.Path(path_type=Path, exists=True))
def main(motions: Path) -> None:
    """Print the spread between cycles of the people in MOTIONS."""
    people: dict[str, list[Squares]] = {}
    for person, fit in walks_as_recorded(motions):
        try:
            people.setdefault(person, []).append(squares_of(fit))
        except PblError as error:
            click.echo(f"{person}: {error.code}", err=True)
    click.echo(f"{'measure':42}{'persons':>9}{'sd':>10}{'10 %':>10}{'50 %':>10}{'90 %':>10}")
    for name in (*MEASURES, *FORCES):
        of_people = []
        for walks in people.values():
            known = [w[name] for w in walks if name in w]
            if freedom := sum(f for _, f in known):
                of_people.append(sum(s for s, _ in known) / freedom)
        if of_people:
            sd, parts = np.sqrt(np.mean(of_people)), np.sqrt(np.quantile(of_people, [0.1, 0.5, 0.9]))
            click.echo(f"{name:42}{len(of_people):9}{sd:10.4f}" + "".join(f"{p:10.4f}" for p in parts))


if __name__ == "__main__":
    main()
