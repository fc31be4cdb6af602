#!/usr/bin/env bash
# Pose2Sim's gait events are one frame early with its default method, and depend on the unit of the TRC with another.
#
# Seen 2026-11-30: pose2sim 0.10.49, numpy 2.4.6, scipy 1.17.1, pandas 3.1.1, matplotlib 3.11.2.
# Behaviour: `trc_gaitevents` drops the first frame before it filters ("height_coordinates", the default, and
#   "forward_velocity") and counts the events from there. Its threshold of velocity is in m/s for a TRC in m; for one in mm
#   it is multiplied by a thousand, and so are the positions: 1 mm/s remains. Contacts are not found, or 150 ms short at
#   each end.
# Matters: begin and end of a contact are 33 ms early at 30 frames a second, so that the time of stance hides it, and forces or
#   other sensors do not fit. TRC of OpenSim and our exports are in mm.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install --no-deps pose2sim==0.10.49
install numpy==2.4.6 scipy==1.17.1 pandas==3.1.1 matplotlib==3.11.2
observe venv <<'PY'
import contextlib
import io

import numpy as np

with contextlib.redirect_stdout(io.StringIO()):
    from Pose2Sim.Utilities.trc_gaitevents import trc_gaitevents_func


def toe(time, phase):
    """Forward position and height (m): 0.72 s on the ground, a swing of 0.48 s."""
    cycles = time / 1.2 + phase
    swing = np.clip((cycles % 1 - 0.6) / 0.4, 0, 1)
    forward = 1.4 * (np.floor(cycles) + swing - np.sin(2 * np.pi * swing) / (2 * np.pi))
    return forward, 0.02 + 0.14 * np.sin(np.pi * swing) ** 2


def write(rate, unit, factor):
    time = np.arange(10 * rate) / rate
    columns = [factor * x for phase, side in ((0, 0.1), (0.5, -0.1)) for x in (*toe(time, phase), np.full(len(time), side))]
    lines = ["PathFileType\t4\t(X/Y/Z)\twalk.trc"]
    lines.append("DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames")
    lines.append(f"{rate}\t{rate}\t{len(time)}\t2\t{unit}\t{rate}\t1\t{len(time)}")
    lines += ["Frame#\tTime\tRBigToe\t\t\tLBigToe\t\t", "\t\tX1\tY1\tZ1\tX2\tY2\tZ2", ""]
    rows = np.column_stack(columns)
    lines += [f"{i + 1}\t{t:.6f}\t" + "\t".join(f"{x:.6f}" for x in row) for i, (t, row) in enumerate(zip(time, rows))]
    with open("walk.trc", "w") as file:
        file.write("\n".join(lines) + "\n")
    return toe(time, 0)


for rate, unit, factor in ((30, "m", 1), (30, "mm", 1000), (120, "mm", 1000)):
    forward, height = write(rate, unit, factor)
    for method, low in (("height_coordinates", height < 0.06), ("forward_velocity", np.gradient(forward) * rate < 1)):
        on = np.flatnonzero(low[1:] & ~low[:-1]) + 1
        off = np.flatnonzero(low[:-1] & ~low[1:])
        name = f"{rate} Hz, {unit}, {method}"
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                _, found = trc_gaitevents_func(trc_path="walk.trc", method=method, plot=False, save_output=False)
        except IndexError as error:
            print(f"{name}: no contact found ({type(error).__name__})")
        else:
            early = [np.median([np.abs(true - f).min() * np.sign(f - true[np.abs(true - f).argmin()]) for f in got])
                     for true, got in ((on, found[0]), (off, found[2]))]
            print(f"{name}: right foot {early[0]:+.0f} frames at contact, {early[1]:+.0f} at the end of it")
PY
expect <<'SEEN'
30 Hz, m, height_coordinates: right foot -1 frames at contact, -1 at the end of it
30 Hz, m, forward_velocity: right foot +2 frames at contact, -4 at the end of it
30 Hz, mm, height_coordinates: right foot -1 frames at contact, -1 at the end of it
30 Hz, mm, forward_velocity: no contact found (IndexError)
120 Hz, mm, height_coordinates: right foot -1 frames at contact, -1 at the end of it
120 Hz, mm, forward_velocity: right foot +18 frames at contact, -20 at the end of it
SEEN
