"""World points to pixels of one frame, for drawing: plain numpy, no gradients."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.video import Camera

#: Nothing nearer to the camera than this is drawn (m): the pinhole equations grow without bound there.
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
    behind the camera, and for points so far off the axis that the radial polynomial turns back: beyond that angle the
    polynomial is no lens, and it would fold the point into the picture.
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


def scaled_camera(camera: Camera, factor_x: float, factor_y: float) -> Camera:
    """The camera of a picture resized by these factors. Pixel centres are whole numbers, hence the half pixels."""
    m = np.array(camera.matrix, float)
    m[0] *= factor_x
    m[1] *= factor_y
    m[0, 2] += 0.5 * (factor_x - 1)
    m[1, 2] += 0.5 * (factor_y - 1)
    return Camera(m, camera.distortion, camera.source)


def turning_radius2(camera: Camera) -> float:
    """Squared normalised radius where r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing; inf where it never does."""
    k1, k2, _, _, k3 = np.asarray(camera.distortion, float)
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return float(min(real[real > 0], default=np.inf))
