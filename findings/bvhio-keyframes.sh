#!/usr/bin/env bash
# bvhio still writes keyframes that were removed, and shows them with the body upside down at the floor.
#
# Seen 2026-11-30: bvhio 1.5.4, pyglm 2.8.2, spatial-transform 1.3.3, numpy 2.4.6.
# Behaviour: `Joint.removeKeyframe` takes a keyframe out of the list and leaves it in the table in which frames are looked up.
#   `writeHierarchy` writes the removed values as before; `loadPose` of such a frame leaves the rest pose out and
#   turns the change round. If the list `Keyframes` is set without them, the gap is interpolated with the weight
#   (first + frame) / second instead of (frame - first) / (second - first): right in a gap after frame 0, in others
#   too far, and an AssertionError where the weight exceeds 1.
#   Before its first keyframe a joint has the pose of the last one (stated is the nearest), and negative frames, stated to
#   count from the end, are all the last one.
# Matters: frames in which a marker jumped are removed, so that they are filled; the file has the jump as before.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install bvhio==1.5.4 pyglm==2.8.2 spatial-transform==1.3.3 numpy==2.4.6
observe venv <<'PY'
import bvhio
import glm
import numpy as np

FRAMES = 41
JUMP = range(11, 20)


def read(jump=False):
    """A pelvis at 90 cm that walks 2 cm a frame and a knee that bends 1 deg a frame; in a jump 50 cm and 60 deg more."""
    lines = ["HIERARCHY", "ROOT pelvis", "{", "OFFSET 0 90 0",
             "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation", "JOINT knee", "{", "OFFSET 0 -40 0",
             "CHANNELS 3 Zrotation Xrotation Yrotation", "End Site", "{", "OFFSET 0 -42 0", "}", "}", "}",
             "MOTION", f"Frames: {FRAMES}", "Frame Time: 0.01"]
    for i in range(FRAMES):
        more = jump and i in JUMP
        lines.append(f"{2 * i + 50 * more} 90 0 0 0 0 0 {i + 60 * more} 0")
    with open("walk.bvh", "w") as file:
        file.write("\n".join(lines) + "\n")
    return bvhio.readAsHierarchy("walk.bvh")


def pose(root, frame):
    try:
        root.loadPose(frame)
    except AssertionError:
        return "AssertionError"
    foot = root.Children[0].RotationWorld * glm.vec3(0, 1, 0)
    bent = np.degrees(np.arctan2(-foot.z, -foot.y))
    return f"pelvis ({root.PositionWorld.x:.0f}, {root.PositionWorld.y:.0f}) cm, knee {bent:.0f} deg"


def written(root):
    bvhio.writeHierarchy("written.bvh", root, 0.01)
    frames = bvhio.readAsBvh("written.bvh").Root.Keyframes
    return [round(frames[i].Position.x) for i in (10, 11, 15, 19, 20)]


root = read(jump=True)
print("as read, frame 10:", pose(root, 10))
print("as read, frame 15:", pose(root, 15))
for frame in JUMP:
    root.removeKeyframe(frame, recursive=True)
print("frames 11 to 19 removed, keyframes left:", len(root.Keyframes))
for frame in (10, 15, 20):
    print(f"  frame {frame}:", pose(root, frame))
print("  written, x of frames 10, 11, 15, 19, 20:", written(root))

for begin, end in ((0, 40), (10, 40), (10, 20)):
    root = read()
    for joint, _, _ in root.layout():
        joint.Keyframes = [key for key in joint.Keyframes if not begin < key[0] < end]
    print(f"keyframes between {begin} and {end} left out:")
    for frame in (12, 30, 35) if end == 40 else (12,):
        print(f"  frame {frame} (should be {2 * frame} cm, {frame} deg):", pose(root, frame))

root = read()
for joint, _, _ in root.layout():
    joint.Keyframes = [key for key in joint.Keyframes if key[0] >= 10]
for frame in (0, 9, 10):
    print(f"first keyframe 10, frame {frame}:", pose(root, frame))
for frame in (-1, -10):
    print(f"frame {frame}:", pose(read(), frame))
PY
expect <<'SEEN'
as read, frame 10: pelvis (20, 90) cm, knee 10 deg
as read, frame 15: pelvis (80, 90) cm, knee 75 deg
frames 11 to 19 removed, keyframes left: 32
  frame 10: pelvis (20, 90) cm, knee 10 deg
  frame 15: pelvis (-80, 0) cm, knee 105 deg
  frame 20: pelvis (40, 90) cm, knee 20 deg
  written, x of frames 10, 11, 15, 19, 20: [20, 72, 80, 88, 40]
keyframes between 0 and 40 left out:
  frame 12 (should be 24 cm, 12 deg): pelvis (24, 90) cm, knee 12 deg
  frame 30 (should be 60 cm, 30 deg): pelvis (60, 90) cm, knee 31 deg
  frame 35 (should be 70 cm, 35 deg): pelvis (70, 90) cm, knee 36 deg
keyframes between 10 and 40 left out:
  frame 12 (should be 24 cm, 12 deg): pelvis (53, 90) cm, knee 27 deg
  frame 30 (should be 60 cm, 30 deg): pelvis (80, 90) cm, knee 40 deg
  frame 35 (should be 70 cm, 35 deg): AssertionError
keyframes between 10 and 20 left out:
  frame 12 (should be 24 cm, 12 deg): AssertionError
first keyframe 10, frame 0: pelvis (80, 90) cm, knee 40 deg
first keyframe 10, frame 9: pelvis (80, 90) cm, knee 40 deg
first keyframe 10, frame 10: pelvis (20, 90) cm, knee 10 deg
frame -1: pelvis (80, 90) cm, knee 40 deg
frame -10: pelvis (80, 90) cm, knee 40 deg
SEEN
