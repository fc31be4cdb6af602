#!/usr/bin/env bash
# pyomeca fills gaps at the ends of a recording with zeros, and normalises the times of its argument in place.
#
# Seen 2026-11-29: pyomeca 2026.0.2, xarray 2026.9.0, numpy 2.4.6.
# Behaviour: `interpolate_missing_data` joins gaps within a recording by lines; before the first and after the last sample
#   it writes 0, as if the marker lay at the origin. `low_pass` needs data without gaps, and its result is pulled there:
#   a pelvis at 950 mm is at 530 mm in its first frame. `time_normalize(norm_time=True)` also writes 0 to 99 into the
#   times of its argument, so that a rate computed from them afterwards is wrong.
# Matters: people come into view and leave it; the first and last steps are bent, and no sample is missing any more.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pyomeca==2026.0.2 xarray==2026.9.0 numpy==2.4.6
observe venv <<'PY'
import numpy as np
from pyomeca import Markers

time = np.arange(300) / 100
points = np.ones((4, 1, 300))
points[:3, 0] = np.array([[0], [0], [950.0]])
points[:, 0, :100] = points[:, 0, 150:160] = points[:, 0, 280:] = np.nan
pelvis = Markers(points, channels=["pelvis"], time=time)
filled = pelvis.meca.interpolate_missing_data()
smooth = filled.meca.low_pass(order=4, cutoff=6, freq=100)
for place, frame in (("before", 50), ("first", 100), ("in the gap", 155), ("middle", 200), ("last", 279), ("after", 290)):
    height, smoothed = (float(x.values[2, 0, frame]) for x in (filled, smooth))
    print(f"{place}: filled {height:.0f} mm, then filtered {round(smoothed, -1) + 0:.0f} mm")
half = filled.isel(time=slice(100, 280)).copy(deep=True)
half.meca.time_normalize(n_frames=101, norm_time=True)
print(f"times of 1.00 to 2.79 s after normalising: {float(half.time[0]):.2f} to {float(half.time[-1]):.2f}")
PY
expect <<'SEEN'
before: filled 0 mm, then filtered 0 mm
first: filled 950 mm, then filtered 530 mm
in the gap: filled 950 mm, then filtered 950 mm
middle: filled 950 mm, then filtered 950 mm
last: filled 950 mm, then filtered 530 mm
after: filled 0 mm, then filtered -50 mm
times of 1.00 to 2.79 s after normalising: 0.00 to 99.00
SEEN
