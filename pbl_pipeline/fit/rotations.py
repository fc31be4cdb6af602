"""Rotations over time on the host."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


def rotation_matrices(time_s: np.ndarray, quat_wxyz: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """(T, 3, 3) at `at_s`, turned evenly between the samples (P,), (P, 4); the nearest sample's beyond the ends."""
    turn = Slerp(time_s, Rotation.from_quat(quat_wxyz, scalar_first=True))
    return turn(np.clip(at_s, time_s[0], time_s[-1])).as_matrix()


def quat_wxyz(R: np.ndarray) -> np.ndarray:
    """(T, 4) quaternions of (T, 3, 3), without jumps of sign from one to the next."""
    q = Rotation.from_matrix(R, assume_valid=True).as_quat(scalar_first=True)
    same = np.sign(np.sum(q[1:] * q[:-1], axis=1))
    q[1:] *= np.cumprod(np.where(same == 0, 1.0, same))[:, None]
    return q
