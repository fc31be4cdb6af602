"""Capsules and keypoints drawn into one picture with OpenCV."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pbl_pipeline.render.colours import SIDE_COLOUR, bgr, side_of
from pbl_pipeline.render.projection import NEAR_M, to_camera, to_pixels
from pbl_pipeline.video import Camera

_CIRCLE = np.stack([f(np.linspace(0, 2 * np.pi, 24, endpoint=False)) for f in (np.cos, np.sin)], axis=-1)
_SHIFT = 4  # OpenCV's polygon corners carry this many fractional bits
_SHADE_DEPTH_M = 0.35  # this far before or behind the middle of the body the shading is full
_FAR_PX = 20_000.0  # polygons that reach further than this are cut: OpenCV counts in 32 bit


def draw_body(
    image: np.ndarray,
    body_names: Sequence[str],
    start_m: np.ndarray,
    end_m: np.ndarray,
    radius_m: np.ndarray,
    quat_wxyz: np.ndarray,
    position_m: np.ndarray,
    camera: Camera,
    opacity: float = 0.62,
) -> None:
    """Draw capsules into `image` (H, W, 3) BGR, in place.

    Parameters
    ----------
    body_names
        The body of each of the G capsules. Its side (`_r`, `_l`) chooses the colour; the capsules of one body are
        drawn as one shape with one outline.
    start_m, end_m : (G, 3)
        Ends of the axes, world frame. Capsules with NaN are left out; what lies behind `NEAR_M` is cut off.
    radius_m : (G,)
    quat_wxyz : (4,)
        Camera to world.
    position_m : (3,)
        Of the camera in the world.
    opacity
        0..1; the person stays visible through the body.
    """
    start, end = (to_camera(points, quat_wxyz, position_m) for points in (start_m, end_m))
    outlines: dict[str, list[np.ndarray]] = {}
    depths: dict[str, list[float]] = {}
    for g, name in enumerate(body_names):
        outline = capsule_outline(start[g], end[g], float(radius_m[g]), camera)
        if outline is not None and _touches(outline, image.shape):
            outlines.setdefault(name, []).append(outline)
            depths.setdefault(name, []).append(0.5 * float(start[g, 2] + end[g, 2]))
    if not outlines:
        return
    depth = {name: float(np.mean(d)) for name, d in depths.items()}
    middle = float(np.median(list(depth.values())))
    layer = image.copy()
    # Far ones first, so that the near limb covers the far one.
    for name in sorted(outlines, key=lambda n: -depth[n]):
        corners = [np.rint(o * (1 << _SHIFT)).astype(np.int32) for o in outlines[name]]
        fill, edge = _shaded(SIDE_COLOUR[side_of(name)], (middle - depth[name]) / _SHADE_DEPTH_M)
        # All outlines before all fills: what remains of them is the outline of the whole.
        cv2.polylines(layer, corners, True, edge, 2, cv2.LINE_AA, _SHIFT)
        for c in corners:
            cv2.fillConvexPoly(layer, c, fill, cv2.LINE_AA, _SHIFT)
    # Only the rectangle around the body is blended: on a large frame that is most of the time saved.
    every = np.concatenate([o for group in outlines.values() for o in group])
    limit = [image.shape[1], image.shape[0]]
    x0, y0 = (int(v) for v in np.clip(every.min(0) - 3, 0, limit))
    x1, y1 = (int(v) for v in np.clip(every.max(0) + 4, 0, limit))
    part = image[y0:y1, x0:x1]
    if part.size:
        image[y0:y1, x0:x1] = cv2.addWeighted(layer[y0:y1, x0:x1], opacity, part, 1 - opacity, 0)


def capsule_outline(start_cam_m: np.ndarray, end_cam_m: np.ndarray, radius_m: float, camera: Camera):
    """Convex outline (K, 2) in px of a capsule given in the camera frame; None where nothing of it can be drawn.

    The outline is the hull of the discs that the two end spheres project to. A disc stands for the ellipse that a
    sphere really projects to off the axis; at 30 degrees off the axis the two differ by 15 % of the radius.
    """
    ends = np.stack([start_cam_m, end_cam_m]).astype(float)
    if not np.all(np.isfinite(ends)) or np.all(ends[:, 2] < NEAR_M):
        return None
    near = int(np.argmin(ends[:, 2]))
    if ends[near, 2] < NEAR_M:
        a, b = ends[near], ends[1 - near]
        ends[near] = b + (a - b) * (b[2] - NEAR_M) / (b[2] - a[2])
        ends[near, 2] = NEAR_M  # rounding must not put it behind the plane again
    centres = to_pixels(ends, camera)
    if not np.all(np.isfinite(centres)):
        return None
    focal = 0.5 * (camera.matrix[0, 0] + camera.matrix[1, 1])
    radii = focal * radius_m / ends[:, 2]
    points = (centres[:, None] + radii[:, None, None] * _CIRCLE).reshape(-1, 2)
    points = np.clip(points, -_FAR_PX, _FAR_PX).astype(np.float32)
    return cv2.convexHull(points)[:, 0]


def draw_keypoints(image: np.ndarray, xy_px: np.ndarray, confidence: np.ndarray) -> None:
    """Detected points (J, 2) as small dots, in place: filled from confidence 0.5 on, hollow below; none at 0."""
    size = max(2, round(max(image.shape[:2]) / 640))
    for (x, y), c in zip(np.asarray(xy_px, float), np.asarray(confidence, float), strict=True):
        if not (np.isfinite(x) and np.isfinite(y)) or c <= 0 or abs(x) > _FAR_PX or abs(y) > _FAR_PX:
            continue
        centre = (round(x), round(y))
        cv2.circle(image, centre, size + 1, (20, 20, 20), 1, cv2.LINE_AA)
        cv2.circle(image, centre, size, (66, 228, 240), -1 if c >= 0.5 else 1, cv2.LINE_AA)


def _touches(outline: np.ndarray, shape: tuple[int, ...]) -> bool:
    low, high = outline.min(0), outline.max(0)
    return bool(high[0] >= 0 and high[1] >= 0 and low[0] < shape[1] and low[1] < shape[0])


def _shaded(colour: str, nearness: float) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Fill and edge: lighter in front of the body's middle (nearness > 0), darker behind it."""
    base = np.array(bgr(colour), float)
    t = float(np.clip(nearness, -1, 1))
    fill = base + (255 - base) * 0.28 * t if t > 0 else base * (1 + 0.45 * t)
    edge = fill * 0.55
    return _ints(fill), _ints(edge)


def _ints(v: np.ndarray) -> tuple[int, int, int]:
    return int(v[0]), int(v[1]), int(v[2])
