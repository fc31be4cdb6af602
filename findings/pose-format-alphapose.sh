#!/usr/bin/env bash
# pose-format reads each person in AlphaPose's results as a frame: frames without a person vanish, two persons alternate.
#
# Seen 2026-11-30: pose-format 0.15.0, numpy 2.4.6, scipy 1.17.1. The lost frames are its open issue 230.
# Behaviour: AlphaPose's file lists one entry per person and picture, and names the picture in `image_id`.
#   `load_alphapose_wholebody_from_json` sorts them by it and makes a frame of each entry; of OpenPose's files, which are
#   one per picture, the frames are right. `interpolate`, which changes the frame rate, also fills every gap between a
#   point's first and last sighting, and gives the invented positions a confidence in between.
# Matters: events behind a gap come too early, a walk with a second person in view lasts twice as long and jumps between
#   them, and a foot that was hidden counts as seen.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pose-format==0.15.0 numpy==2.4.6 scipy==1.17.1
observe venv <<'PY'
import json

import numpy as np
from pose_format.utils.alphapose import load_alphapose_wholebody_from_json
from pose_format.utils.openpose import load_openpose

FRAMES, FPS = 100, 25
EVERY = range(FRAMES)
SEEN = [frame for frame in EVERY if not 40 <= frame < 70]


def from_alphapose(seen_in):
    """Persons whose x is 10 px times the frame, the second one 5000 px further."""
    found = [
        {"image_id": f"{frame}.jpg", "category_id": 1, "score": 2.5, "idx": person,
         "keypoints": [10.0 * frame + 5000 * person, 300.0, 0.9] * 136}
        for frame in EVERY for person, frames in enumerate(seen_in) if frame in frames
    ]
    with open("alphapose-results.json", "w") as file:
        json.dump(found, file)
    return load_alphapose_wholebody_from_json("alphapose-results.json", fps=FPS)


def from_openpose(seen_in):
    parts = {"pose_keypoints_2d": 25, "face_keypoints_2d": 70, "hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21}
    frames = {
        frame: {"people": [{part: [10.0 * frame + 5000 * person, 300.0, 0.9] * n for part, n in parts.items()}
                           for person, frames in enumerate(seen_in) if frame in frames]}
        for frame in EVERY
    }
    return load_openpose(frames, fps=FPS)


for case, seen_in in (("one person", [EVERY]), ("one, not seen for 30 frames", [SEEN]), ("two persons", [EVERY, EVERY])):
    for name, load in (("AlphaPose", from_alphapose), ("OpenPose", from_openpose)):
        body = load(seen_in).body
        x = [round(float(value)) for value in body.data[[30, 31, 32, -1], 0, 0, 0]]
        print(f"{case}, {name}: {len(body.data)} frames, {body.data.shape[1]} in each, x of 30, 31, 32 and the last: {x}")

body = from_openpose([SEEN]).body.interpolate(FPS, kind="linear")
print(f"interpolated, frame 55: x {body.data[55, 0, 0, 0]:.0f}, confidence {body.confidence[55, 0, 0]:.1f},",
      f"{np.count_nonzero(body.confidence[:, 0, 0] == 0)} of {len(body.data)} frames without")
PY
expect <<'SEEN'
one person, AlphaPose: 100 frames, 1 in each, x of 30, 31, 32 and the last: [300, 310, 320, 990]
one person, OpenPose: 100 frames, 1 in each, x of 30, 31, 32 and the last: [300, 310, 320, 990]
one, not seen for 30 frames, AlphaPose: 70 frames, 1 in each, x of 30, 31, 32 and the last: [300, 310, 320, 990]
one, not seen for 30 frames, OpenPose: 100 frames, 1 in each, x of 30, 31, 32 and the last: [300, 310, 320, 990]
two persons, AlphaPose: 200 frames, 1 in each, x of 30, 31, 32 and the last: [150, 5150, 160, 5990]
two persons, OpenPose: 100 frames, 2 in each, x of 30, 31, 32 and the last: [300, 310, 320, 990]
interpolated, frame 55: x 550, confidence 0.9, 0 of 100 frames without
SEEN
