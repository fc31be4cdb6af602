#!/usr/bin/env bash
# OpenSim's table reader refuses a TRC file in which the last marker is missing in a frame; other markers may be.
#
# Seen 2026-11-28: opensim 4.6.
# Behaviour: a missing marker is three empty cells. TimeSeriesTableVec3 reads them as NaN anywhere but at the end of a
#   line, where it counts one cell less and raises; with one more tab it reads them. OpenSim's other reader, MarkerData
#   (inverse kinematics, scaling), accepts both.
# Matters: whether a recording can be read depends on the order of its markers. Write a tab after a row that ends with
#   a missing marker.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install opensim==4.6 numpy==2.4.6
observe venv <<'PY'
import opensim

opensim.Logger.setLevelString("Off")
HEAD = (
    "PathFileType\t4\t(X/Y/Z)\twalk.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "100\t100\t2\t2\tmm\t100\t1\t2\n"
    "Frame#\tTime\tLHEE\t\t\tLTOE\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
    "1\t0.00\t1\t2\t3\t4\t5\t6\n"
)

def read(reader):
    try:
        return reader()
    except Exception as error:
        return type(error).__name__

def table():
    row = opensim.TimeSeriesTableVec3("walk.trc").getRowAtIndex(1)
    return " ".join(str(row.getElt(0, k)) for k in (0, 1))

def marker_data():
    data = opensim.MarkerData("walk.trc")  # owns the frame
    frame = data.getFrame(1)
    return " ".join(str(frame.getMarker(k)) for k in (0, 1))

for name, row in {
    "first missing": "2\t0.01\t\t\t\t4\t5\t6",
    "last missing": "2\t0.01\t1\t2\t3\t\t\t",
    "last missing, one more tab": "2\t0.01\t1\t2\t3\t\t\t\t",
}.items():
    with open("walk.trc", "w") as file:
        file.write(HEAD + row + "\n")
    print(f"{name}: table {read(table)} | MarkerData {read(marker_data)}")
PY
expect <<'SEEN'
first missing: table ~[nan,nan,nan] ~[4,5,6] | MarkerData ~[nan,nan,nan] ~[4,5,6]
last missing: table RuntimeError | MarkerData ~[1,2,3] ~[nan,nan,nan]
last missing, one more tab: table ~[1,2,3] ~[nan,nan,nan] | MarkerData ~[1,2,3] ~[nan,nan,nan]
SEEN
