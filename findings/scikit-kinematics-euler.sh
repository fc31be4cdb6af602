#!/usr/bin/env bash
# scikit-kinematics reduces half of all orientations to a single Euler angle.
#
# Seen 2026-11-29: scikit-kinematics 0.10.4, numpy 2.4.6.
# Behaviour: `rotmat.sequence(R, to="Euler")` returns the three angles about z, x and z. A second angle that is
#   negative is treated as one near 0: the result is 0, 0 and one angle, whose matrix differs from R by the whole tilt.
#   The sequence `Fick` is right. No error or warning.
# Matters: the package reads the files of several worn sensors. A limb that tilts one way has angles, one that tilts the
#   other way has lost two of them.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install scikit-kinematics==0.10.4 numpy==2.4.6
observe venv <<'PY'
import numpy as np
from skinematics import rotmat


def matrix(angles, axes):
    made = np.eye(3)
    for axis, angle in zip(axes, angles, strict=True):
        made = made @ rotmat.R(axis, angle)
    return made


for made, axes, to in (
    ((10, 20, 30), "zxz", "Euler"),
    ((10, -20, 30), "zxz", "Euler"),
    ((10, 20, 30), "zyx", "Fick"),
    ((10, -20, 30), "zyx", "Fick"),
):
    R = matrix(made, axes)
    found = np.rad2deg(rotmat.sequence(R, to=to))
    turn = matrix(found, axes).T @ R
    apart = np.rad2deg(np.arccos(min(1.0, (np.trace(turn) - 1) / 2)))
    print(f"{to} of {made}:", *np.round(found, 1) + 0.0, f"{apart:.0f} degrees from it")
PY
expect <<'SEEN'
Euler of (10, 20, 30): 10.0 20.0 30.0 0 degrees from it
Euler of (10, -20, 30): 0.0 0.0 37.8 20 degrees from it
Fick of (10, 20, 30): 10.0 20.0 30.0 0 degrees from it
Fick of (10, -20, 30): 10.0 -20.0 30.0 0 degrees from it
SEEN
