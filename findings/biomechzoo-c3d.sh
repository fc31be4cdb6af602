#!/usr/bin/env bash
# biomechzoo reads an event of the second minute as one of the first, mixes the analog channels, and cuts off the rate.
#
# Seen 2026-11-28: biomechzoo 0.8.25, ezc3d 1.7.2.
# Behaviour: `c3d2zoo_data` takes the seconds of EVENT:TIMES without the minutes; it reshapes ezc3d's (1, channels,
#   samples) to (samples, channels) without exchanging the axes, so that each channel holds samples of all; and it turns
#   the rate into a whole number (59.94 frames a second become 59), by which the times of events are multiplied. No error.
# Matters: events of walks over a minute, forces and EMG, and events in files of cameras with NTSC rates are wrong.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install biomechzoo==0.8.25 ezc3d==1.7.2
observe venv <<'PY'
import ezc3d, numpy as np
from biomechzoo.conversion.c3d2zoo_data import c3d2zoo_data

for rate in (100.0, 59.94):
    n = int(90 * rate)
    made = ezc3d.c3d()
    point, analog = made["parameters"]["POINT"], made["parameters"]["ANALOG"]
    point["RATE"]["value"], point["LABELS"]["value"] = [rate], ["SACR"]
    made["data"]["points"] = np.ones((4, 1, n))
    analog["RATE"]["value"], analog["LABELS"]["value"], analog["UNITS"]["value"] = [2 * rate], ["Fz", "EMG"], ["N", "V"]
    made["data"]["analogs"] = np.stack([np.full(2 * n, 700.0), np.full(2 * n, 0.5)])[None]
    for key, value in (("CONTEXTS", "Left"), ("LABELS", "Foot Strike"), ("SUBJECTS", "A")):
        made.add_parameter("EVENT", key, [value] * 2)
    made.add_parameter("EVENT", "USED", [2])
    made.add_parameter("EVENT", "TIMES", np.array([[0.0, 1.0], [50.0, 10.0]]))  # 0 min 50 s, 1 min 10 s
    made.write("walk.c3d")
    read = c3d2zoo_data(ezc3d.c3d("walk.c3d"))
    frames = sorted(event[0] for event in read["SACR"]["event"].values())
    print(f"{rate:g} Hz: events at frames {frames}, right are {[round(t * rate) for t in (50, 70)]}")
    print("channels of 700 N and 0.5 V:", [np.unique(read[name]["line"]).tolist() for name in ("Fz", "EMG")])
PY
expect <<'SEEN'
100 Hz: events at frames [999, 4999], right are [5000, 7000]
channels of 700 N and 0.5 V: [[0.5, 700.0], [0.5, 700.0]]
59.94 Hz: events at frames [589, 2949], right are [2997, 4196]
channels of 700 N and 0.5 V: [[0.5, 700.0], [0.5, 700.0]]
SEEN
