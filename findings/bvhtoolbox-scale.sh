#!/usr/bin/env bash
# bvhtoolbox's conversion of a BVH from cm to m multiplies a joint by the scale once for each joint above it.
#
# Seen 2026-11-30: bvhtoolbox 0.1.3, numpy 1.26.4, transforms3d 0.4.2, scipy 1.17.1.
# Behaviour: `bvh2csv --scale` (`write_joint_positions(scale=...)`) scales the position of a joint, and goes on from that to the
#   next one with its offset in the old unit, and scales the sum. A pelvis 0.9 m above the floor stays there; of this
#   height 9 mm arrive at the hip and 0.09 mm at the knee: the legs lie around the origin. Without a scale all is right.
#   The way back (`csv2bvh_string(scale=...)`) scales the root's positions and leaves the offsets of the skeleton; the command
#   `csv2bvh --scale` scales nothing.
#   `get_rotation_matrices`, `get_quaternions` and `get_affines` without `axes` take the angles about z, x, y for turns about
#   z, x, z, whatever channels the joint has; with `axes="r" + channels` they are right.
# Matters: the package states `--scale` as its way to change units. Joint positions are what gait measures come from.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install bvhtoolbox==0.1.3 numpy==1.26.4 transforms3d==0.4.2 scipy==1.17.1
observe venv <<'PY'
import csv

import bvhtoolbox
import numpy as np
from bvhtoolbox.convert.bvh2csv import write_joint_positions, write_joint_rotations
from bvhtoolbox.convert.csv2bvh import csv2bvh_string, main
from scipy.spatial.transform import Rotation

JOINTS = {"pelvis": (0, 0, 0), "hip": (-9, 0, 0), "knee": (0, -40, 0), "ankle": (0, -42, 0)}  # offsets in cm
FRAMES = 10


def write(order):
    """A chain of four joints in motion as a BVH; its positions in cm."""
    channels = " ".join(f"{axis}rotation" for axis in order)
    lines = ["HIERARCHY"]
    for name, offset in JOINTS.items():
        kind, position = ("JOINT", "3") if name != "pelvis" else ("ROOT", "6 Xposition Yposition Zposition")
        lines += [f"{kind} {name}", "{", "OFFSET {} {} {}".format(*offset), f"CHANNELS {position} {channels}"]
    lines += ["End Site", "{", "OFFSET 0 -5 15", "}", *"}" * len(JOINTS), "MOTION", f"Frames: {FRAMES}", "Frame Time: 0.02"]
    angles = np.random.default_rng(0).uniform(-40, 40, (FRAMES, len(JOINTS), 3)).round(3)
    walk = np.array([[2 * i, 90, 0] for i in range(FRAMES)])
    lines += [" ".join(map(str, (*position, *row.ravel()))) for position, row in zip(walk, angles)]
    with open("walk.bvh", "w") as file:
        file.write("\n".join(lines) + "\n")
    place, turn, places = walk, None, []
    for i, offset in enumerate(JOINTS.values()):
        own = Rotation.from_euler(order, angles[:, i], degrees=True)
        place = place if turn is None else place + turn.apply(offset)
        turn = own if turn is None else turn * own
        places.append(place)
    return np.stack(places, axis=1), angles


def tree():
    with open("walk.bvh") as file:
        return bvhtoolbox.BvhTree(file.read())


for order in ("ZXY", "XYZ"):
    true, angles = write(order)
    for scale in (1.0, 0.01, 10.0):
        write_joint_positions(tree(), "positions.csv", scale)
        found = np.loadtxt("positions.csv", delimiter=",", skiprows=1)[:, 1:].reshape(true.shape) / scale
        off = dict(zip(JOINTS, np.linalg.norm(found - true, axis=2).max(axis=0)))
        print(f"{order}, scale {scale}: off by up to", ", ".join(f"{joint} {cm:.0f} cm" for joint, cm in off.items()))
    hip = Rotation.from_euler(order, angles[:, 1], degrees=True)
    for axes in ({}, {"axes": "r" + order.lower()}):
        turns = Rotation.from_matrix(bvhtoolbox.get_rotation_matrices(tree(), "hip", **axes))
        print(f"{order}, rotations of the hip {axes or 'without axes'}:",
              f"{np.degrees((turns * hip.inv()).magnitude()).max():.0f} deg off")

true, angles = write("ZXY")
write_joint_positions(tree(), "positions.csv", 1.0)
write_joint_rotations(tree(), "rotations.csv")
with open("hierarchy.csv", "w", newline="") as file:
    rows = csv.writer(file)
    rows.writerow(("joint", "parent", "offset.x", "offset.y", "offset.z"))
    parent = ""
    for name, offset in (*JOINTS.items(), ("ankle_End", (0, -5, 15))):
        rows.writerow((name, parent, *(f"{cm:.5f}" for cm in offset)))
        parent = name
files = ("hierarchy.csv", "positions.csv", "rotations.csv")


def report(case, text):
    back = bvhtoolbox.BvhTree(text)
    print(f"{case}: pelvis at {back.frame_joint_channel(0, 'pelvis', 'Yposition'):g}, thigh of {-back.joint_offset('knee')[1]:g}")


report("csv2bvh_string without a scale", csv2bvh_string(*files))
report("csv2bvh_string(scale=0.01)", csv2bvh_string(*files, scale=0.01))
main(["--scale", "0.01", "--out", "./back.bvh", *files])
with open("back.bvh") as file:
    report("csv2bvh --scale 0.01", file.read())
PY
expect <<'SEEN'
ZXY, scale 1.0: off by up to pelvis 0 cm, hip 0 cm, knee 0 cm, ankle 0 cm
ZXY, scale 0.01: off by up to pelvis 0 cm, hip 91 cm, knee 96 cm, ankle 94 cm
ZXY, scale 10.0: off by up to pelvis 0 cm, hip 826 cm, knee 9117 cm, ankle 91920 cm
ZXY, rotations of the hip without axes: 55 deg off
ZXY, rotations of the hip {'axes': 'rzxy'}: 0 deg off
XYZ, scale 1.0: off by up to pelvis 0 cm, hip 0 cm, knee 0 cm, ankle 0 cm
XYZ, scale 0.01: off by up to pelvis 0 cm, hip 91 cm, knee 96 cm, ankle 99 cm
XYZ, scale 10.0: off by up to pelvis 0 cm, hip 826 cm, knee 9077 cm, ankle 91560 cm
XYZ, rotations of the hip without axes: 53 deg off
XYZ, rotations of the hip {'axes': 'rxyz'}: 0 deg off
csv2bvh_string without a scale: pelvis at 90, thigh of 40
csv2bvh_string(scale=0.01): pelvis at 0.9, thigh of 40
csv2bvh --scale 0.01: pelvis at 90, thigh of 40
SEEN
