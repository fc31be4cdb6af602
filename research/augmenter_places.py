"""Positions of the marker augmenter's 35 markers on our body: `python -m research.augmenter_places DATA`.

DATA is the folder of the development recordings. Recorded walks and squats of `real/motions` are put on the body, its
15 points are given to the network without error, and what it answers is expressed in the frames of the body's bones:
the mean of each person's means, left and right mirrored. Only persons whose angles are of an OpenSim model from markers
(`PERSONS`): other conventions have another pelvis, and OpenCap's own recordings were made with the network itself.
Beside each place stands how far single persons lie from it (standard deviation, mm). Nothing is drawn at random.

So the table holds what the network means by a marker on this body and not what a palpating hand would find: with it a
fit to the network's markers has no constant pull where the points are right.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.body import body_poses, load_body, marker_positions, marker_set
from pbl_pipeline.keypoints import MarkerAugmenter
from research.corpus.motions import Motion, read_motions
from research.paths import PACKAGE

TABLE = PACKAGE / "body" / "data" / "markers_opencap_35.csv"
#: Beginnings of the index's names.
PERSONS = ("Camargo2021", "Kirsten DLS01", "GaitDynamics", "Falisse2019", "Dembia2017")
#: Part of a marker's name -> its bone.
_BONES = {"SIS": "pelvis", "HJC": "pelvis", "knee": "femur", "thigh": "femur", "ankle": "tibia", "_sh": "tibia"}
_BONES |= {"toe": "calcn", "5meta": "calcn", "calc": "calcn", "C7": "torso"}
#: Longest part of a recording that counts (s).
_LONGEST_S = 8.0
_HEAD = """\
# opencap_35: the 35 markers of OpenCap's marker augmenter 0.3 (`l_` for its L)
# source: `python -m research.augmenter_places`: recorded walks and squats of {n} persons of other laboratories put on
# this body, its 15 points given to the network, the answers in the frames of the bones; left and right are mirror
# images (z). Positions as the network defines them, not palpated ones. No detector sees these points
# metres, in the body's frame (x forward, y up, z right); sd_mm: between the persons, along x, y and z
# also: the name that OpenCap and Pose2Sim write
name,body,x,y,z,sd_mm,also
"""


def bone_of(marker: str) -> str:
    """ "l_knee" -> "femur_l"."""
    bone = "torso" if "shoulder" in marker else next(b for part, b in _BONES.items() if part in marker)
    return bone if bone in ("pelvis", "torso") else f"{bone}_{marker[0]}"


def written(marker: str) -> str:
    """ "l_knee" -> "L_knee_study", as OpenCap and Pose2Sim spell it."""
    side, _, part = marker.rpartition("_")
    if part == "HJC":
        return f"{side.upper()}HJC_study"
    joint = "." if "SIS" in part else "_"
    return f"{side.replace('l', 'L')}{joint if side else ''}{part}_study"


def mirrored(marker: str) -> str:
    """The same marker on the left; C7 is its own."""
    return marker if marker == "C7" else "l" + marker[1:]


def places(motions: Iterable[Motion], augmenter: MarkerAugmenter) -> dict[str, np.ndarray]:
    """Marker -> (persons, 3) places in its bone's frame (m)."""
    body, points = load_body(), marker_set("halpe_26")
    seen = [points.names.index(n) for n in augmenter.points]
    bones = [body.body_names.index(bone_of(n)) for n in augmenter.markers]
    of_person: dict[str, list[np.ndarray]] = defaultdict(list)
    for motion in motions:
        rows = motion.time_s <= motion.time_s[0] + _LONGEST_S
        qpos = np.asarray(motion.qpos)[rows]
        x = np.asarray(marker_positions(body, points, qpos, np.ones(8), np.zeros((len(points), 3))))[:, seen]
        found = augmenter(np.asarray(motion.time_s)[rows], x).xyz_world_m
        position, rotation = (np.asarray(a)[:, bones] for a in body_poses(body, qpos, np.ones(8)))
        local = np.einsum("tpji,tpj->tpi", rotation, found - position)
        of_person[motion.person].append(np.nanmean(local, axis=0))
    persons = np.array([np.mean(each, axis=0) for each in of_person.values()])
    return {n: persons[:, i] for i, n in enumerate(augmenter.markers)}


def table(found: dict[str, np.ndarray]) -> str:
    """The marker table, in the network's order."""
    lines = [_HEAD.format(n=len(found["C7"]))]
    for name in found:
        left = name.startswith("l_")
        right = name if not left else next(n for n in found if mirrored(n) == name)
        both = (found[right] + found[mirrored(right)] * [1, 1, -1]) / 2
        side = [1, 1, -1] if left else [1, 1, 1]
        place, sd = both.mean(axis=0) * side, 1000 * both.std(axis=0, ddof=1)
        numbers = ",".join(f"{v + 0.0:.3f}" for v in np.round(place, 3))
        lines.append(f"{name},{bone_of(name)},{numbers},{' '.join(f'{s:.0f}' for s in sd)},{written(name)}\n")
    return "".join(lines)


@click.command()
@click.argument("data", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", type=click.Path(path_type=Path), default=TABLE, show_default=True, help="Table to write.")
def main(data: Path, out: Path) -> None:
    """Measure the places and write the table of the marker set."""
    motions = [m for m in read_motions(data / "real" / "motions", ("walk", "squat")) if m.person.startswith(PERSONS)]
    for person in sorted({m.person for m in motions}):
        click.echo(f"{person}: {sum(m.person == person for m in motions)} recordings")
    out.write_text(table(places(motions, MarkerAugmenter())), encoding="utf-8")
    click.echo(out)


if __name__ == "__main__":
    main()
