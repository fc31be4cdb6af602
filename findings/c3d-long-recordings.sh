#!/usr/bin/env bash
# c3d reads no frame at all of a C3D file with 65535 frames; ezc3d hides those after the 65535th.
#
# Seen 2026-11-28: c3d 0.6.0, ezc3d 1.7.2.
# Behaviour: the numbers of a C3D's frames have 16 bits. c3d's reader counts 65535 frames, yet its iterator ends before
#   the first one. ezc3d writes all frames of a longer recording, but states 65535, and returns 65535. No one raises.
# Matters: 65535 frames are 11 minutes at 100 Hz and 5.5 minutes at 200 Hz. The missing part is found only by comparing
#   the size of the file.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install ezc3d==1.7.2 c3d==0.6.0 numpy==2.4.6
observe venv <<'PY'
import os
import c3d, ezc3d, numpy as np

for frames in (65534, 65535, 70000):
    made = ezc3d.c3d()
    made["parameters"]["POINT"]["RATE"]["value"] = [200.0]
    made["parameters"]["POINT"]["LABELS"]["value"] = ["LHEE"]
    points = np.ones((4, 1, frames))
    points[0] = np.arange(frames)
    made["data"]["points"] = points
    made.write("walk.c3d")
    back = ezc3d.c3d("walk.c3d")["data"]["points"].shape[2]
    holds_all = os.path.getsize("walk.c3d") >= 16 * frames
    with open("walk.c3d", "rb") as file:
        reader = c3d.Reader(file)
        read = sum(1 for _ in reader.read_frames())
    print(f"{frames} written (file holds all: {holds_all}); ezc3d reads {back}; c3d counts {reader.frame_count}, reads {read}")
PY
expect <<'SEEN'
65534 written (file holds all: True); ezc3d reads 65534; c3d counts 65534, reads 65534
65535 written (file holds all: True); ezc3d reads 65535; c3d counts 65535, reads 0
70000 written (file holds all: True); ezc3d reads 65535; c3d counts 65535, reads 0
SEEN
