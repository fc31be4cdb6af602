#!/usr/bin/env bash
# pyomeca cannot read the motions that OpenSim's inverse kinematics writes.
#
# Seen 2026-11-28: opensim 4.6, pyomeca 2026.0.2.
# Behaviour: OpenSim writes empty lines into the header of a .mot file and accepts them. pyomeca, whose from_mot and
#   from_sto are for these files, looks at the first cell of every line of the header and raises at an empty one, before
#   it comes to the data. Without the empty lines it reads the file.
# Matters: a .mot for other programs should have no empty line in its header; a reader should accept them.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install opensim==4.6 pyomeca==2026.0.2 numpy==2.4.6 pandas==3.1.1 xarray==2026.9.0
observe venv <<'PY'
import os
import opensim, pyomeca

opensim.Logger.setLevelString("Off")
model = opensim.Model()
body = opensim.Body("body", 1, opensim.Vec3(0), opensim.Inertia(1))
model.addBody(body)
model.addJoint(opensim.FreeJoint("free", model.getGround(), body))
places = {"A": (0, 0, 0), "B": (0.1, 0, 0), "C": (0, 0.1, 0)}
for name, place in places.items():
    model.addMarker(opensim.Marker(name, body, opensim.Vec3(*place)))
model.finalizeConnections()
with open("walk.trc", "w") as file:
    file.write(
        "PathFileType\t4\t(X/Y/Z)\twalk.trc\n"
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
        "100\t100\t3\t3\tm\t100\t1\t3\n"
        "Frame#\tTime\tA\t\t\tB\t\t\tC\t\t\n"
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\tX3\tY3\tZ3\n\n"
    )
    for i in range(3):
        cells = [f"{v + 0.01 * i * (k == 0):.3f}" for place in places.values() for k, v in enumerate(place)]
        file.write("\t".join([str(i + 1), f"{i / 100:.2f}", *cells]) + "\n")
tool = opensim.InverseKinematicsTool()
tool.setModel(model)
tool.setMarkerDataFileName("walk.trc")
tool.setStartTime(0)
tool.setEndTime(0.02)
tool.setOutputMotionFileName("walk.mot")
printed = os.dup(1)
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the tool lists the parts of its model
tool.run()
os.dup2(printed, 1)

def by_pyomeca(path):
    try:
        return f"{pyomeca.Analogs.from_mot(path, pandas_kwargs={'sep': chr(9)}).shape} values"
    except Exception as error:
        return type(error).__name__

with open("walk.mot") as file:
    header, _, data = file.read().partition("endheader")
lines = header.splitlines()
with open("close.mot", "w") as file:
    file.write("\n".join(line for line in lines if line) + "\nendheader" + data)
print("empty lines in the header:", sum(not line for line in lines))
for path in ("walk.mot", "close.mot"):
    print(f"{path}: opensim {opensim.TimeSeriesTable(path).getNumRows()} rows, pyomeca {by_pyomeca(path)}")
PY
expect <<'SEEN'
empty lines in the header: 2
walk.mot: opensim 3 rows, pyomeca IndexError
close.mot: opensim 3 rows, pyomeca (6, 3) values
SEEN
