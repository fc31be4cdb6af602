#!/usr/bin/env bash
# A C3D file that ezc3d has read and written again is refused by c3d if its scale was not -1.
#
# Seen 2026-11-28: ezc3d 1.7.2, c3d 0.6.0.
# Behaviour: a C3D states the scale of its points twice, in the header and as POINT:SCALE. ezc3d keeps the parameter and
#   always writes -1 into the header. The coordinates are floats, so both scales lead to the same numbers, but c3d
#   compares the two and raises.
# Matters: recordings of laboratories have scales such as -0.01. One that was cut or relabelled with ezc3d (or a package
#   built on it) cannot be opened with c3d; ezc3d itself reads it.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install ezc3d==1.7.2 c3d==0.6.0 numpy==2.4.6
observe venv <<'PY'
import struct
import c3d, ezc3d, numpy as np

def header_scale(path):
    with open(path, "rb") as file:
        return round(struct.unpack("<f", file.read(16)[12:])[0], 4)

def by_c3d(path):
    with open(path, "rb") as file:
        try:
            reader = c3d.Reader(file)
            return [points[0, :3].tolist() for _, points, _ in reader.read_frames()][1]
        except Exception as error:
            return f"{type(error).__name__}"

def by_ezc3d(path):
    return ezc3d.c3d(path)["data"]["points"][:3, 0, 1].tolist()

writer = c3d.Writer(point_rate=100.0, point_scale=-0.01)
writer.set_point_labels(["LHEE", "LTOE"])
writer.add_frames([(np.array([[i, 2.0, 3, 0, 0], [4, 5, 6, 0, 0]]), np.zeros((0, 0))) for i in range(5)])
with open("first.c3d", "wb") as file:
    writer.write(file)
ezc3d.c3d("first.c3d").write("again.c3d")
for path in ("first.c3d", "again.c3d"):
    parameter = round(float(ezc3d.c3d(path)["parameters"]["POINT"]["SCALE"]["value"][0]), 4)
    print(f"{path}: header {header_scale(path)}, POINT:SCALE {parameter}; c3d {by_c3d(path)}, ezc3d {by_ezc3d(path)}")
PY
expect <<'SEEN'
first.c3d: header -0.01, POINT:SCALE -0.01; c3d [1.0, 2.0, 3.0], ezc3d [1.0, 2.0, 3.0]
again.c3d: header -1.0, POINT:SCALE -0.01; c3d AssertionError, ezc3d [1.0, 2.0, 3.0]
SEEN
