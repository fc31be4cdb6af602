"""A depth recording, and what it is compared with: its video, and distances that a sensor can see."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.video import Camera

#: Farthest depth (m) that is used: beyond it the sensors of phones guess.
FARTHEST_M = 5.0
#: Typical depths (m) of a recording of a person.
_TYPICAL_M = (0.15, 20.0)
#: Pictures that are looked at; most of what they show that may lie beyond `FARTHEST_M`; differences of the shapes of
#: the pictures, of the numbers of frames, of focal lengths and of durations, as fractions; of the middle of a lens, of
#: the picture.
_LOOKED_AT, _MOST_FAR, _SHAPE, _FEWER, _FOCAL, _LONGER, _MIDDLE = 5, 0.9, 0.03, 0.02, 0.05, 0.03, 0.06
#: Standard deviation of a focal length that the recording states, as a fraction.
_FOCAL_REL_SD = 0.01

_TURN = "turn the video, or depth pictures that do not state how the phone was held, so that the person is upright"

#: Depths and confidences of a frame.
Pictures = tuple[np.ndarray, np.ndarray | None]

depth_error = functools.partial(
    PblError, "DEPTH_FILE", next_step="export it again as docs/depth.md says, or leave it out"
)


@dataclasses.dataclass(frozen=True)
class Depth:
    """A depth recording. `time_s` (N,): of its frames, 0 is the first; `size_px`: width and height of the video's
    pictures; `matrix` (3, 3) px: of those, `own_matrix`: of the depth pictures, None where the file does not state it
    and both show the same; `read`: raw depths (m, H x W) and confidences (H x W, 0 to 2, or None) of some frames;
    `sha256`: of its file, or of a folder's zip; `turn_deg`: clockwise turn that `read` and the matrices went through.
    """

    path: Path
    time_s: np.ndarray
    size_px: tuple[int, int]
    matrix: np.ndarray | None
    own_matrix: np.ndarray | None
    read: Callable[[Iterable[int]], Iterator[Pictures]]
    sha256: str = ""
    turn_deg: int = 0

    def camera(self, found: Camera) -> Camera:
        """The video's camera: that of the recording, unless the one that was found is calibrated or it states none.

        Raises `PblError` DEPTH_FILE: it is not the camera that was calibrated.
        """
        if self.matrix is None:
            return found
        own = Camera(self.matrix, np.zeros(5), f"metadata: depth recording {self.path.name}", _FOCAL_REL_SD)
        if not found.calibrated:
            return own
        if abs(own.focal_px / found.focal_px - 1) > _FOCAL:
            raise depth_error(
                said("a focal length of {f:.0f} px, as of another camera or lens", f=own.focal_px),
                said("{f:.0f} px, as calibrated", f=found.focal_px),
                key=self.path,
            )
        return found

    def place(self, xy_px: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Rows and columns (..., 2) int of a depth picture of a shape (H, W) at points (..., 2) of the video's."""
        if self.matrix is not None and self.own_matrix is not None:
            ray = (xy_px - self.matrix[:2, 2]) / np.diag(self.matrix)[:2]
            xy = ray * np.diag(self.own_matrix)[:2] + self.own_matrix[:2, 2]
        else:
            xy = (xy_px + 0.5) * (np.array(shape[::-1]) / self.size_px) - 0.5
        return np.rint(xy[..., ::-1]).astype(int)


def check_count(n: int, n_frames: int, path: Path, more: bool = False) -> None:
    """Raise `PblError` DEPTH_FILE where n pictures are fewer than the frames of the video, or `more` is not allowed and
    they are."""
    if n < (1 - _FEWER) * n_frames or (n > (1 + _FEWER) * n_frames and not more):
        raise depth_error(
            said("{n} depth pictures for {all} of the video", n=n, all=n_frames),
            "one for each frame of the video",
            key=path,
        )


