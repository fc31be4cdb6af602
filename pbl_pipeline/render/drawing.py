"""Projection of world points into one picture, and drawing of capsules, keypoints, skeletons and the strip below.

Colours are blue and vermilion of Okabe and Ito (2008), which differ for every colour vision."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import joint_angles
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.runs import runs
from pbl_pipeline.video import Camera, turning_radius2

if TYPE_CHECKING:
    from pbl_pipeline.gait import GaitEvent

#: Least depth of drawn points (m): the pinhole equations grow without bound below.
NEAR_M = 0.1


def rotation_matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in the order w, x, y, z (normalised here).

    For `phone_quat_wxyz` this is R_nc: it takes camera vectors to the world.
    """
    q = np.asarray(quat_wxyz, float)
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*q.shape[:-1], 3, 3)


def to_camera(points_world_m: np.ndarray, quat_wxyz: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """Points (..., 3) of the world in the frame of the camera at `position_m` (3,): x right, y down, z forward (m)."""
    # x_cam = R_nc^T (x_world - p_nc); with row vectors that is a product from the right by R_nc.
    return (np.asarray(points_world_m, float) - np.asarray(position_m, float)) @ rotation_matrix(quat_wxyz)


def to_pixels(points_cam_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels (..., 2) of camera-frame points (..., 3).

    Pinhole with OpenCV's radial-tangential distortion (k1, k2, p1, p2, k3). NaN for points nearer than `NEAR_M` or
    behind the camera, and for points so far off the axis that the radial polynomial turns back, which would fold them
    into the picture.
    """
    p = np.asarray(points_cam_m, float)
    depth = np.where(p[..., 2] >= NEAR_M, p[..., 2], np.nan)
    x, y = p[..., 0] / depth, p[..., 1] / depth
    k1, k2, p1, p2, k3 = np.asarray(camera.distortion, float)
    r2 = x * x + y * y
    r2 = np.where(r2 < turning_radius2(camera), r2, np.nan)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    m = np.asarray(camera.matrix, float)
    return np.stack([m[0, 0] * xd + m[0, 1] * yd + m[0, 2], m[1, 1] * yd + m[1, 2]], axis=-1)


#: Side -> "#rrggbb". Left is the warm colour, as in most gait laboratories.
SIDE_COLOUR: dict[str, str] = {"right": "#0072b2", "left": "#d55e00", "middle": "#8a8f98"}


def bgr(colour: str) -> tuple[int, int, int]:
    """Return a "#rrggbb" colour in OpenCV's order."""
    value = int(colour.lstrip("#"), 16)
    return value & 255, (value >> 8) & 255, value >> 16


def side_of(name: str) -> str:
    """ "right", "left" or "middle" of a body part, joint or capsule by its OpenSim name (`femur_r`, `femur_r_2`)."""
    parts = name.lower().split("_")[1:]
    if "r" in parts or "right" in name.lower().split("_"):
        return "right"
    if "l" in parts or "left" in name.lower().split("_"):
        return "left"
    return "middle"


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
    """Draw the lines between known points (J, 2) in px into `image` (H, W, 3) uint8 BGR, in place, without a face."""
    known = np.asarray(np.isfinite(xy_px).all(axis=1), bool)
    width = max(2, round(max(image.shape[:2]) / 320))
    for a, b, side in skeleton_lines(names):
        if known[a] and known[b]:
            start, end = ((round(float(x)), round(float(y))) for x, y in (xy_px[a], xy_px[b]))
            cv2.line(image, start, end, bgr(SIDE_COLOUR[side]), width, cv2.LINE_AA)


_CIRCLE = np.stack([f(np.linspace(0, 2 * np.pi, 24, endpoint=False)) for f in (np.cos, np.sin)], axis=-1)
_SHIFT = 4  # OpenCV's polygon corners carry this many fractional bits
_SHADE_DEPTH_M = 0.35  # distance before or behind the middle of the body at which the shading is full
_FAR_PX = 20_000.0  # polygons that reach further are cut: OpenCV counts in 32 bit


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
        The body of each of the G capsules. Its side (`_r`, `_l`) determines the colour; the capsules of one body are
        drawn as one shape with one outline.
    start_m, end_m : (G, 3)
        Ends of the axes, world frame. Capsules with NaN are not drawn; parts behind `NEAR_M` are cut off.
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
        # All outlines before all fills, so that only the outline of the whole remains.
        cv2.polylines(layer, corners, True, edge, 2, cv2.LINE_AA, _SHIFT)
        for c in corners:
            cv2.fillConvexPoly(layer, c, fill, cv2.LINE_AA, _SHIFT)
    # Only the rectangle around the body is blended, which saves most of the time on a large frame.
    every = np.concatenate([o for group in outlines.values() for o in group])
    limit = [image.shape[1], image.shape[0]]
    x0, y0 = (int(v) for v in np.clip(every.min(0) - 3, 0, limit))
    x1, y1 = (int(v) for v in np.clip(every.max(0) + 4, 0, limit))
    part = image[y0:y1, x0:x1]
    if part.size:
        image[y0:y1, x0:x1] = cv2.addWeighted(layer[y0:y1, x0:x1], opacity, part, 1 - opacity, 0)


def capsule_outline(start_cam_m: np.ndarray, end_cam_m: np.ndarray, radius_m: float, camera: Camera):
    """Convex outline (K, 2) in px of a capsule in the camera frame; None if nothing of it can be drawn.

    The outline is the hull of the projections of the two end spheres, taken as discs. Off the axis they are really
    ellipses; at 30 degrees the two differ by 15 % of the radius.
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


_INK, _FAINT, _GRID, _PAPER = (51, 46, 42), (120, 112, 104), (232, 228, 224), (255, 255, 255)
_FONT_NAME = "sans"  # OpenCV carries this font itself


def stance_spans(events: Iterable[GaitEvent], side: str) -> list[tuple[float, float]]:
    """Times (initial contact, toe-off) in which the foot of `side` is known to be on the ground.

    Only a foot-down that is followed by a foot-up makes a span: before the first and after the last event, and between
    two events of one kind, nothing is claimed.
    """
    own = sorted((e.time_s, e.event) for e in events if e.side == side)
    pairs = itertools.pairwise(own)
    return [(t0, t1) for (t0, kind0), (t1, kind1) in pairs if kind0 == "foot_down" and kind1 == "foot_up"]


class Strip:
    """A picture (height, width, 3) BGR that is drawn once; `frame(t)` adds the cursor of time t."""

    def __init__(self, fit: TrialFit, events: Sequence[GaitEvent], width: int, height: int) -> None:
        self._font = cv2.FontFace(_FONT_NAME)
        self._height = height
        self._text_px = max(9, round(height * 0.105))
        self._left, self._right = round(width * 0.012) + 3 * self._text_px, width - round(width * 0.012) - 1
        time = np.asarray(fit.time_s, float)
        self._t0, self._t1 = float(time[0]), float(max(time[-1], time[0] + 1e-3))
        self._plot = (round(height * 0.20), round(height * 0.61))
        self._rows = {"left": round(height * 0.73), "right": round(height * 0.885)}
        self._picture = np.full((height, width, 3), _PAPER, np.uint8)
        self._draw_knees(fit, time)
        self._draw_contacts(events)

    def frame(self, time_s: float) -> np.ndarray:
        """The strip with the cursor at `time_s`."""
        picture = self._picture.copy()
        x = round(float(self._x(time_s)))
        cv2.line(picture, (x, self._plot[0] - 2), (x, self._height - 2), _INK, 1, cv2.LINE_AA)
        self._text(picture, f"{time_s:.2f} s", (self._right, round(self._height * 0.13)), _INK, right=True)
        return picture

    def _draw_knees(self, fit: TrialFit, time: np.ndarray) -> None:
        top, bottom = self._plot
        angles = joint_angles(fit.joint_names, fit.observed_qpos)
        curves = {s: angles[f"knee_flexion_{s[0]}"] for s in ("left", "right") if f"knee_flexion_{s[0]}" in angles}
        seen = np.concatenate([c[np.isfinite(c)] for c in curves.values()] or [np.zeros(0)])
        high = max(70.0, float(seen.max(initial=0.0)))
        low = min(0.0, float(seen.min(initial=0.0)))

        def y(deg: np.ndarray | float) -> np.ndarray:
            return bottom - (np.asarray(deg, float) - low) / (high - low) * (bottom - top)

        for tick in (0, 60):
            row = round(float(y(tick)))
            cv2.line(self._picture, (self._left, row), (self._right, row), _GRID, 1)
            self._text(
                self._picture, f"{tick}\N{DEGREE SIGN}", (self._left - 5, row + self._text_px // 3), _FAINT, True
            )
        title_row = round(self._height * 0.13)
        end = self._text(self._picture, "Knee flexion", (self._left, title_row), _INK)
        for side in ("left", "right"):
            end = self._text(self._picture, side, (end + self._text_px, title_row), bgr(SIDE_COLOUR[side]), weight=600)
        for side, curve in curves.items():
            points = np.stack([self._x(time), y(curve)], axis=-1)
            for run in runs(np.isfinite(points).all(axis=1)):
                corners = np.rint(points[run] * 16).astype(np.int32)
                cv2.polylines(self._picture, [corners], False, bgr(SIDE_COLOUR[side]), 2, cv2.LINE_AA, 4)

    def _draw_contacts(self, events: Sequence[GaitEvent]) -> None:
        half = max(2, round(self._height * 0.04))
        for side, row in self._rows.items():
            colour = bgr(SIDE_COLOUR[side])
            self._text(self._picture, side[0].upper(), (self._left - 6, row + self._text_px // 3), colour, True, 600)
            cv2.line(self._picture, (self._left, row), (self._right, row), _GRID, 1)
            pale = tuple(int(c + (255 - c) * 0.45) for c in colour)
            for t0, t1 in stance_spans(events, side):
                a, b = (round(float(v)) for v in self._x(np.array([t0, t1])))
                cv2.rectangle(self._picture, (a, row - half), (b, row + half), pale, -1)
            for e in events:
                if e.side == side:
                    x, sign = round(float(self._x(e.time_s))), 1 if e.event == "foot_down" else -1
                    cv2.line(self._picture, (x, row - half), (x, row + half), colour, 2)
                    # A small triangle that points to the ground line: from above for down, from below for up.
                    base, tip = row - sign * (2 * half), row - sign * half
                    corners = np.array([[x - half, base], [x + half, base], [x, tip]], np.int32)
                    cv2.fillConvexPoly(self._picture, corners, colour, cv2.LINE_AA)

    def _x(self, time_s: np.ndarray | float) -> np.ndarray:
        part = (np.asarray(time_s, float) - self._t0) / (self._t1 - self._t0)
        return self._left + part * (self._right - self._left)

    def _text(
        self,
        picture: np.ndarray,
        text: str,
        at: tuple[int, int],
        colour: tuple[int, int, int],
        right: bool = False,
        weight: int = 400,
    ) -> int:
        """Write `text` with its base line at `at` (left end, or right end if `right`); return the x of its end."""
        flags = cv2.PUT_TEXT_ALIGN_RIGHT if right else cv2.PUT_TEXT_ALIGN_LEFT
        end, _ = cv2.putText(picture, text, at, colour, self._font, self._text_px, weight, flags)
        return int(end[0])
