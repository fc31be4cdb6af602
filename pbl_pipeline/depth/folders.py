"""Depth pictures in folders: of the app Stray Scanner, and 16-bit PNG with a scale (Kinect, RealSense, ARKit).

Stray Scanner (github.com/strayrobots/scanner, docs/format.md) writes `depth/` (16-bit PNG, older versions npy, in mm),
`confidence/` (PNG, 0 to 2), `camera_matrix.csv` of the video, and `odometry.csv` with a time (s) and a quaternion (x,
y, z, w) for each frame, from the camera (x right, y down) to a world whose y is up. Its pictures lie as the sensor
does, wider than high; they are turned as the phone was held. Other folders may also hold `camera_matrix.csv`, and
`depth_matrix.csv` where the depth camera has another field of view.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import bounded
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.video import Camera, turned_camera

from .packed import Get, names_in, opened
from .recording import Depth, Pictures, check_count, depth_error

#: Bytes of a picture.
_MOST = 16 * bounded.MIB
_ENDS = (".png", ".npy")
#: Files of camera matrices: of the video's pictures, and of the depth pictures.
_MATRICES = "camera_matrix.csv", "depth_matrix.csv"
#: Least length of the world's vertical in the plane of the pictures: less, and the camera looks down or up.
_UPRIGHT = 0.5
#: Errors of a file that is missing, damaged or too large, and of numbers in it.
_UNREAD = (OSError, ValueError, KeyError, TypeError, cv2.error, *bounded.DAMAGED)


def read_folder(
    folder: Path, time_s: np.ndarray, size_px: tuple[int, int], scale_m: float | None, called: Path | None = None
) -> Depth:
    """Read a folder of depth pictures, or its zip, in the order of the numbers in their names. `scale_m`: metres of one
    step, None of Stray Scanner's; `time_s` (T,): of the video's frames from 0 on, each of which has a picture in other
    folders, empty without a video; `called`: its name in errors. Raises `PblError` DEPTH_FILE."""
    wrong = functools.partial(depth_error, key=called or folder)
    inside, stray, turn = "", scale_m is None, 0
    try:
        names = names_in(folder)
    except _UNREAD as error:
        raise wrong(f"no folder or zip ({error})", "depth pictures") from error
    with opened(folder) as get:
        if scale_m is None:
            inside, scale_m = "depth/", 0.001
            try:
                time_s, turn = _odometry(get)
            except _UNREAD as error:
                expected = "a folder of Stray Scanner with odometry.csv, or the scale of the folder's 16-bit pictures"
                raise wrong(f"no recording of Stray Scanner ({error})", expected) from error
        elif not 0 < scale_m < 1000:
            raise wrong(f"a scale of {scale_m:g} m", "metres of one step, such as 0.001")
        paths = [PurePosixPath(name) for name in names]
        confidences = {p.stem: str(p) for p in paths if stray and str(p.parent) == "confidence" and p.suffix == ".png"}
        files = [p for p in paths if str(p) == f"{inside}{p.name}" and p.suffix.lower() in _ENDS]
        files.sort(key=_by_number)
        if not files:
            raise wrong("no depth pictures", "a .png or .npy of each frame")
        if not stray:
            time_s = time_s if len(time_s) else np.arange(len(files), dtype=float)
            check_count(len(files), len(time_s), called or folder)
            time_s = time_s[: len(files)]
        else:
            try:  # a row of odometry.csv is a frame, which may lack its picture
                time_s = time_s[[int(f.stem) for f in files]]
            except (ValueError, IndexError) as error:
                found = said("{n} depth pictures for {all} rows of odometry.csv", n=len(files), all=len(time_s))
                raise wrong(found, "a picture of each frame, named by its number") from error
        height, width = map(int, _picture(get, str(files[0]), wrong).shape)
        turn = turn if width > height else 0  # they were turned before
        stored = (size_px[1], size_px[0]) if turn in (90, 270) else size_px
        sizes = zip(_MATRICES, (stored, (width, height)), strict=True)
        of_video, own = (_matrix(get, n, size, turn, wrong) if n in names else None for n, size in sizes)
    if own is not None and of_video is None:
        raise wrong(f"{_MATRICES[1]} alone", f"{_MATRICES[0]} beside it")

    def read(frames: Iterable[int]) -> Iterator[Pictures]:
        with opened(folder) as get:
            for i in frames:
                depth, confidence = _picture(get, str(files[i]), wrong), confidences.get(files[i].stem)
                if depth.dtype != np.uint16:
                    bits = f"{files[i].name} of {8 * depth.itemsize} bits ({depth.dtype})"
                    raise wrong(bits, "16 bits a pixel, whole numbers")
                sure = None if confidence is None else _picture(get, confidence, wrong)
                if sure is not None and sure.shape != depth.shape:
                    found = said("confidences of {a}, depths of {b}", a=sure.shape, b=depth.shape)
                    raise wrong(found, "pictures of one size, turned alike")
                yield np.rot90(depth, -turn // 90) * scale_m, None if sure is None else np.rot90(sure, -turn // 90)

    return Depth(called or folder, time_s, size_px, of_video, own, read, turn_deg=turn)


def _by_number(file: PurePosixPath) -> tuple[list[int], str]:
    """Order of pictures: that of the numbers in their names, with zeros before them or not."""
    return [int(n) for n in re.findall(r"\d+", file.stem)], file.name


def _picture(get: Get, name: str, wrong: Callable[..., PblError]) -> np.ndarray:
    try:
        data = get(name, _MOST)
        if name.lower().endswith(".npy"):
            picture = np.load(io.BytesIO(data), allow_pickle=False)
        else:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.ndim != 2:
            raise ValueError("no picture of one value a pixel")
    except _UNREAD as error:
        raise wrong(f"{PurePosixPath(name).name}: {error}", "a picture of one value a pixel") from error
    return picture


def _matrix(get: Get, name: str, size_px: tuple[int, int], turn_deg: int, wrong: Callable[..., PblError]) -> np.ndarray:
    try:
        rows = io.StringIO(get(name, bounded.MAX_TEXT).decode("utf-8-sig"))
        camera = Camera(np.loadtxt(rows, delimiter=",").reshape(3, 3), np.zeros(5), name)
    except _UNREAD as error:
        raise wrong(f"{name}: {error}", "3 rows of 3 numbers") from error
    return turned_camera(camera, size_px, turn_deg).matrix


def _odometry(get: Get) -> tuple[np.ndarray, int]:
    """Times (s) of the frames from 0 on, and the clockwise turn (deg) that makes the pictures upright; 0 where the file
    does not state how the phone was held."""
    import pandas as pd

    text = get("odometry.csv", bounded.MAX_TEXT).decode("utf-8-sig")
    rows = pd.read_csv(io.StringIO(text), skipinitialspace=True)
    time, names = rows["timestamp"].to_numpy(float), ["qx", "qy", "qz", "qw"]
    if not len(time):
        raise ValueError("no rows")
    turns = rows[names].to_numpy(float) if set(names) <= set(rows) else np.zeros((0, 4))
    turns = turns[np.isfinite(turns).all(axis=1) & (np.linalg.norm(turns, axis=1) > 0.5)]
    x, y = np.median(Rotation.from_quat(turns).as_matrix()[:, 1, :2], axis=0) if len(turns) else (0.0, 0.0)
    return time - time[0], 0 if np.hypot(x, y) < _UPRIGHT else round(-1 - np.arctan2(y, x) / (np.pi / 2)) % 4 * 90
