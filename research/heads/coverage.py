"""Coverage of heads in real recordings by `pbl_pipeline.deidentify`, against heads located by eye.

Located is the whole head, hair to chin, as an ellipse in a box; what of it lies in the picture has to be covered.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.deidentify import SPREAD_S, Heads
from pbl_pipeline.errors import PblError

#: A head is covered where this fraction of its ellipse is: boxes by eye are some pixels off.
COVERED = 0.95
#: A head counts where this fraction of its ellipse lies in the picture.
_IN_VIEW = 0.2
_DEMO = "demo_video"
#: The wanted share of frames with a head.
BAR = 0.995


@dataclasses.dataclass(frozen=True)
class LocatedHead:
    """A head located by eye: `frames` (N,) indices, `boxes_px` (N, 4) x0, y0, x1, y1. `interpolate`: between these
    frames its place is linear."""

    who: str
    interpolate: bool
    frames: np.ndarray
    boxes_px: np.ndarray

    def boxes(self) -> dict[int, np.ndarray]:
        """The box (4,) of every frame that counts."""
        if not self.interpolate:
            return dict(zip(self.frames.tolist(), self.boxes_px, strict=True))
        at = np.arange(self.frames[0], self.frames[-1] + 1)
        rows = np.column_stack([np.interp(at, self.frames, side) for side in self.boxes_px.T])
        return dict(zip(at.tolist(), rows, strict=True))


@dataclasses.dataclass(frozen=True)
class LocatedClip:
    """A recording with its heads. `file`: relative to the folder of the recordings, or the name of the demo asset.
    `tune`: margins and thresholds were chosen with it, so that its figures prove nothing."""

    name: str
    file: str
    tune: bool
    heads: tuple[LocatedHead, ...]

    def path(self, folder: Path) -> Path:
        """The recording. Raises `PblError` FILE_MISSING, and those of `assets.fetch` for the demo."""
        if self.file == _DEMO:
            return assets.fetch(_DEMO)
        path = folder / self.file
        if not path.is_file():
            raise PblError(
                "FILE_MISSING",
                found="no file of that name",
                expected=f"the recording {self.file} in the folder of --data",
                next_step="pass the folder that holds multiview/ and video_mocap/, or leave the clip out with --clip",
                key=str(path),
            )
        return path


@dataclasses.dataclass(frozen=True)
class HeadCoverage:
    """Coverage of one head: `frames` (N,) in which it is in view, `fraction` (N,) of its ellipse that is hidden,
    `certain` (N,) whether the frame was reported as certain."""

    clip: str
    who: str
    frames: np.ndarray
    fraction: np.ndarray
    certain: np.ndarray

    @property
    def covered(self) -> np.ndarray:
        """(N,) bool."""
        return self.fraction >= COVERED


def located_clips() -> tuple[LocatedClip, ...]:
    """Return the recordings whose heads were located by eye (`heads.json`)."""
    content = json.loads((Path(__file__).parent / "heads.json").read_text(encoding="utf-8"))
    return tuple(
        LocatedClip(c["name"], c["file"], c["tune"], tuple(_located(h) for h in c["heads"])) for c in content["clips"]
    )


def head_coverage(clip: LocatedClip, heads: Heads) -> list[HeadCoverage]:
    """Return the part of each located head that `covered_picture` hides."""
    certain = np.array([not r for r in heads.reasons()])
    found = []
    for head in clip.heads:
        rows = [(t, _fraction(box, heads, t)) for t, box in head.boxes().items()]
        seen = [(t, f) for t, f in rows if np.isfinite(f)]
        at = np.array([t for t, _ in seen], int)
        found.append(HeadCoverage(clip.name, head.who, at, np.array([f for _, f in seen]), certain[at]))
    return found


def frame_coverage(heads: Sequence[HeadCoverage]) -> tuple[int, int, int]:
    """Return for the heads of one clip: frames with a head, those in which all are covered, and those in which one is
    not although the frame was reported as certain."""
    with_head: set[int] = set()
    open_frames: set[int] = set()
    silent: set[int] = set()
    for head in heads:
        with_head |= set(head.frames.tolist())
        open_frames |= set(head.frames[~head.covered].tolist())
        silent |= set(head.frames[~head.covered & head.certain].tolist())
    return len(with_head), len(with_head) - len(open_frames), len(silent)


def _located(content: dict[str, Any]) -> LocatedHead:
    boxes = np.array(content["boxes"], float)
    return LocatedHead(content["who"], content["interpolate"], boxes[:, 0].astype(int), boxes[:, 1:])


def _fraction(box: np.ndarray, heads: Heads, index: int) -> float:
    """Fraction of the ellipse in `box` that is covered in a frame, of its part in the picture; NaN where little is."""
    points = _ellipse(box)
    width, height = heads.image_size_px
    inside = ((points > -0.5) & (points < np.array([width, height]) - 0.5)).all(axis=1)
    if inside.mean() < _IN_VIEW:
        return float("nan")
    points = points[inside]
    hidden = np.zeros(len(points), bool)
    for circles in heads.circles(index, SPREAD_S):
        for x, y, r in circles:
            hidden |= np.hypot(points[:, 0] - x, points[:, 1] - y) <= r
    return float(hidden.mean())


def _ellipse(box: np.ndarray, n: int = 24) -> np.ndarray:
    """Points (N, 2) spread evenly over the ellipse in a box."""
    u, v = (np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 2), axis=-1).reshape(-1, 2)).T
    inside = u * u + v * v <= 1
    centre, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2
    return centre + np.column_stack([u, v])[inside] * half
