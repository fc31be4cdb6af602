"""Lines between detected points: the body alone, for pictures that show nobody."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pbl_pipeline.render.colours import SIDE_COLOUR, bgr

#: Joints from the trunk outwards; a line joins those that a marker set has.
_LIMB = (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "index"), ("hip", "knee"), ("knee", "ankle"))
_FOOT = (("ankle", "heel"), ("heel", "foot_index"), ("ankle", "foot_index"))
_ACROSS = ("shoulder", "hip")


def skeleton_lines(names: Sequence[str]) -> list[tuple[int, int, str]]:
    """Indices of the two ends and the side ("left", "right", "middle") of each line of a marker set whose names are
    `left_knee`, `right_knee` and so on (`blazepose_33`)."""
    at = {name: i for i, name in enumerate(names)}
    pairs = [(f"{side}_{a}", f"{side}_{b}", side) for side in ("left", "right") for a, b in (*_LIMB, *_FOOT)]
    pairs += [(f"{side}_shoulder", f"{side}_hip", "middle") for side in ("left", "right")]
    pairs += [(f"left_{joint}", f"right_{joint}", "middle") for joint in _ACROSS]
    return [(at[a], at[b], side) for a, b, side in pairs if a in at and b in at]


def draw_skeleton(image: np.ndarray, names: Sequence[str], xy_px: np.ndarray) -> None:
    """Draw the lines between known points (J, 2) in px into `image` (H, W, 3) uint8 BGR, in place; nothing of a
    face."""
    known = np.asarray(np.isfinite(xy_px).all(axis=1), bool)
    width = max(2, round(max(image.shape[:2]) / 320))
    for a, b, side in skeleton_lines(names):
        if known[a] and known[b]:
            start, end = ((round(float(x)), round(float(y))) for x, y in (xy_px[a], xy_px[b]))
            cv2.line(image, start, end, bgr(SIDE_COLOUR[side]), width, cv2.LINE_AA)
