"""Perspective-correct crops: the picture of a camera at the same position that looks straight at the person.

A crop that is only cut out of the picture shows a person at the edge turned and stretched, and distorted by the lens.
The virtual camera is at the position of the real one, turned so that the middle of the crop is on its optical axis, may
be rolled and mirrored, and has no distortion. The mapping back is exact: a pixel of the crop is a ray, a ray is a pixel
of the picture; 3D points are turned back.

Test-time augmentations show the crop several times, slightly changed. Scale, rotation and gamma are those of MeTRAbs
(Sarandi et al. 2023, WACV, and its published PyTorch code), so that the spread of its results is the one for which the
paper states its confidence.

A network does not know the position of a crop in the picture. Except for a slight stretch, the crop is the picture of a
camera that looks straight at its centre and is rolled with it, and the 3D points are in that camera's frame. A person
at the edge of a wide picture is seen at up to 30 degrees from the optical axis, and without this rotation would seem to
turn while she walks straight on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.special import expit

from pbl_pipeline.video import Camera, turning_radius2, viewing_ray


def crop_matrix(roi_px: np.ndarray, size: int) -> np.ndarray:
    """(2, 3) matrix from continuous crop coordinates (0..size, from the crop's edge) to picture pixels.

    `roi_px` (4,): centre x, centre y, side, rotation (rad, clockwise in the picture).
    """
    x, y, side, rotation = roi_px
    cosine, sine = np.cos(rotation), np.sin(rotation)
    turn = np.array([[cosine, -sine], [sine, cosine]]) * (side / size)
    return np.column_stack([turn, np.array([x, y]) - turn @ [size / 2, size / 2]])


def view_rotation(roi_px: np.ndarray, camera: Camera) -> np.ndarray:
    """(3, 3) rotation from the axes of the crop's virtual camera to the camera frame.

    The virtual camera looks along the ray through the crop's centre; its down axis is seen in the picture as the
    crop's down direction. At the principal point it is the crop's roll alone.
    """
    centre = np.asarray(roi_px[:2], np.float64)
    down_px = np.array([-np.sin(roi_px[3]), np.cos(roi_px[3])])
    ray, below = viewing_ray(np.stack([centre, centre + down_px]), camera)
    z = ray / np.linalg.norm(ray)
    y = (below - ray) - z * (z @ (below - ray))
    y /= np.linalg.norm(y)
    x = y[[1, 2, 0]] * z[[2, 0, 1]] - y[[2, 0, 1]] * z[[1, 2, 0]]  # np.cross takes longer than the rest of the function
    return np.array([x, y, z]).T


#: Largest rotation to either side (deg); scales; least and largest exponent of gamma.
_ROTATION_DEG = 25.0
_SCALES = (0.8, 1.0, 1.1)
_GAMMAS = (0.6, 1.0)


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """Scale of the content, clockwise roll, exchange of left and right, and exponent of values from 0 to 1."""

    scale: float = 1.0
    roll_rad: float = 0.0
    mirrored: bool = False
    gamma: float = 1.0


def augmentations(n: int) -> tuple[Augmentation, ...]:
    """Return `n` fixed augmentations; `n` = 1 is the crop as it is, 2 also its mirror image.

    From 3 on: rotations evenly from -25 to 25 deg, scales from 0.8 to 1.1, gamma from 0.6 to 1, every other mirrored.
    """
    if n < 1:
        raise ValueError(f"{n} augmentations")
    if n <= 2:
        return (Augmentation(), Augmentation(mirrored=True))[:n]
    half = n // 2
    low, middle, high = _SCALES
    scale = np.concatenate([np.linspace(low, middle, half, endpoint=False), np.linspace(middle, high, n - half)])
    roll = np.radians(np.linspace(-_ROTATION_DEG, _ROTATION_DEG, n))
    gamma = np.linspace(*_GAMMAS, n)
    mirrored = (np.arange(n) - half) % 2 != 0
    values = zip(scale, roll, mirrored, gamma, strict=True)
    return tuple(Augmentation(float(s), float(r), bool(m), float(g)) for s, r, m, g in values)


def sd_confidence(sigma_mm: np.ndarray, half_mm: float = 30.0, width_mm: float = 10.0) -> np.ndarray:
    """c = 1 / (1 + exp((sigma - half) / width)): 0.5 at 30 mm (the paper, section Keypoint Detection).

    `sigma_mm` is the standard deviation of a 3D point over the augmentations (`spread_mm`).
    """
    return expit((half_mm - np.asarray(sigma_mm, np.float64)) / width_mm)


def aligned(xyz: np.ndarray) -> np.ndarray:
    """Shift each of the results (..., A, J, 3) onto the others, without rotation.

    The network returns a shape, not a position. First the means of all points are made equal, then the median deviation
    from the mean result is subtracted on each axis, so that a few outliers do not move the others.
    """
    centred = xyz - xyz.mean(axis=-2, keepdims=True)
    off = centred - centred.mean(axis=-3, keepdims=True)
    return centred - np.median(off, axis=-2, keepdims=True)


def spread_mm(xyz_m: np.ndarray) -> np.ndarray:
    """(..., J) standard deviation in mm of aligned results (..., A, J, 3) in m: the root mean square distance from
    their mean over the A results; 0 for one result."""
    off = xyz_m - xyz_m.mean(axis=-3, keepdims=True)
    return 1000.0 * np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=-2))


#: Picture pixels per crop pixel from which the picture is averaged before it is sampled.
_SHRINK_FROM = 1.5
#: Shortest distance in the picture (px) over which its scale is measured.
_SHORTEST_PX = 4.0


@dataclasses.dataclass(frozen=True)
class VirtualCamera:
    """A crop's camera. Coordinates of the crop count from the centre of its first pixel."""

    matrix: np.ndarray  # (3, 3) intrinsics, principal point in the middle of the crop
    turn: np.ndarray  # (3, 3) x_crop = turn @ x_cam: a rotation, if `mirrored` followed by a reflection in x
    size_px: tuple[int, int]  # (width, height)
    mirrored: bool

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """(..., 3) rays of crop pixels (..., 2) in the real camera's frame."""
        flat = (np.asarray(xy, np.float64) - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        return np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1) @ self.turn

    def to_picture(self, xy: np.ndarray, camera: Camera) -> np.ndarray:
        """(..., 2) pixels of the upright, distorted picture that show the crop pixels (..., 2)."""
        rays = self.rays(xy).reshape(-1, 1, 3)
        zero = np.zeros(3)
        out, _ = cv2.projectPoints(rays, zero, zero, *_lens(camera))
        return out.reshape(np.shape(xy))

    def to_camera(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) vectors of the crop's frame in the real camera's frame."""
        return np.asarray(xyz, np.float64) @ self.turn


def look_at(
    roi_px: np.ndarray,
    camera: Camera,
    size_px: tuple[int, int],
    margin: float = 1.0,
    scale: float = 1.0,
    roll_rad: float = 0.0,
    mirrored: bool = False,
) -> VirtualCamera:
    """Virtual camera of a region of the picture.

    `roi_px` (4,) centre x, centre y, side, rotation (rad, clockwise) as in `tracking.Detection`. The region, `margin`
    times as large, fills the longer side of the crop of `size_px` (width, height); `scale` enlarges the content, and
    `roll_rad` turns it clockwise in the crop.
    """
    width, height = size_px
    turn = view_rotation(roi_px, camera).T
    cosine, sine = np.cos(roll_rad), np.sin(roll_rad)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]]) @ turn
    if mirrored:
        turn = np.diag([-1.0, 1.0, 1.0]) @ turn
    focal = max(width, height) * scale / (margin * roi_px[2] * _per_pixel(roi_px, camera))
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return VirtualCamera(matrix, turn, (width, height), mirrored)


def crops(image: np.ndarray, views: Sequence[VirtualCamera], camera: Camera) -> np.ndarray:
    """(N, height, width, 3) uint8: the picture (H, W, 3) seen by the virtual cameras, which have one size.

    Black beyond the picture and beyond the validity of the lens model. A picture that is reduced is averaged first, so
    that fine patterns do not flicker.
    """
    width, height = views[0].size_px
    matrix, distortion = _lens(camera)
    maps = [
        cv2.initUndistortRectifyMap(matrix, distortion, v.turn, v.matrix, (width, height), cv2.CV_32FC1) for v in views
    ]
    reach = np.sqrt(turning_radius2(camera))  # beyond it the picture would appear a second time
    if np.isfinite(reach):
        for view, (map_x, map_y) in zip(views, maps, strict=True):
            _blank(map_x, map_y, view, reach)
    steps = [_step(v, camera) for v in views]
    out = np.zeros((len(views), height, width, 3), np.uint8)
    for factor in sorted({_factor(s) for s in steps}):
        chosen = [i for i, s in enumerate(steps) if _factor(s) == factor]
        small, corner = _shrunk(image, [maps[i] for i in chosen], factor)
        for i in chosen:
            map_x, map_y = ((m - c + 0.5) / factor - 0.5 for m, c in zip(maps[i], corner, strict=True))
            cv2.remap(small, map_x, map_y, cv2.INTER_LINEAR, out[i], cv2.BORDER_CONSTANT)
    return out


def _lens(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and distortion in OpenCV's type."""
    return np.asarray(camera.matrix, np.float64), np.asarray(camera.distortion, np.float64)


def _per_pixel(roi_px: np.ndarray, camera: Camera) -> float:
    """Length on the virtual camera's plane z = 1 of one pixel along the region's down axis, at its middle."""
    centre, down = roi_px[:2], np.array([-np.sin(roi_px[3]), np.cos(roi_px[3])])
    half = max(float(roi_px[2]) / 8, _SHORTEST_PX)
    ends = np.stack([centre - half * down, centre + half * down])
    rays = viewing_ray(ends, camera) @ view_rotation(roi_px, camera)
    flat = rays[:, :2] / rays[:, 2:]
    return float(np.linalg.norm(flat[1] - flat[0])) / (2 * half)


def _blank(map_x: np.ndarray, map_y: np.ndarray, view: VirtualCamera, reach: float) -> None:
    """Send the pixels beyond the lens model's reach outside the picture."""
    width, height = view.size_px
    corners = view.rays(np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]]))
    if np.all(corners[:, 2] > 0) and np.max(np.hypot(*corners[:, :2].T) / corners[:, 2]) < reach:
        return
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays = view.rays(np.stack([x, y], axis=-1))
    lost = (rays[..., 2] <= 0) | (np.hypot(rays[..., 0], rays[..., 1]) >= reach * rays[..., 2])
    map_x[lost] = map_y[lost] = -1e6


