#!/usr/bin/env bash
# Pose2Sim's trc_rotate turns a person upside down by default, and trc_desample states a rate that the rows do not have.
#
# Seen 2026-11-30: pose2sim 0.10.49, numpy 2.4.6, pandas 3.1.1.
# Behaviour: without an axis `trc_rotate` turns about -X, "(Y-up -> Z-up)" as its documentation says in one line; heights
#   become -z. `trc_desample` keeps every second row to go from 60 to 25 Hz, so 30 Hz, and writes 25 Hz and 125 frames
#   above 150 rows; frames are counted from 0. A rate of 59.94 Hz is refused (ValueError).
# Matters: what takes the time from the rate, as OpenSim's and ours compare, is off by 17 %: speeds, cadence, filters.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install --no-deps pose2sim==0.10.49
install numpy==2.4.6 pandas==3.1.1
observe venv <<'PY'
import contextlib
import io

from Pose2Sim.Utilities.trc_desample import trc_desample_func
from Pose2Sim.Utilities.trc_rotate import trc_rotate_func


def write(rate):
    lines = ["PathFileType\t4\t(X/Y/Z)\twalk.trc"]
    lines.append("DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames")
    lines += [f"{rate}\t{rate}\t300\t1\tmm\t{rate}\t1\t300", "Frame#\tTime\thead\t\t", "\t\tX1\tY1\tZ1", ""]
    lines += [f"{i + 1}\t{i / rate:.6f}\t{1200 * i / rate:.3f}\t1700\t100" for i in range(300)]
    with open("walk.trc", "w") as file:
        file.write("\n".join(lines) + "\n")


def read(name):
    with open(name) as file:
        lines = file.read().splitlines()
    rows = [[float(x) for x in line.split("\t")] for line in lines[5:] if line]
    return dict(zip(lines[1].split("\t"), lines[2].split("\t"))), rows


write(60)
for axis in (None, "X", "-X"):
    with contextlib.redirect_stdout(io.StringIO()):
        trc_rotate_func(input="walk.trc", output="turned.trc", rotate90=axis)
    print(f"head 1700 mm up along y, rotate90={axis}: z is {read('turned.trc')[1][0][4]:.0f} mm")
for rate, wanted in ((60, 30), (60, 25), (120, 50), (59.94, 30)):
    write(rate)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            trc_desample_func("walk.trc", wanted)
    except ValueError as error:
        print(f"{rate} Hz to {wanted}: {type(error).__name__}")
        continue
    header, rows = read(f"walk_{wanted}fps.trc")
    interval = (rows[-1][1] - rows[0][1]) / (len(rows) - 1)
    step = (rows[-1][2] - rows[0][2]) / (len(rows) - 1) / 1000
    print(f"{rate} Hz to {wanted}: states {header['DataRate']} Hz, {header['NumFrames']} frames; {len(rows)} rows at",
          f"{1 / interval:.0f} Hz, 1.20 m/s are {step * int(header['DataRate']):.2f}")
PY
expect <<'SEEN'
head 1700 mm up along y, rotate90=None: z is -1700 mm
head 1700 mm up along y, rotate90=X: z is 1700 mm
head 1700 mm up along y, rotate90=-X: z is -1700 mm
60 Hz to 30: states 30 Hz, 150 frames; 150 rows at 30 Hz, 1.20 m/s are 1.20
60 Hz to 25: states 25 Hz, 125 frames; 150 rows at 30 Hz, 1.20 m/s are 1.00
120 Hz to 50: states 50 Hz, 125 frames; 150 rows at 60 Hz, 1.20 m/s are 1.00
59.94 Hz to 30: ValueError
SEEN
