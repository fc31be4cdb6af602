#!/usr/bin/env bash
# pyomeca counts the time of a C3D from 0, whatever its first frame: events of the same file are elsewhere.
#
# Seen 2026-11-30: pyomeca 2026.0.2, kineticstoolkit 0.17.0, ezc3d 1.7.2, xarray 2026.9.0, numpy 2.4.6.
# Behaviour: the header names the first frame, and the times of events count from frame 1. `Markers.from_c3d` and
#   `Analogs.from_c3d` begin at 0 (the number is in `attrs["first_frame"]`), kineticstoolkit at the first frame. The nearest
#   sample to an event behind the end is the last one, without an error.
# Matters: laboratories cut trials to the strides over the plates, and an export begins where the person comes into view.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pyomeca==2026.0.2 kineticstoolkit==0.17.0 ezc3d==1.7.2 xarray==2026.9.0 numpy==2.4.6
observe venv <<'PY'
import ezc3d
import kineticstoolkit as ktk
import numpy as np
from pyomeca import Analogs, Markers

time = 2.99 + np.arange(200) / 100
made = ezc3d.c3d()
for group, rate, unit, label in (("POINT", 100.0, "mm", "LHEE"), ("ANALOG", 1000.0, "V", "switch")):
    parameters = made["parameters"][group]
    parameters["RATE"]["value"], parameters["UNITS"]["value"], parameters["LABELS"]["value"] = [rate], [unit], [label]
points = np.ones((4, 1, 200))
points[:3, 0] = np.array([1200 * time, 0 * time, 30 + 100 * abs(time - 3.5)])
made["data"]["points"], made["data"]["analogs"] = points, np.zeros((1, 1, 2000))
made["header"]["points"]["first_frame"] = 299
made.add_event([0, 3.5], "Left", "Foot Strike")
made.write("walk.c3d")

read = ezc3d.c3d("walk.c3d")
strike = float(read["parameters"]["EVENT"]["TIMES"]["value"][1, 0])
print(f"ezc3d: first frame {read['header']['points']['first_frame'] + 1}, event at {strike:.2f} s")
markers = Markers.from_c3d("walk.c3d")
heel = markers.sel(time=strike, method="nearest").values[:3, 0]
print(f"pyomeca: {float(markers.time[0]):.2f} to {float(markers.time[-1]):.2f} s, heel at the event {heel[2]:.0f} mm high,",
      f"{heel[0] / 1000:.2f} m along")
analogs = Analogs.from_c3d("walk.c3d")
print(f"pyomeca, analog: {float(analogs.time[0]):.2f} to {float(analogs.time[-1]):.2f} s")
whole = ktk.read_c3d("walk.c3d", convert_point_unit=False)["Points"]
heel = whole.data["LHEE"][np.abs(whole.time - whole.events[0].time).argmin()]
print(f"kineticstoolkit: {whole.time[0]:.2f} to {whole.time[-1]:.2f} s, heel at the event {heel[2]:.0f} mm high, {heel[0] / 1000:.2f} m along")
PY
expect <<'SEEN'
ezc3d: first frame 300, event at 3.50 s
pyomeca: 0.00 to 1.99 s, heel at the event 178 mm high, 5.98 m along
pyomeca, analog: 0.00 to 2.00 s
kineticstoolkit: 2.99 to 4.98 s, heel at the event 30 mm high, 4.20 m along
SEEN