def _step(view: VirtualCamera, camera: Camera) -> float:
    """Pixels of the picture per pixel of the crop, at its middle."""
    ends = view.matrix[:2, 2] + np.array([[-1.0, 0.0], [1.0, 0.0]])
    a, b = view.to_picture(ends, camera)
    return float(np.linalg.norm(b - a)) / 2


def _factor(step: float) -> int:
    """Number of pixels of the picture that are averaged into one before the crop is sampled."""
    return round(step) if step >= _SHRINK_FROM else 1


def _shrunk(
    image: np.ndarray, maps: Sequence[tuple[np.ndarray, np.ndarray]], factor: int
) -> tuple[np.ndarray, tuple[float, float]]:
    """Part of the picture that the maps need, `factor` times smaller, and its corner (x, y) in the picture."""
    if factor == 1:
        return image, (0.0, 0.0)
    height, width = image.shape[:2]
    x0, y0 = (max(int(min(np.min(m[k], initial=0, where=m[k] > -1e5) for m in maps)) - factor, 0) for k in (0, 1))
    x1, y1 = (
        min(int(max(np.max(m[k], initial=0, where=m[k] > -1e5) for m in maps)) + 2 * factor, n)
        for k, n in ((0, width), (1, height))
    )
    # Whole blocks from the corner on, without a narrower rim.
    w, h = max((x1 - x0) // factor, 1), max((y1 - y0) // factor, 1)
    part = image[y0 : y0 + h * factor, x0 : x0 + w * factor]
    if part.size == 0:
        return np.zeros((1, 1, 3), np.uint8), (0.0, 0.0)
    return cv2.resize(part, (w, h), interpolation=cv2.INTER_AREA), (float(x0), float(y0))
