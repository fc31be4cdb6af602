"""Camera intrinsics and poses: from a calibration file, of one or several cameras, or a stated guess.

Pixel coordinates have (0, 0) at the centre of the top-left pixel, as in OpenCV.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.bounded import read_json, read_toml
from pbl_pipeline.errors import PblError
from pbl_pipeline.results.video_facts import VideoInfo

from .types import Camera

#: Largest deviation of R R^T from 1: float32 poses pass, a scaled or mistyped matrix does not.
_ORTHONORMAL_TOL = 1e-4
_invalid_pose = functools.partial(
    PblError,
    "CAMERA_INVALID",
    next_step="write the calibration again; docs/files.md, section several cameras, describes the format",
)


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
            raise _invalid_pose(
                f"values that are not numbers ({error})", "R_nc (3, 3) and p_nc (3,)", key=None
            ) from error
        if R.shape != (3, 3) or p.shape != (3,):
            raise _invalid_pose(f"R_nc of shape {R.shape}, p_nc of shape {p.shape}", "shapes (3, 3) and (3,)", key=None)
        if not np.isfinite(R).all() or not np.isfinite(p).all():
            raise _invalid_pose("a camera pose that is not finite", "finite numbers", key=None)
        if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL_TOL or np.linalg.det(R) < 0:
            raise _invalid_pose(f"R_nc {R.tolist()}", "a rotation: orthonormal, determinant +1", key=None)
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
    cameras = _cameras(_content(path, read_toml, "a TOML calibration", _invalid_pose))
    if not cameras:
        raise _invalid_pose("no table with a camera matrix", "a table for each camera", key=path)
    poses = {}
    for name, table in cameras.items():
        about = f"{path} [{name}]"
        R_cn = Rotation.from_rotvec(_array(about, table, "rotation", (3,), _invalid_pose)).as_matrix()
        poses[name] = CameraPose(R_cn.T, -R_cn.T @ _array(about, table, "translation", (3,), _invalid_pose))
    return poses


def _content(path: Path, read: Callable[[Path], Any], expected: str, invalid: Callable[..., PblError]) -> Any:
    try:
        return read(path)
    except OSError as error:
        raise invalid(f"the file cannot be read ({error.strerror})", expected, key=path) from error
    except ValueError as error:
        raise invalid(f"the text cannot be parsed ({error})", expected, key=path) from error


def _cameras(content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    return {name: table for name, table in content.items() if isinstance(table, dict) and "matrix" in table}


#: Focal length over the longer side of the picture: median, least and most of the 78 iPhone calibrations (38 models,
#: identifiers iPhone8,1 to iPhone17,5; 25 distinct values; video of 720 and 2160 lines) published with OpenCap
#: (stanfordnmbl/opencap-core, commit d5a5258, Apache-2.0; Uhlrich et al. 2023, PLoS Comput Biol 19(10):e1011462).
#: Their mean is 0.728, their standard deviation 0.044.
PHONE_FOCAL_OVER_LONG_SIDE = 0.7169
PHONE_FOCAL_RANGE = (0.6655, 0.8452)
#: Root mean square distance of the 25 distinct values from that median, as a fraction of it (0.067). Other phones,
#: lenses and zooms may differ more; by how much was not measured.
PHONE_FOCAL_REL_SD = 0.07

#: Focal lengths over the longer side of the picture: a view of 175 to one of 0.06 degrees.
_FOCAL_RANGE = (0.02, 1000.0)
#: A principal point that lies off the middle of the picture by one factor on both axes, alike within the second number
#: and more than the first, is that of a picture of another size. (A cropped picture is off on one axis, or unlike.)
_OTHER_SIZE, _ALIKE = 0.2, 0.05
#: Largest factor by which the distortion of a lens may move a corner outwards.
_MOST_STRETCH = 2.0

_invalid = functools.partial(
    PblError,
    "CAMERA_INVALID",
    next_step="correct the file, or leave it out: then a phone's field of view is assumed, and the result states that",
)


def guess_camera(video: VideoInfo | tuple[int, int]) -> Camera:
    """Intrinsics of a typical phone's main camera for a probed video or an upright (width, height) in px.

    Focal length `PHONE_FOCAL_OVER_LONG_SIDE` times the longer side (70 degrees along it), principal point in the
    middle, no distortion. `source` begins with "guess" and states the spread of the published values. A zoomed or
    cropped recording (digital zoom, strong stabilisation, a telephoto lens) has a longer focal length than any of them.
    `find_camera` asks the file first.
    """
    width, height = (video.width_px, video.height_px) if isinstance(video, VideoInfo) else video
    if width <= 0 or height <= 0:
        raise ValueError(f"a picture of {width}x{height} px")
    focal = PHONE_FOCAL_OVER_LONG_SIDE * max(width, height)
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    low, high = (100 * (f / PHONE_FOCAL_OVER_LONG_SIDE - 1) for f in PHONE_FOCAL_RANGE)
    angle = math.degrees(2 * math.atan(0.5 / PHONE_FOCAL_OVER_LONG_SIDE))
    source = (
        f"guess: a phone's main camera, {angle:.0f} deg along the longer side (focal length {focal:.0f} px, median of "
        f"78 published iPhone calibrations, which lie {low:.0f} to +{high:.0f} % from it; no distortion; "
        "wrong for zoomed or cropped video)"
    )
    return Camera(matrix, np.zeros(5), source, PHONE_FOCAL_REL_SD)


def load_camera(path: str | Path, image_size_px: tuple[int, int], name: str | None = None) -> Camera:
    """Intrinsics from a calibration file, for the upright picture of `image_size_px` (width, height).

    Two formats are read: the TOML of Pose2Sim and Sports2D, a table per camera with `size` [width, height], `matrix`
    and `distortions`; and JSON with `camera_matrix`, `distortion` and `image_size_px` [width, height]. Distortion is
    OpenCV's k1 k2 p1 p2 [k3]. If the recording is larger or smaller than the calibrated picture by one factor for
    both sides, the matrix is scaled. `name` chooses the camera of a TOML that holds several. The JSON may state the
    standard deviation of the focal length, `focal_sd_px` (`pbl calibrate` does).

    Raises `PblError` CAMERA_INVALID: the file cannot be read, a field is missing or not usable, the model is a fisheye,
    several cameras and none chosen, or a picture of another shape (cropped or turned, which no factor describes).
    """
    path = Path(path)
    label, fields = _read(path, name)
    matrix = _array(path, fields, "matrix", (9,)).reshape(3, 3)
    distortion = _array(path, fields, "distortion", (4, 5))
    width, height = _array(path, fields, "size", (2,)).tolist()
    if fields.get("fisheye"):
        raise _invalid("a fisheye model", "a pinhole camera with k1 k2 p1 p2 k3 distortion", key=path)
    if min(width, height) <= 0:
        raise _invalid(f"a picture of {width:g}x{height:g} px", "width and height above 0", key=path)
    distortion = np.concatenate([distortion, np.zeros(5 - len(distortion))])
    check_lens(matrix, distortion, (width, height), path)
    rel_sd, spread = math.nan, ""
    if fields.get("focal_sd") is not None:
        rel_sd = float(_array(path, fields, "focal_sd", (1,))[0]) * 2 / (matrix[0, 0] + matrix[1, 1])
        if rel_sd < 0:
            raise _invalid(f"focal_sd_px = {fields['focal_sd']!r}", "a standard deviation in px, 0 or more", key=path)
        spread = f", focal length within {100 * rel_sd:.2g} % (sd)"
    matrix, scaled = _scale(path, matrix, (width, height), image_size_px)
    return Camera(matrix, distortion, f"file: {label}{scaled}{spread}", rel_sd)


def _read(path: Path, name: str | None) -> tuple[str, Mapping[str, Any]]:
    """The label of the camera and its fields under the names matrix, distortion, size, fisheye."""
    read = read_toml if path.suffix.lower() == ".toml" else read_json
    content = _content(path, read, "a TOML or JSON calibration", _invalid)
    if not isinstance(content, dict):
        raise _invalid("no named fields", "a table of fields", key=path)
    if read is read_json:
        names = {"camera_matrix": "matrix", "distortion": "distortion", "image_size_px": "size", "fisheye": "fisheye"}
        names["focal_sd_px"] = "focal_sd"
        return path.name, {new: content[old] for old, new in names.items() if old in content}
    cameras = _cameras(content)
    if name is None and len(cameras) != 1:
        found = f"{len(cameras)} cameras" + (f" ({', '.join(cameras)})" if cameras else "")
        raise _invalid(found, "one camera, or the name of one of them", key=path)
    if name is not None and name not in cameras:
        raise _invalid(f"cameras {', '.join(cameras) or '(none)'}", f"a camera named {name}", key=path)
    key = name or next(iter(cameras))
    camera = cameras[key]
    fields = {"distortion": camera["distortions"]} if "distortions" in camera else {}
    return f"{path.name} [{key}]", camera | fields


def _array(
    key: object,
    fields: Mapping[str, Any],
    name: str,
    lengths: tuple[int, ...],
    invalid: Callable[..., PblError] = _invalid,
) -> np.ndarray:
    expected = f"{name}: {' or '.join(map(str, lengths))} finite numbers"
    if name not in fields:
        raise invalid(f"no field {name}", expected, key=key)
    try:
        value = np.asarray(fields[name], dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        value = np.array([])
    if len(value) not in lengths or not np.isfinite(value).all():
        raise invalid(f"{name} = {repr(fields[name])[:200]}", expected, key=key)
    return value


def _scale(
    path: Path, matrix: np.ndarray, calibrated: tuple[float, float], image_size_px: tuple[int, int]
) -> tuple[np.ndarray, str]:
    (width, height), (new_width, new_height) = calibrated, image_size_px
    factor = new_width / width
    if abs(new_height - factor * height) > 1.0:  # one pixel of rounding
        turned = abs(new_width - new_height / width * height) <= 1.0
        raise _invalid(
            f"calibrated for {width:g}x{height:g} px, the recording is {new_width}x{new_height} px"
            + (" (the picture is turned)" if turned else ""),
            "a calibration of the upright picture, of the same shape",
            key=path,
        )
    if factor == 1.0:
        return matrix, ""
    return scaled_matrix(matrix, factor), f", scaled by {factor:.4g} from {width:g}x{height:g} px"


def scaled_matrix(matrix: np.ndarray, factor: float | tuple[float, float]) -> np.ndarray:
    """The camera matrix (3, 3) of the same picture with `factor` times as many pixels, of both sides or of x, y."""
    factors, scaled = np.broadcast_to(factor, 2), np.array(matrix, float)
    scaled[:2] *= factors[:, None]
    scaled[:2, 2] += (factors - 1) / 2  # coordinates count from the first pixel's centre, sizes from its edge
    return scaled


def turning_radius2(camera: Camera) -> float:
    """Squared normalised radius where r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing; inf where it never does."""
    k1, k2, _, _, k3 = (float(k) for k in camera.distortion)
    return _turning_radius2(k1, k2, k3)


@functools.lru_cache(maxsize=8)
def _turning_radius2(k1: float, k2: float, k3: float) -> float:
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return float(min(real[real > 0], default=np.inf))


def check_lens(matrix: np.ndarray, distortion: np.ndarray, size_px: tuple[float, float], key: object = None) -> None:
    """Refuse an impossible lens: `matrix` (3, 3) px and `distortion` (5,) of an upright picture (width, height).

    Raises `PblError` CAMERA_INVALID: not finite, a skew, an implausible ratio of focal length to the picture's longer
    side (`_FOCAL_RANGE`), a principal point outside the picture or of a picture of another size, or a distortion that
    folds back before the corners of the picture or moves them by more than `_MOST_STRETCH`.
    """
    m, d = np.asarray(matrix, np.float64), np.asarray(distortion, np.float64)
    plain = m[0, 1] == m[1, 0] == m[2, 0] == m[2, 1] == 0 and m[2, 2] == 1
    if not np.isfinite(m).all() or not plain or min(m[0, 0], m[1, 1]) <= 0:
        raise _invalid(f"matrix {m.tolist()}", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx and fy positive", key=key)
    low, high = (f * max(size_px) for f in _FOCAL_RANGE)
    if not (low <= m[0, 0] <= high and low <= m[1, 1] <= high):
        found = f"focal lengths {m[0, 0]:g} and {m[1, 1]:g} px of a {size_px[0]:g}x{size_px[1]:g} px picture"
        raise _invalid(found, f"{low:g} to {high:g} px", key=key)
    _check_centre(m, size_px, key)
    if not np.isfinite(d).all():
        raise _invalid(f"distortion {d.tolist()}", "k1, k2, p1, p2, k3, finite; zeros for no distortion", key=key)
    radial = f"{d[0]:g}, {d[1]:g}, {d[4]:g}"
    corner, r, distorted = _to_corner(m, d, size_px)
    if not distorted[-1] >= corner:  # also where it overflows
        raise _invalid(
            f"radial distortion {radial} folds back before the corner of the picture",
            "coefficients k1 k2 p1 p2 k3 that hold over the whole picture",
            key=key,
        )
    straight = max(float(np.interp(corner, distorted, r)), 1e-9)
    if corner > _MOST_STRETCH * straight or 3 * np.hypot(d[2], d[3]) * straight > _MOST_STRETCH - 1:
        raise _invalid(
            f"distortion {radial} (radial), {d[2]:g}, {d[3]:g} (tangential) that moves the corner of the picture "
            f"more than {_MOST_STRETCH:g} times as far out",
            "coefficients k1 k2 p1 p2 k3 as a calibration finds them",
            key=key,
        )


def _check_centre(m: np.ndarray, size_px: tuple[float, float], key: object) -> None:
    """Refuse a matrix whose principal point shows that it belongs to another picture."""
    across, down = (float(2 * c / side) for c, side in zip(m[:2, 2], size_px, strict=True))
    outside = not (0 <= across <= 2 and 0 <= down <= 2)
    if outside or (min(abs(across - 1), abs(down - 1)) > _OTHER_SIZE and abs(across / down - 1) <= _ALIKE):
        width, height = size_px
        raise _invalid(
            f"principal point ({m[0, 2]:g}, {m[1, 2]:g}) in a picture of {width:g}x{height:g} px",
            f"a point near the middle ({width / 2:g}, {height / 2:g}); this matrix looks like that of a picture of "
            f"{across * width:.0f}x{down * height:.0f} px: multiply its first two rows by the ratio of the sizes",
            key=key,
        )


def reaches_corners(matrix: np.ndarray, distortion: np.ndarray, size_px: tuple[float, float]) -> bool:
    """True if the radial model reaches the corners before it turns back, beyond which points cannot be undistorted."""
    corner, _, distorted = _to_corner(matrix, distortion, size_px)
    return bool(distorted[-1] >= corner)


def _to_corner(
    matrix: np.ndarray, distortion: np.ndarray, size_px: tuple[float, float]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Distance of the farthest corner from the axis (focal lengths), distances (N,) of an ideal camera, and those of
    the radial model, up to where it turns back."""
    k1, k2, _, _, k3 = distortion
    width, height = size_px
    x = (np.array([0, width - 1, 0, width - 1]) - matrix[0, 2]) / matrix[0, 0]
    y = (np.array([0, 0, height - 1, height - 1]) - matrix[1, 2]) / matrix[1, 1]
    corner = float(np.hypot(x, y).max())
    r = np.linspace(0.0, 3.0 * max(corner, 1.0), 4000)
    distorted = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    turns = np.flatnonzero(np.diff(distorted) <= 0)
    end = int(turns[0]) + 1 if len(turns) else len(r)
    return corner, r[:end], distorted[:end]


def viewing_ray(xy_px: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 3) rays x/z, y/z, 1 of the picture points (N, 2), distortion removed."""
    points = np.asarray(xy_px, np.float64).reshape(-1, 1, 2)
    matrix, distortion = np.asarray(camera.matrix, np.float64), np.asarray(camera.distortion, np.float64)
    # OpenCV's five iterations leave an error of some tenths of a pixel with a wide lens.
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    flat = cv2.undistortPoints(points, matrix, distortion, criteria=stop)
    return np.column_stack([flat.reshape(-1, 2), np.ones(len(points))])


def undistort_px(xy_px: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels (..., 2) of the distorted picture as an ideal pinhole camera with the same matrix would see them."""
    if not np.any(camera.distortion):
        return np.asarray(xy_px, float)
    pinhole = viewing_ray(xy_px.reshape(-1, 2), camera) @ np.asarray(camera.matrix, np.float64).T
    return pinhole[:, :2].reshape(xy_px.shape)
