"""Depth recordings in the formats that are known."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints

from .folders import read_folder
from .packed import sha256_of_recording
from .points import PointDepths, at_points
from .record3d import read_record3d
from .recording import Depth, checked, depth_error

_RECORD3D = ".r3d"


@dataclasses.dataclass(frozen=True)
class DepthFile:
    """A depth recording that a person names. scale_m: metres of one step of its 16-bit pictures, None where it states
    them; called: name of the file of which this one is a copy."""

    file: Path
    scale_m: float | None = None
    called: str = ""

    @classmethod
    def of(cls, text: str, folder: Path = Path()) -> DepthFile:
        """Return what `FILE` or `SCALE=FOLDER` on the command line, or in a sheet of `folder`, means."""
        scale, _, file = text.partition("=")
        with contextlib.suppress(ValueError):
            if file and math.isfinite(number := float(scale.replace(",", "."))):
                return cls(folder / file, number)
        return cls(folder / text)

    @property
    def known(self) -> bool:
        """True if its kind of file can be read."""
        return self.file.is_dir() or self.file.suffix.lower() in (_RECORD3D, ".zip")


def read_depth(
    path: Path, time_s: np.ndarray, size_px: tuple[int, int], scale_m: float | None = None, called: str = ""
) -> Depth:
    """Read the depth recording of a video with frames at `time_s` (T,) and upright pictures of width and height
    `size_px`: a `.r3d` of Record3D, a folder of Stray Scanner, or with `scale_m`, the metres of one step, a folder of
    16-bit pictures, one for each frame; also the zip of such a folder. `called`: its name, if that is not the path's.

    Raises `PblError` DEPTH_FILE as `checked`; FILE_MISSING; PACKAGE_MISSING for .r3d without the extra `depth`.
    """
    time, shown = np.asarray(time_s, float) - float(time_s[0]), Path(called or path)
    if not path.exists():
        raise PblError("FILE_MISSING", "no such file or folder", "a depth recording", "check the path", shown)
    found = _read(path, time, size_px, scale_m, shown)
    return dataclasses.replace(checked(found, time), sha256=sha256_of_recording(path))


def check_recording(given: DepthFile) -> None:
    """Read the first picture, and what can be told without a video; files of other kinds have no scale. Raises
    `PblError` DEPTH_FILE; PACKAGE_MISSING as `read_depth`."""
    if given.known or given.scale_m is not None:
        next(_read(given.file, np.zeros(0), (1, 1), given.scale_m, given.file).read([0]))


def _read(path: Path, time_s: np.ndarray, size_px: tuple[int, int], scale_m: float | None, shown: Path) -> Depth:
    if shown.suffix.lower() != _RECORD3D or path.is_dir():
        return read_folder(path, time_s, size_px, scale_m, shown)
    if scale_m is not None:
        raise depth_error("a scale for a file", "a scale for a folder of 16-bit pictures", key=shown)
    return read_record3d(path, size_px, shown)


def with_recordings(
    trials: Sequence[Any], files: Sequence[DepthFile | None]
) -> tuple[list[Any], list[PointDepths | None]]:
    """Return trials with the cameras of their depth recordings, and the depths at the keypoints of each.

    Raises `PblError` USAGE for another trial than keypoints of one camera; what `read_depth` and `at_points` raise.
    """
    found, depths = list[Any](), list[PointDepths | None]()
    for trial, given in zip(trials, files, strict=True):
        if given is None:
            found.append(trial)
            depths.append(None)
            continue
        if not isinstance(trial, Keypoints):
            raise PblError("USAGE", "--depth with markers", "keypoints of a video", "leave out --depth")
        time, frame = trial.time_s, trial.frame
        if frame is not None:  # of those that the keypoints leave out as well: each has a depth picture
            time = np.interp(np.arange(frame[-1] + 1), frame, time)
        depth = read_depth(given.file, time, trial.image_size_px, given.scale_m, given.called)
        found.append(dataclasses.replace(trial, camera=depth.camera(trial.camera)))
        depths.append(at_points(depth, trial))
    return found, depths
