"""Films a flat board with a known lens: every pixel's ray is met with the board's plane, four rays a pixel."""

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.video import Board

#: Rays along and across each pixel.
_FINE = 2


def film(
    board: Board, matrix: np.ndarray, distortion: np.ndarray, size: tuple[int, int], poses: list, seed: int = 1
) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 pictures of `board` (white margin, grey behind) for poses (rotation, place of its middle, m)."""
    per_square = 40
    printed = np.pad(board.picture(per_square), per_square, constant_values=255)
    printed = cv2.GaussianBlur(printed, (0, 0), 1.0)
    m_per_px = board.square_mm / 1000 / per_square
    width, height = size
    fine = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    u, v = np.meshgrid((np.arange(width)[:, None] + fine).ravel(), (np.arange(height)[:, None] + fine).ravel())
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    points = np.stack([u.ravel(), v.ravel()], 1).reshape(-1, 1, 2).astype(np.float64)
    rays = cv2.undistortPoints(points, matrix, distortion, criteria=stop)
    rng = np.random.default_rng(seed)
    middle = np.array(printed.shape[::-1]) / 2 - 0.5
    for R, t in poses:
        # A ray r meets the board at depth R_z.t / R_z.r: a projective map of rays to places in `printed`.
        to_board = np.outer(R[:, :2].T @ t, -R[:, 2]) + (R[:, 2] @ t) * R[:, :2].T
        place = cv2.perspectiveTransform(rays, np.vstack([to_board / m_per_px + np.outer(middle, R[:, 2]), R[:, 2]]))
        place = place.reshape(*u.shape, 2).astype(np.float32)
        seen = cv2.remap(printed, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110)  # type: ignore[call-overload]
        seen = cv2.resize(seen, size, interpolation=cv2.INTER_AREA).astype(np.float64)
        noisy = np.clip(0.8 * seen + 20 + rng.normal(0, 2, seen.shape), 0, 255).astype(np.uint8)
        yield cv2.merge([noisy] * 3)


def varied_poses(
    board: Board,
    matrix: np.ndarray,
    size: tuple[int, int],
    n: int,
    tilt_deg: float = 35,
    spread: float = 1.0,
    seed: int = 3,
) -> list:
    """`n` poses in which the whole board is (nearly) in the picture, from near to far, over its whole area."""
    rng = np.random.default_rng(seed)
    long_m = max(board.squares) * board.square_mm / 1000
    poses = []
    for k in range(n):
        turn = np.radians(tilt_deg) * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0]) * rng.uniform(0.4, 1)
        turn[2] = np.radians(rng.uniform(-20, 20))
        depth = matrix[0, 0] * long_m / (size[0] * rng.uniform(0.4, 0.7))
        room = (np.array(size) - size[0] * 0.5) / 2 + 0.12 * size[0]
        off = spread * rng.uniform(-1, 1, 2) * np.maximum(room, 0.12 * np.array(size))
        place = np.array([*(off / np.diag(matrix)[:2] * depth), depth])
        poses.append((Rotation.from_rotvec(turn).as_matrix(), place))
    return poses
