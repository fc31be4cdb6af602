"""Where a person is whose shape is known in metres and whose points are seen in the picture."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.video import Camera, viewing_ray

#: Fewest points that fix a place.
MIN_POINTS = 4
#: Distance at which a point counts half, as a length at the person's distance (m), which is the same in a picture of
#: any size: 5 px of one of 1080 x 1920 from 4.5 m. And rounds of reweighting: first with Huber's weights, which find
#: their way from anywhere, then with Cauchy's, which let go of points that are far off.
HALF_M, _OLD_HALF_PX = 0.015, 5.0
_ROUNDS = (8, 8)
#: Nearest that a point may be to the camera (m).
_NEAREST_M = 0.1


def absolute_root(
    xyz_m: np.ndarray, xy_px: np.ndarray, confidence: np.ndarray, camera: Camera, half_m: float = HALF_M
) -> np.ndarray:
    """(T, 3) shift in m that puts points (T, J, 3), right but for one shift, where their pixels (T, J, 2) see them.

    Least squares on ``(x + tx) - u (z + tz)`` and the same for y, u and v being the ray of the pixel without
    distortion, linear in the shift. Repeated with weights that divide by the depth, so that distances count as seen in
    the picture, and that fall with a point's distance in the picture from where the last shift puts it (Cauchy's, half
    at `half_m`; 0: at 5 px of the file, as before 0.2). `confidence` (T, J) weighs the points. NaN where fewer than
    four have one, or where the person would stand behind the camera.
    """
    xyz, weight0 = np.asarray(xyz_m, np.float64), np.asarray(confidence, np.float64)
    known = np.isfinite(xyz).all(axis=2) & np.isfinite(xy_px).all(axis=2) & (weight0 > 0)
    xyz, weight0 = np.where(known[..., None], xyz, 0.0), np.where(known, weight0, 0.0)
    pixels = np.where(known[..., None], xy_px, camera.matrix[:2, 2])
    rays = viewing_ray(pixels.reshape(-1, 2), camera).reshape(*xyz.shape)[..., :2]
    focal = float(np.mean(camera.matrix[[0, 1], [0, 1]]))
    out = np.full((len(xyz), 3), np.nan)
    rows = np.flatnonzero(known.sum(axis=1) >= MIN_POINTS)
    x, d, w = xyz[rows], rays[rows], weight0[rows]
    shift = _solve(x, d, w)
    for number in range(sum(_ROUNDS)):
        z = np.maximum(x[..., 2] + shift[:, None, 2], _NEAREST_M)
        off = focal * np.linalg.norm((x[..., :2] + shift[:, None, :2]) / z[..., None] - d, axis=-1)
        far = off * z / (focal * half_m) if half_m else off / _OLD_HALF_PX
        robust = np.minimum(1.0, 1 / np.maximum(far, 1e-9)) if number < _ROUNDS[0] else 1 / (1 + far**2)
        shift = _solve(x, d, w * robust / z**2)
    before = np.min(np.where(known[rows], x[..., 2] + shift[:, None, 2], np.inf), axis=1) > _NEAREST_M
    out[rows[before]] = shift[before]
    return out


def _solve(x: np.ndarray, d: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Weighted least squares: rows (1, 0, -u) and (0, 1, -v), right sides u z - x and v z - y."""
    normal = np.zeros((len(x), 3, 3))
    normal[:, 0, 0] = normal[:, 1, 1] = w.sum(axis=1)
    normal[:, :2, 2] = normal[:, 2, :2] = -np.einsum("tj,tjk->tk", w, d)
    normal[:, 2, 2] = np.einsum("tj,tjk->t", w, d**2)
    right = d * x[..., 2:] - x[..., :2]
    b = np.concatenate([np.einsum("tj,tjk->tk", w, right), -np.einsum("tj,tjk,tjk->t", w, d, right)[:, None]], axis=1)
    scale = np.maximum(w.sum(axis=1), 1e-300)[:, None, None]
    return np.linalg.solve(normal / scale + 1e-12 * np.eye(3), (b / scale[..., 0])[..., None])[..., 0]
