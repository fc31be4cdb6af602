"""Where a calibrated camera stands in the world, and the poses in a calibration file of several cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.bounded import read_toml
from pbl_pipeline.errors import PblError

#: How far R R^T may be from 1: float32 poses pass, a scaled or mistyped matrix does not.
_ORTHONORMAL_TOL = 1e-4


@dataclasses.dataclass(frozen=True)
class CameraPose:
    """Extrinsics of one camera, validated when made.

    Raises `PblError` CAMERA_INVALID: other shapes, not finite, R not a rotation.
    """

    R_nc: np.ndarray  # (3, 3) turns camera vectors (x right, y down, z forward) into world vectors (z up)
    p_nc: np.ndarray  # (3,) the camera's position in the world, m

    def __post_init__(self) -> None:
        try:
            R, p = np.array(self.R_nc, np.float64), np.array(self.p_nc, np.float64)
        except (TypeError, ValueError) as error:
            raise _invalid(None, f"values that are no numbers ({error})", "R_nc (3, 3) and p_nc (3,)") from error
        if R.shape != (3, 3) or p.shape != (3,):
            raise _invalid(None, f"R_nc of shape {R.shape}, p_nc of shape {p.shape}", "shapes (3, 3) and (3,)")
        if not np.isfinite(R).all() or not np.isfinite(p).all():
            raise _invalid(None, "a camera pose that is not finite", "finite numbers")
        if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL_TOL or np.linalg.det(R) < 0:
            raise _invalid(None, f"R_nc {R.tolist()}", "a rotation: orthonormal, determinant +1")
        R.setflags(write=False)
        p.setflags(write=False)
        object.__setattr__(self, "R_nc", R)
        object.__setattr__(self, "p_nc", p)


def load_camera_poses(path: str | Path) -> dict[str, CameraPose]:
    """Poses of all cameras of a Pose2Sim or Sports2D calibration (TOML), by the names of their tables, in its order.

    There `rotation` is the rotation vector (rad) and `translation` (m) of x_cam = R x_world + t, in a world with z up;
    so R_nc = R^T and p_nc = -R^T t. Checked on the multi-camera recording of the development data: with
    Calib_qualisys.toml the triangulated keypoints are its TRC to 0.1 mm, the TRC's y-up axes being
    (x, y, z)_trc = (y, z, x)_world; the other direction misses by metres.

    Raises `PblError` CAMERA_INVALID: the file cannot be read, holds no camera, a camera without `rotation` or
    `translation`, or values that are not three finite numbers.
    """
    path = Path(path)
    try:
        content = read_toml(path)
    except OSError as error:
        raise _invalid(path, f"the file cannot be read ({error.strerror})", "a TOML calibration") from error
    except ValueError as error:
        raise _invalid(path, f"the text cannot be parsed ({error})", "a TOML calibration") from error
    cameras = {name: table for name, table in content.items() if isinstance(table, dict) and "matrix" in table}
    if not cameras:
        raise _invalid(path, "no table with a camera matrix", "a table for each camera")
    return {name: _pose(path, name, table) for name, table in cameras.items()}


def _pose(path: Path, name: str, table: Mapping[str, Any]) -> CameraPose:
    vectors = []
    for field in ("rotation", "translation"):
        try:
            vector = np.asarray(table[field], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            vector = np.full(3, np.nan)
        if vector.shape != (3,) or not np.isfinite(vector).all():
            raise _invalid(path, f"[{name}] {field} = {table.get(field)!r}"[:200], f"{field}: 3 finite numbers")
        vectors.append(vector)
    R_cn = Rotation.from_rotvec(vectors[0]).as_matrix()
    return CameraPose(R_cn.T, -R_cn.T @ vectors[1])


def _invalid(path: Path | None, found: str, expected: str) -> PblError:
    return PblError(
        "CAMERA_INVALID",
        found=found,
        expected=expected,
        next_step="write the calibration again; docs/files.md, section several cameras, says what is read",
        key=None if path is None else str(path),
    )
