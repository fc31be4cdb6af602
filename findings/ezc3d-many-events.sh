#!/usr/bin/env bash
# ezc3d writes more than 255 events without an error; neither it nor c3d reads them back.
#
# Seen 2026-11-28: ezc3d 1.7.2, c3d 0.6.0.
# Behaviour: a C3D stores each size of a parameter in one byte. ezc3d splits long lists of point labels over LABELS2
#   and so on, but not those of events: it writes the size modulo 256. Of 256 events c3d reads none and of 400 the first
#   144, both without an error; ezc3d refuses its own file as a whole.
# Matters: a walk of a minute and a half has more than 255 initial contacts and toe-offs.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install ezc3d==1.7.2 c3d==0.6.0 numpy==2.4.6
observe venv <<'PY'
import c3d, ezc3d, numpy as np

for events in (255, 256, 400):
    made = ezc3d.c3d()
    made["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    made["parameters"]["POINT"]["LABELS"]["value"] = ["LHEE"]
    made["data"]["points"] = np.ones((4, 1, 10))
    made.add_parameter("EVENT", "USED", [events])
    made.add_parameter("EVENT", "CONTEXTS", ["Left"] * events)
    made.add_parameter("EVENT", "LABELS", ["Foot Strike"] * events)
    made.add_parameter("EVENT", "TIMES", np.vstack([np.zeros(events), np.arange(events) * 0.5]))
    made.write("walk.c3d")
    try:
        seen = f"{len(ezc3d.c3d('walk.c3d')['parameters']['EVENT']['LABELS']['value'])} events"
    except Exception as error:
        seen = type(error).__name__
    with open("walk.c3d", "rb") as file:
        reader = c3d.Reader(file)
        times = len(reader.get("EVENT:TIMES").float_array)
        frames = sum(1 for _ in reader.read_frames())
    print(f"{events} written; ezc3d reads {seen}; c3d reads {times} events and {frames} frames")
PY
expect <<'SEEN'
255 written; ezc3d reads 255 events; c3d reads 255 events and 10 frames
256 written; ezc3d reads OSError; c3d reads 0 events and 10 frames
400 written; ezc3d reads OSError; c3d reads 144 events and 10 frames
SEEN
