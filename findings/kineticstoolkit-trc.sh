#!/usr/bin/env bash
# A TRC file that kineticstoolkit writes states the rate times the number of frames, and metres whatever the markers are in.
#
# Seen 2026-11-29: kineticstoolkit 0.17.0, numpy 2.4.6.
# Behaviour: `write_trc_file` divides the number of frames by one interval: DataRate and CameraRate of 300 frames at 100 Hz
#   are 30000. Its unit is m also if the markers' is mm, which a C3D read with `convert_point_unit=False` has. Gaps, which
#   it means to fill, are filled in a copy that it drops, and written as nan. Times are rounded to milliseconds.
# Matters: programs that go by DataRate (cut-off frequencies, velocities) are off by the number of frames.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install kineticstoolkit==0.17.0 numpy==2.4.6
observe venv <<'PY'
import numpy as np
import kineticstoolkit.lab as ktk
from kineticstoolkit.kinematics import write_trc_file

for rate, frames, unit in ((100, 300, "m"), (100, 600, "mm"), (240, 720, "m")):
    markers = ktk.TimeSeries(time=np.arange(frames) / rate)
    for name in ("heel", "toe"):
        markers = markers.add_data(name, np.ones((frames, 4)))
        markers = markers.add_info(name, "Unit", unit)
    markers.data["heel"][100:110] = np.nan
    write_trc_file(markers, "walk.trc")
    with open("walk.trc") as file:
        lines = file.read().splitlines()
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t")))
    row = lines[6 + 100].split("\t")
    times = np.array([float(line.split("\t")[1]) for line in lines[6:]])
    steps = np.diff(times)
    print(f"{frames} frames at {rate} Hz: DataRate {float(header['DataRate']):g}, {unit} is {header['Units']},",
          f"steps of {1000 * steps.min():.0f} to {1000 * steps.max():.0f} ms, a missing heel is {row[2]!r}")
PY
expect <<'SEEN'
300 frames at 100 Hz: DataRate 30000, m is m, steps of 10 to 10 ms, a missing heel is 'nan'
600 frames at 100 Hz: DataRate 60000, mm is m, steps of 10 to 10 ms, a missing heel is 'nan'
720 frames at 240 Hz: DataRate 172800, m is m, steps of 4 to 5 ms, a missing heel is 'nan'
SEEN
