#!/usr/bin/env bash
# ezc3d writes more than 255 blocks of parameters with their number modulo 256; c3d misses the parameters behind them.
#
# Seen 2026-11-28: ezc3d 1.7.2, c3d 0.6.0.
# Behaviour: a C3D states in one byte how many blocks of 512 bytes its parameters have. ezc3d writes that number modulo
#   256 and the whole first block of the frames, and reads all back by the latter. c3d stops after the stated number:
#   groups are missing without an error, the frames are right.
# Matters: texts of 300 points, or events of hours, have more than 128 kB: events are then missing in silence.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install ezc3d==1.7.2 c3d==0.6.0 numpy==2.4.6
observe venv <<'PY'
import struct
import c3d, ezc3d, numpy as np

for notes in (4, 8):
    made = ezc3d.c3d()
    made["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    made["parameters"]["POINT"]["LABELS"]["value"] = ["LHEE"]
    made["data"]["points"] = np.ones((4, 1, 10))
    for k in range(notes):
        made.add_parameter("NOTES", f"TEXT{k}", ["x" * 100] * 250)
    made.add_parameter("EVENT", "LABELS", ["Foot Strike"] * 7)
    made.write("walk.c3d")
    with open("walk.c3d", "rb") as file:
        data = file.read()
    frames_in = struct.unpack_from("<H", data, 16)[0]
    again = ezc3d.c3d("walk.c3d")
    events = len(again["parameters"]["EVENT"]["LABELS"]["value"])
    with open("walk.c3d", "rb") as file:
        reader = c3d.Reader(file)
        labels = reader.get("EVENT:LABELS")
        seen = "no parameter" if labels is None else f"{len(np.ravel(labels.string_array))} events"
        frames = sum(1 for _ in reader.read_frames())
    print(f"{frames_in - 2} blocks, stated {data[514]}: ezc3d {events} events; c3d {seen}, {frames} frames")
PY
expect <<'SEEN'
197 blocks, stated 197: ezc3d 7 events; c3d 7 events, 10 frames
393 blocks, stated 137: ezc3d 7 events; c3d no parameter, 10 frames
SEEN
