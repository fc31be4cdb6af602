#!/usr/bin/env bash
# Cell i of a heat map of BlazePose's landmark network lies at 4 i pixels of its input, not at the centre 4 (i + 0.5).
#
# Seen 2026-11-29: pose_landmark_full of mediapipe 0.10.21, run by ai-edge-litert 2.3.0.
# Behaviour: beside its points the network returns 39 maps of 64 x 64 cells for an input of 256 x 256. Nothing states
#   where a cell lies, nor that the values are logits and not probabilities. The columns of a peak in a picture and in
#   its mirror image add up to 64: column i is at 4 i px. If cells were the squares that they cover, the sum would be 63.
# Matters: who refines points by the maps with centres at 4 (i + 0.5) moves each by 2 px of the input, 1 % of a person's
#   height, to the right and down; averaging with a mirror image hides the first and keeps the second.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install mediapipe==0.10.21 --no-deps
install ai-edge-litert==2.3.0 numpy==2.4.6 scikit-image==0.26.0
observe venv <<'PY'
import importlib.util, pathlib
import numpy as np
from ai_edge_litert.interpreter import Interpreter
from skimage.data import astronaut

folder = pathlib.Path(importlib.util.find_spec("mediapipe").submodule_search_locations[0], "modules/pose_landmark")
picture = astronaut().reshape(256, 2, 256, 2, 3).mean(axis=(1, 3)).astype(np.float32) / 255
MIRRORED = {0: 0, 2: 5, 5: 2, 9: 10, 10: 9, 11: 12, 12: 11}  # nose, eyes, corners of the mouth, shoulders


def look(network, image):
    network.set_tensor(network.get_input_details()[0]["index"], image[None])
    network.invoke()
    return {v.size: v for v in (network.get_tensor(o["index"]) for o in network.get_output_details())}


def peak(logits):
    """Column and row of the peak, by the mean over 5 x 5 cells around the highest, and its height as probability."""
    height = 1 / (1 + np.exp(-np.clip(logits.astype(float), -50, 50)))
    row, column = np.unravel_index(height.argmax(), height.shape)
    rows, columns = np.mgrid[row - 2 : row + 3, column - 2 : column + 3]
    w = height[rows, columns]
    return (w * columns).sum() / w.sum(), (w * rows).sum() / w.sum(), height.max()


network = Interpreter(str(folder / "pose_landmark_full.tflite"), num_threads=2)
network.allocate_tensors()
own, other = look(network, picture), look(network, np.ascontiguousarray(picture[:, ::-1]))
maps, mirrored = (found[64 * 64 * 39][0] for found in (own, other))
sums = []
for point, twin in MIRRORED.items():
    (x, _, high), (x2, _, high2) = peak(maps[..., point]), peak(mirrored[..., twin])
    if min(high, high2) > 0.5:
        sums.append(x + x2)
print(f"maps of {maps.shape}, lowest value below -10: {bool(maps.min() < -10)}")
print(f"columns of {len(sums)} peaks in a picture and in its mirror image add up to {np.mean(sums):.0f}")
PY
expect <<'SEEN'
maps of (64, 64, 39), lowest value below -10: True
columns of 6 peaks in a picture and in its mirror image add up to 64
SEEN