def checked(depth: Depth, time_s: np.ndarray) -> Depth:
    """Compare a recording with a video that has frames at some times (T,); returns it, with these times if it has as
    many frames: both apps write one of each.

    Raises `PblError` DEPTH_FILE: fewer frames than the video; another duration; pictures that are turned by 90 deg or
    of another camera; depths of nothing, in another unit than stated, or nearly all beyond `FARTHEST_M`; times that do
    not increase.
    """
    n = len(depth.time_s)
    check_count(n, len(time_s), depth.path, more=True)
    if not np.isfinite(depth.time_s).all() or np.any(np.diff(depth.time_s) <= 0):
        raise depth_error("times that are missing or do not increase", "seconds for each frame", key=depth.path)
    lasts, wanted = float(depth.time_s[-1]), float(time_s[-1] - time_s[0])
    longest = np.inf if n > (1 + _FEWER) * len(time_s) else (1 + _LONGER) * wanted  # a video may be cut at its end
    if not (1 - _LONGER) * wanted <= lasts <= longest:
        raise depth_error(
            said("depths of {a:.2f} s beside a video of {b:.2f} s", a=lasts, b=wanted),
            "a video of the same duration, joined at the rate of its recording",
            key=depth.path,
        )
    seen = [x for x, _ in depth.read(np.unique(np.linspace(0, n - 1, _LOOKED_AT).astype(int)).tolist())]
    if len({x.shape for x in seen}) > 1:
        raise depth_error("pictures of different sizes", "one size", key=depth.path)
    _check_picture(depth, *seen[0].shape)
    values = np.concatenate([x[np.isfinite(x) & (x > 0)] for x in seen])
    if not len(values):
        raise depth_error("depths of 0 in all pictures", "metres", key=depth.path)
    typical, far = float(np.median(values)), float(np.mean(values > FARTHEST_M))
    if not _TYPICAL_M[0] <= typical <= _TYPICAL_M[1]:
        raise depth_error(
            said("depths of typically {d:.3g} m, as in millimetres or with another scale", d=typical),
            f"{_TYPICAL_M[0]:g} to {FARTHEST_M:g} m; the scale is metres of one step of a 16-bit picture",
            key=depth.path,
        )
    if far > _MOST_FAR:
        raise depth_error(
            said("{share:.0%} of the depths beyond {far:g} m", share=far, far=FARTHEST_M),
            "a person nearer to the camera",
            key=depth.path,
        )
    return dataclasses.replace(depth, time_s=time_s - time_s[0]) if n == len(time_s) else depth


def _check_picture(depth: Depth, height: int, width: int) -> None:
    """The shape of the pictures, and the middle of the lens, must be those of the video's camera."""
    w, h = depth.size_px
    shape = (width / height) / (w / h)
    if depth.own_matrix is None and abs(shape - 1) > _SHAPE:
        turned = abs(width / height * w / h - 1) <= _SHAPE
        raise depth_error(
            said(
                "depth pictures of {w}x{h}{how} beside a video of {w2}x{h2}",
                w=width,
                h=height,
                how=said(", turned by 90 deg," if turned else ", of another camera,"),
                w2=w,
                h2=h,
            ),
            "pictures of one camera, upright as the video is shown",
            key=depth.path,
            **({"next_step": _TURN} if turned else {}),
        )
    matrices = ((depth.matrix, depth.size_px), (depth.own_matrix, (width, height)))
    for matrix, size in matrices:
        if matrix is None:
            continue
        away = np.abs(matrix[:2, 2] / size - 0.5)
        if not (np.isfinite(matrix).all() and np.all(np.diag(matrix) > 0) and np.all(away < _MIDDLE)):
            raise depth_error(
                said("a camera matrix with its middle at {x:.0f}, {y:.0f} px", x=matrix[0, 2], y=matrix[1, 2]),
                said("that of pictures of {w}x{h}", w=size[0], h=size[1]),
                key=depth.path,
            )
