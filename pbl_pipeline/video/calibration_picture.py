"""A picture of a calibration: where the board was seen, how far the fit is off, what the lens does to lines."""

from __future__ import annotations

import cv2
import numpy as np

from .calibrate import CELLS, Calibration

#: Longer side of the picture (px) and by how much residuals are drawn larger.
_SIDE_PX, _ENLARGED = 900, 50.0
_INK, _GRID, _SEEN, _OFF = (60, 60, 60), (225, 225, 225), (170, 120, 40), (40, 60, 200)


def draw_calibration(found: Calibration) -> np.ndarray:
    """(H, W, 3) uint8 BGR: corners as dots, residuals as strokes 50 times longer, empty cells shaded, and a grid that
    would be straight without distortion."""
    scale = _SIDE_PX / max(found.image_size_px)
    width, height = (round(n * scale) for n in found.image_size_px)
    picture = np.full((height, width, 3), 255, np.uint8)
    xy = np.concatenate([v.xy_px for v in found.views])
    cell = np.clip((xy + 0.5) / found.image_size_px * CELLS, 0, np.array(CELLS) - 1).astype(int)
    seen = {(int(a), int(b)) for a, b in cell}
    for i in range(CELLS[0]):
        for j in range(CELLS[1]):
            if (i, j) not in seen:
                low = (round(i * width / CELLS[0]), round(j * height / CELLS[1]))
                high = (round((i + 1) * width / CELLS[0]), round((j + 1) * height / CELLS[1]))
                cv2.rectangle(picture, low, high, (235, 235, 250), -1)
    _draw_grid(picture, found, scale)
    for view, residual in zip(found.views, found.residual_px, strict=True):
        for place, off in zip(view.xy_px, residual, strict=True):
            start = _at(place, scale)
            cv2.line(picture, start, _at(place + _ENLARGED * off, scale), _OFF, 1, cv2.LINE_AA)
            cv2.circle(picture, start, 2, _SEEN, -1, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), _INK, 1)
    foot = np.full((64, width, 3), 255, np.uint8)
    focal, sd = found.camera.focal_px, found.focal_sd_px
    for row, text in enumerate(
        (
            f"{len(found.views)} views, corners in {found.coverage:.0%} of the cells (shaded: none)",
            f"focal length {focal:.1f} +- {sd:.1f} px, rms {found.rms_px:.2f} px (strokes x{_ENLARGED:.0f})",
        )
    ):
        cv2.putText(foot, text, (10, 26 + 26 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return np.vstack([picture, foot])


def _draw_grid(picture: np.ndarray, found: Calibration, scale: float) -> None:
    matrix, distortion = found.camera.matrix, found.camera.distortion
    width, height = found.image_size_px
    for fixed, count, length in ((0, 9, height), (1, 9, width)):
        for place in np.linspace(0, (width, height)[fixed], count):
            line = np.empty((60, 2))
            line[:, fixed], line[:, 1 - fixed] = place, np.linspace(0, length, 60)
            rays = np.column_stack([(line - matrix[:2, 2]) / np.diag(matrix)[:2], np.ones(60)])
            bent, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, distortion)
            points = np.round(bent.reshape(-1, 2) * scale).astype(np.int32)
            cv2.polylines(picture, [points.reshape(-1, 1, 2)], False, _GRID, 1, cv2.LINE_AA)


def _at(place: np.ndarray, scale: float) -> tuple[int, int]:
    return round(float(place[0]) * scale), round(float(place[1]) * scale)
