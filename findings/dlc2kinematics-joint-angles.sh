#!/usr/bin/env bash
# dlc2kinematics takes the angle at the point that is second in the file, and those of a second walk from the first.
#
# Seen 2026-11-30: dlc2kinematics 0.0.7, pandas 2.3.3, numpy 1.24.4. A correction of the order, of 2023, is in its
#   repository and in no release.
# Behaviour: `compute_joint_angles` is given a joint as three points, the joint in the middle. It selects their columns
#   and keeps the order of the file: a file that lists ankle, hip and knee gets the angle at the hip as that of the knee.
#   By default the angles are saved in the current folder under the network's name, and read from there if the file
#   exists: a second walk gets the angles of the first, also with `save=False`; a printed line names the file. The default
#   `pcutoff` raises TypeError for 2D points, so None is passed.
# Matters: angles of a table with other columns, and of every walk but the first one of a loop, look like angles.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install dlc2kinematics==0.0.7 pandas==2.3.3 numpy==1.24.4
observe venv <<'PY'
import contextlib
import io
import os

import dlc2kinematics
import numpy as np
import pandas as pd

LEG = ["hip", "knee", "ankle"]
BENT = {"hip": (0, 0), "knee": (40, 400), "ankle": (-60, 780)}
MORE_BENT = BENT | {"ankle": (-300, 600)}


def at(middle, one, other):
    """Angle between the lines through three points, in degrees."""
    u, v = np.subtract(middle, one), np.subtract(other, middle)
    return np.degrees(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)))


def angle(points, order, joint, **keywords):
    """The angle of the first of three frames."""
    columns = pd.MultiIndex.from_product([["network"], order, ["x", "y", "likelihood"]],
                                         names=["scorer", "bodyparts", "coords"])
    table = pd.DataFrame([[value for name in order for value in (*points[name], 0.9)]] * 3, columns=columns)
    with contextlib.redirect_stdout(io.StringIO()):
        found = dlc2kinematics.compute_joint_angles(table, {"knee": joint}, pcutoff=None, **keywords)
    return found["knee"].iloc[0]


knee = at(BENT["knee"], BENT["hip"], BENT["ankle"])
hip = at(BENT["hip"], BENT["knee"], BENT["ankle"])
print(f"truth: {knee:.1f} deg at the knee, {hip:.1f} deg at the hip")
for order in (LEG, ["ankle", "hip", "knee"]):
    for joint in (LEG, LEG[::-1]):
        print(f"file of {', '.join(order)}; knee as {', '.join(joint)}: {angle(BENT, order, joint, save=False):.1f} deg")

print(f"first walk: {knee:.1f} deg, computed {angle(BENT, LEG, LEG):.1f}")
bent = at(MORE_BENT["knee"], MORE_BENT["hip"], MORE_BENT["ankle"])
print(f"second walk: {bent:.1f} deg, computed {angle(MORE_BENT, LEG, LEG):.1f},",
      f"with save=False {angle(MORE_BENT, LEG, LEG, save=False):.1f}")
os.remove("joint_angles_network.h5")
print(f"second walk without the file of the first: {angle(MORE_BENT, LEG, LEG):.1f}")
PY
expect <<'SEEN'
truth: 20.5 deg at the knee, 169.9 deg at the hip
file of hip, knee, ankle; knee as hip, knee, ankle: 20.5 deg
file of hip, knee, ankle; knee as ankle, knee, hip: 20.5 deg
file of ankle, hip, knee; knee as hip, knee, ankle: 169.9 deg
file of ankle, hip, knee; knee as ankle, knee, hip: 169.9 deg
first walk: 20.5 deg, computed 20.5
second walk: 65.2 deg, computed 20.5, with save=False 20.5
second walk without the file of the first: 65.2
SEEN
