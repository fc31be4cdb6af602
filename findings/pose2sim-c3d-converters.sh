#!/usr/bin/env bash
# Pose2Sim's converters between TRC and C3D are wrong in units by a thousand, in rates, and about missing markers.
#
# Seen 2026-11-29: pose2sim 0.10.49, c3d 0.6.0, ezc3d 1.7.2, numpy 2.4.6.
# Behaviour: `trc_to_c3d` takes every TRC for metres, and writes whole millimetres of 16 bits: of a TRC in mm the numbers
#   wrap around. It rounds 59.94 Hz to 60. `c3d_to_trc` writes metres of a C3D in mm and states mm; it cuts 59.94 Hz
#   to 59, by which it computes the times, and writes markers that are missing as seen at the origin. No error.
# Matters: OpenSim's and our TRC are in mm, laboratories' C3D are; a gap that becomes the origin pulls a body there.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install --no-deps pose2sim==0.10.49
install c3d==0.6.0 ezc3d==1.7.2 numpy==2.4.6
observe venv <<'PY'
import contextlib
import io

import ezc3d
import numpy as np
from Pose2Sim.Utilities.c3d_to_trc import c3d_to_trc_func
from Pose2Sim.Utilities.trc_to_c3d import trc_to_c3d_func


def convert(how, name):
    with contextlib.redirect_stdout(io.StringIO()):
        how(name)


for unit, height in (("m", 1.2345), ("mm", 1234.5)):
    lines = ["PathFileType\t4\t(X/Y/Z)\twalk.trc"]
    lines.append("DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames")
    lines.append(f"59.94\t59.94\t600\t2\t{unit}\t59.94\t1\t600")
    lines += ["Frame#\tTime\thead\t\t\thip\t\t", "\t\tX1\tY1\tZ1\tX2\tY2\tZ2", ""]
    lines += [f"{i + 1}\t{i / 59.94:.6f}\t0\t{height}\t0\t0\t{height / 2}\t0" for i in range(600)]
    with open("walk.trc", "w") as file:
        file.write("\n".join(lines) + "\n")
    convert(trc_to_c3d_func, "walk.trc")
    read = ezc3d.c3d("walk.c3d")
    point = read["parameters"]["POINT"]
    print(f"TRC at 59.94 Hz, {height} {unit}: C3D at {point['RATE']['value'][0]:g} Hz,",
          f"{read['data']['points'][1, 0, 0]:g} {point['UNITS']['value'][0]}")

for rate in (100.0, 59.94):
    made = ezc3d.c3d()
    point = made["parameters"]["POINT"]
    point["RATE"]["value"], point["LABELS"]["value"], point["UNITS"]["value"] = [rate], ["head", "hip"], ["mm"]
    points = np.ones((4, 2, 600))
    points[:3] = np.array([[0, 0], [0, 0], [1500, 750]])[:, :, None]
    points[:3, 0, :100] = np.nan
    made["data"]["points"] = points
    made.write("laboratory.c3d")
    convert(c3d_to_trc_func, "laboratory.c3d")
    with open("laboratory.trc") as file:
        lines = file.read().splitlines()
    rows = np.array([[float(cell or "nan") for cell in line.split("\t")] for line in lines[5:]])
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t")))
    print(f"C3D at {rate:g} Hz, 1500 mm: TRC at {header['DataRate']} Hz, {rows[-1, 4]:g} {header['Units']},",
          f"from {rows[0, 1]:.3f} to {rows[-1, 1]:.3f} s, missing marker at {rows[0, 2:5].tolist()}")
PY
expect <<'SEEN'
TRC at 59.94 Hz, 1.2345 m: C3D at 60 Hz, 1234 mm
TRC at 59.94 Hz, 1234.5 mm: C3D at 60 Hz, -10684 mm
C3D at 100 Hz, 1500 mm: TRC at 100 Hz, 1.5 mm, from 0.010 to 6.000 s, missing marker at [0.0, 0.0, 0.0]
C3D at 59.94 Hz, 1500 mm: TRC at 59 Hz, 1.5 mm, from 0.017 to 10.169 s, missing marker at [0.0, 0.0, 0.0]
SEEN
