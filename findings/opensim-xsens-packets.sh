#!/usr/bin/env bash
# OpenSim's reader of Xsens files pairs the rows of sensors by their place and ignores the packet counters.
#
# Seen 2026-11-29: opensim 4.6, numpy 2.4.6.
# Behaviour: two sensors turn together by 30 degrees a second, 100 samples a second. Where each of them has lost 20
#   packets, at other times, or where the file of one begins 20 packets later, XsensDataReader gives one table with rows a
#   hundredth of a second apart: in a row are orientations of moments 0.2 s apart, and after the loss all times are early.
#   The packet counters of the files say so; there is no warning. Files of unequal length or update rate it refuses.
# Matters: a radio that loses packets is usual with worn sensors; OpenSense then has joint angles between two moments.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install opensim==4.6 numpy==2.4.6
observe venv <<'PY'
from pathlib import Path

import numpy as np
import opensim

opensim.Logger.setLevelString("off")
MATRIX = [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]


def write(folder, sensor, packets):
    lines = ["// Start Time: Unknown", "// Update Rate: 100.0Hz", "// Filter Profile: human (46.1)"]
    lines += ["// Option Flags: AHS Disabled ICC Disabled", "// Firmware Version: 4.0.2"]
    lines.append("\t".join(["PacketCounter", "Acc_X", "Acc_Y", "Acc_Z", *MATRIX]))
    for packet in packets:
        c, s = np.cos(np.deg2rad(0.3 * packet)), np.sin(np.deg2rad(0.3 * packet))
        values = [0, 0, 9.81, c, s, 0, -s, c, 0, 0, 0, 1]
        lines.append("\t".join([f"{1000 + packet:05d}", *(f"{value:.6f}" for value in values)]))
    Path(folder, f"MT_{sensor}.txt").write_text("\n".join(lines) + "\n")


def seen(case, first, second):
    folder = Path(case)
    folder.mkdir()
    write(folder, "A", first)
    write(folder, "B", second)
    settings = opensim.XsensDataReaderSettings()
    settings.set_trial_prefix("MT")
    for sensor in "AB":
        settings.append_ExperimentalSensors(opensim.ExperimentalSensor(f"_{sensor}", f"{sensor}_imu"))
    reader = opensim.XsensDataReader(settings)
    try:
        tables = reader.read(f"{folder}/")
    except RuntimeError:
        print(f"{case}: refused")
        return
    table = reader.getOrientationsTable(tables)
    flat = table.flatten()
    matrix = flat.getMatrix()  # a view of `flat`
    q = matrix.to_numpy().reshape(table.getNumRows(), 2, 4)
    angles = np.rad2deg(2 * np.arctan2(q[:, :, 3], q[:, :, 0]))
    apart = np.abs(angles[:, 0] - angles[:, 1])
    print(f"{case}: {len(q)} rows, last at {table.getIndependentColumn()[-1]:.2f} s, at most {apart.max():.1f} degrees apart")


def without(lost):
    return [packet for packet in range(300) if packet not in lost]


seen("complete", range(300), range(300))
seen("each lost 20", without(range(200, 220)), without(range(100, 120)))
seen("one begins later", range(280), range(20, 300))
seen("one lost 20", range(300), without(range(100, 120)))
PY
expect <<'SEEN'
complete: 300 rows, last at 2.99 s, at most 0.0 degrees apart
each lost 20: 280 rows, last at 2.79 s, at most 6.0 degrees apart
one begins later: 280 rows, last at 2.79 s, at most 6.0 degrees apart
one lost 20: refused
SEEN
