#!/usr/bin/env bash
# trc-data-reader gives the positions of a marker to the one before it where that one is missing.
#
# Seen 2026-11-29: trc-data-reader 0.4.1, c3d 0.6.0.
# Behaviour: a TRC has one tab after each coordinate, and a marker that is missing in a frame has empty cells (Cortex,
#   Vicon, OpenSim). `TRCData.load` splits its lines at any white space: the empty cells vanish, the markers behind them
#   move up, and the last ones are NaN; `verbose=True` says nothing either. A marker that is written as nan is right.
# Matters: a heel that is hidden for a moment lies at the other heel, or at the pelvis, and events are found there.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install trc-data-reader==0.4.1 c3d==0.6.0 numpy==2.4.6
observe venv <<'PY'
from pathlib import Path

import trc

PLACES = {"LHEE": (100, 50, 120), "RHEE": (700, 60, -120), "SACR": (400, 950, 0)}


def read(case, missing, written):
    """Markers of the second of three frames, where `missing` is `written` as three cells."""
    axes = [f"{axis}{number}" for number in (1, 2, 3) for axis in "XYZ"]
    lines = [["PathFileType", "4", "(X/Y/Z)", "walk.trc"]]
    lines.append(["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"])
    lines[-1] += ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]
    lines.append(["100", "100", "3", "3", "mm", "100", "1", "3"])
    lines += [["Frame#", "Time", "LHEE", "", "", "RHEE", "", "", "SACR", "", ""], ["", "", *axes], []]
    for frame in (1, 2, 3):
        cells = [written if frame == 2 and name == missing else str(x) for name in PLACES for x in PLACES[name]]
        lines.append([str(frame), f"{(frame - 1) / 100:.2f}", *cells])
    Path("walk.trc").write_text("".join("\t".join(line) + "\n" for line in lines))
    data = trc.TRCData()
    data.load("walk.trc", verbose=True)
    print(f"{case}:", *(f"{name} {[round(x) if x == x else None for x in data[name][1]]}" for name in PLACES))


read("none missing", "", "")
read("LHEE as empty cells", "LHEE", "")
read("RHEE as empty cells", "RHEE", "")
read("LHEE as nan", "LHEE", "nan")
PY
expect <<'SEEN'
none missing: LHEE [100, 50, 120] RHEE [700, 60, -120] SACR [400, 950, 0]
LHEE as empty cells: LHEE [700, 60, -120] RHEE [400, 950, 0] SACR [None, None, None]
RHEE as empty cells: LHEE [100, 50, 120] RHEE [400, 950, 0] SACR [None, None, None]
LHEE as nan: LHEE [None, None, None] RHEE [700, 60, -120] SACR [400, 950, 0]
SEEN
