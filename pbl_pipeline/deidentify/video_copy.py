"""Copies of recordings without faces, and the list of frames that a person should review."""

from __future__ import annotations

import collections
import dataclasses
import functools
import json
import os
import secrets
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.files import check_out_file, complete_file, sha256_of
from pbl_pipeline.render import draw_skeleton
from pbl_pipeline.results.people import HiddenHeads
from pbl_pipeline.runs import ranges
from pbl_pipeline.settings import DEIDENTIFY, deidentify_how
from pbl_pipeline.video import VideoInfo, probe, read_frames, read_metadata, write_h264

from .heads_of_video import find_heads
from .types import REASONS, HeadParams, Heads

#: Standard deviation of the Gaussian, in radii of the circle: a face is about 0.75 of a radius wide.
BLUR_RADII = 0.4
#: Side of a cell, in radii.
CELL_RADII = 0.4
#: Radius in the reduced picture that is blurred, px.
_RADIUS_PX = 10.0
_SHIFT = 4  # OpenCV's circles carry this many fractional bits
_unwritable = functools.partial(
    PblError,
    "FILE_UNWRITABLE",
    next_step="pass another --out, or --overwrite to replace an earlier result (never the recording)",
)
_usage = functools.partial(PblError, "USAGE", next_step="see `pbl deidentify --help`")
#: HEAD_NOT_FOUND about a recording whose pictures are to be shown without heads.
nothing_covered = functools.partial(
    PblError,
    "HEAD_NOT_FOUND",
    found="no head, so nothing of the recording is covered, and PBL_DEIDENTIFY forbids to show it",
    expected="a person whose head is in the picture",
    next_step="look at the recording; PBL_DEIDENTIFY=skeleton shows no picture at all",
)


def cover(image: np.ndarray, circles: Sequence[np.ndarray], how: str) -> None:
    """Hide all circles (for each head (N, 3): centre x, y, radius in px) in `image` (H, W, 3) uint8 BGR, in place.

    `how` is "blur", a Gaussian of `BLUR_RADII`, or "pixelate", the means of cells of `CELL_RADII`. Both scale with the
    head, so that a near face is hidden as well as a far one.
    """
    for rows in circles:
        _cover_one(image, np.asarray(rows, float), how)


def outline(circles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(height, width) uint8, 255 within the circles (N, 3); size is (width, height)."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    for x, y, r in np.asarray(circles, float):
        centre = (round(x * (1 << _SHIFT)), round(y * (1 << _SHIFT)))
        cv2.circle(mask, centre, max(1, round(r * (1 << _SHIFT))), 255, -1, cv2.LINE_8, _SHIFT)
    return mask


def _cover_one(image: np.ndarray, circles: np.ndarray, how: str) -> None:
    height, width = image.shape[:2]
    low = np.floor((circles[:, :2] - circles[:, 2:]).min(axis=0)) - 1
    high = np.ceil((circles[:, :2] + circles[:, 2:]).max(axis=0)) + 2
    x0, y0 = (int(v) for v in np.clip(low, 0, [width, height]))
    x1, y1 = (int(v) for v in np.clip(high, 0, [width, height]))
    if x1 <= x0 or y1 <= y0:
        return
    part = image[y0:y1, x0:x1]
    mask = outline(circles - [x0, y0, 0], (x1 - x0, y1 - y0))
    radius = float(circles[:, 2].max())
    hidden = _blurred(part, radius) if how == "blur" else _cells(part, radius)
    part[mask > 0] = hidden[mask > 0]


def _blurred(part: np.ndarray, radius: float) -> np.ndarray:
    height, width = part.shape[:2]
    factor = max(1.0, radius / _RADIUS_PX)
    small = _smaller(part, factor)
    sd = BLUR_RADII * radius / factor
    small = cv2.GaussianBlur(small, (0, 0), max(sd, 0.5))
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def _cells(part: np.ndarray, radius: float) -> np.ndarray:
    height, width = part.shape[:2]
    small = _smaller(part, max(1.0, CELL_RADII * radius))
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)


def _smaller(part: np.ndarray, factor: float) -> np.ndarray:
    size = (max(1, round(part.shape[1] / factor)), max(1, round(part.shape[0] / factor)))
    return cv2.resize(part, size, interpolation=cv2.INTER_AREA)


HOW = DEIDENTIFY
#: Metadata of the file that may be kept, and the beginnings of the names of its tags.
KEEP: Mapping[str, tuple[str, ...]] = {
    "place": ("location", "com.apple.quicktime.location"),
    "device": (
        *("make", "model", "com.apple.quicktime.make", "com.apple.quicktime.model", "com.apple.quicktime.software"),
        *("com.apple.quicktime.camera.", "com.android.manufacturer", "com.android.model", "com.android.version"),
    ),
    "time": ("creation_time", "com.apple.quicktime.creationdate", "date"),
}
#: Always kept: it shows slow motion, and nothing about a person.
_ALWAYS = ("com.android.capture.fps", "com.apple.quicktime.capture.fps")
SIDECAR_VERSION = 1
#: The positions of the head in the frames within this time (s) are also covered.
SPREAD_S = 0.05
_QUALITY = 18  # x264's crf, so that results computed from the copy are those of the original


@dataclasses.dataclass(frozen=True)
class Deidentified:
    """Result for one video."""

    path: Path
    sidecar: Path
    how: str  # one of `HOW`
    n_heads: int
    status: str  # "CERTAIN" (every frame), "REVIEW" (look at some) or "NO_HEAD" (nothing was covered)
    reason: str  # of the status, a sentence
    reasons: tuple[tuple[str, ...], ...]  # (T,) why each frame is not certain, names of `REASONS`; empty if it is

    @property
    def uncertain(self) -> list[tuple[int, int]]:
        """First and last frame of each run of frames that are not certain."""
        return ranges([bool(r) for r in self.reasons])

    def why(self, first: int, last: int) -> tuple[str, ...]:
        """Reasons of a run of frames, in the order of `REASONS`."""
        found = {r for of_frame in self.reasons[first : last + 1] for r in of_frame}
        return tuple(r for r in REASONS if r in found)

    @property
    def n_uncertain(self) -> int:
        return sum(bool(r) for r in self.reasons)

    @property
    def figures(self) -> HiddenHeads:
        """The result in figures."""
        runs = tuple({"first": a, "last": b, "why": self.why(a, b)} for a, b in self.uncertain)
        return HiddenHeads(self.how, self.status, self.reason, self.n_heads, self.n_uncertain, runs)


def sidecar_of(out: Path) -> Path:
    """Path of the facts about a de-identified video: `walk.deidentified.json` for `walk.deidentified.mp4` and for
    `walk.mp4`."""
    stem = out.stem.removesuffix(".deidentified")
    return out.with_name(f"{stem}.deidentified.json")


def check_call(video: Path, out: Path, how: str, keep: Collection[str], overwrite: bool) -> None:
    """Check the arguments before anything is read. Raises `PblError` USAGE, FILE_UNWRITABLE."""
    if how not in HOW:
        raise _usage(f"--how {how}", f"one of {', '.join(HOW)}")
    if unknown := [k for k in keep if k not in KEEP]:
        raise _usage(f"--keep {', '.join(unknown)}", f"one or several of {', '.join(KEEP)}")
    if out.suffix.lower() != ".mp4":
        raise _usage(f"--out {out.name}", "a name that ends in .mp4")
    if out.exists() and video.exists() and os.path.samefile(out, video):
        raise _unwritable("the recording itself", "another file than the recording", key=out)
    for path in (out, sidecar_of(out)):
        check_out_file(path)
        if path.exists() and not overwrite:
            raise _unwritable("a file of that name", "a new name", key=path)


def deidentify(
    video: str | Path,
    out: str | Path,
    how: str = "blur",
    *,
    keep: Collection[str] = (),
    overwrite: bool = False,
    params: HeadParams | None = None,
    info: VideoInfo | None = None,
    heads: Heads | None = None,
) -> Deidentified:
    """Write a video in which no head can be recognised, and a list of frames that a person should review
    (docs/files.md).

    The copy has every frame of the original, upright, at its own time stamp, without sound, and without metadata except
    those of `keep` (names of `KEEP`). Both files appear complete or not at all. A video in which no head is found is
    written as it is, with that status. Memory grows with the length of the video by a circle per head and frame only.

    Raises `PblError` USAGE, FILE_UNWRITABLE (`check_call`); VIDEO_* for a file that cannot be read; VIDEO_CHANGED;
    ASSET_*.

    Parameters
    ----------
    video, out
        The recording, and an .mp4 file.
    how
        "blur", "pixelate", or "skeleton" (the bodies' keypoints on black).
    params, info, heads
        Parameters of finding heads; result of `video.probe`; heads that were found before.
    """
    video, out = Path(video), Path(out)
    check_call(video, out, how, keep, overwrite)
    params = params or HeadParams()
    info = info or probe(video)
    heads = heads or find_heads(video, params, info)
    reasons = tuple(heads.reasons())
    status, reason = _status(heads, reasons)
    sidecar = sidecar_of(out)
    with complete_file(out) as part, complete_file(sidecar) as part_of_sidecar:
        pictures, size = _pictures(video, info, heads, how), (info.width_px, info.height_px)
        write_h264(part, pictures, size, info.time_s, _QUALITY, _kept(video, keep))
        done = Deidentified(out, sidecar, how, len(heads.heads), status, reason, reasons)
        content = _content(done, info, sha256_of(part), params, keep)
        part_of_sidecar.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return done


def to_show(video: str | Path, folder: Path, info: VideoInfo | None = None) -> Path:
    """Return the recording itself or, as PBL_DEIDENTIFY requires, a de-identified copy written into `folder`.

    Raises the `PblError`s of `deidentify`, and HEAD_NOT_FOUND if nothing was covered.
    """
    how = deidentify_how()
    if not how:
        return Path(video)
    done = deidentify(video, folder / f"{secrets.token_hex(8)}.mp4", how, info=info)
    if done.status == "NO_HEAD" and how != "skeleton":
        raise nothing_covered(key=video)
    return done.path


def covered_picture(image: np.ndarray, heads: Heads, index: int, how: str) -> np.ndarray:
    """Frame `index` of the de-identified video, from `image` (H, W, 3) uint8 BGR, which is not changed."""
    if how == "skeleton":
        picture = np.zeros_like(image)
        for head in heads.heads:
            if head.body_px is not None:
                draw_skeleton(picture, head.body_names, head.body_px[index])
        return picture
    picture = image.copy()
    cover(picture, heads.circles(index, SPREAD_S), how)
    return picture


def _pictures(video: Path, info: VideoInfo, heads: Heads, how: str) -> Iterator[tuple[float, np.ndarray]]:
    n = 0
    for frame in progress.track(read_frames(video), "covering heads", total=info.n_frames):
        n += 1
        if n > info.n_frames:
            break
        yield frame.time_s, covered_picture(frame.image, heads, frame.index, how)
    if n != info.n_frames:
        raise PblError(
            "VIDEO_CHANGED",
            found=said("more than {n} frames" if n > info.n_frames else "{n} frames", n=min(n, info.n_frames)),
            expected=said("the {n} frames that were probed", n=info.n_frames),
            next_step="run it again when the file is complete",
            key=str(video),
        )


def _status(heads: Heads, reasons: tuple[tuple[str, ...], ...]) -> tuple[str, str]:
    if not heads.heads:
        return "NO_HEAD", "no head was found in any frame, so nothing was covered: look at the whole video"
    n = sum(bool(r) for r in reasons)
    if not n:
        return "CERTAIN", f"every frame is certain ({len(heads.heads)} heads)"
    return "REVIEW", f"{n} of {len(reasons)} frames are not certain: look at them"


def _kept(video: Path, keep: Collection[str]) -> dict[str, str]:
    """Tags of the file that are copied to the new one."""
    begins = tuple(b for name in keep for b in KEEP[name])
    found = read_metadata(video)
    return {n: text for n, text in found.items() if n in _ALWAYS or (begins and _is_of(n, begins))}


def _is_of(name: str, begins: tuple[str, ...]) -> bool:
    """True if a tag is one of these, or below one that ends in a dot, or a language of it (`location-eng`)."""
    return any(name == b or name.startswith((b,) if b.endswith(".") else (f"{b}-", f"{b}.")) for b in begins)


def _content(
    done: Deidentified, info: VideoInfo, sha256: str, params: HeadParams, keep: Collection[str]
) -> dict[str, Any]:
    """Content of the sidecar. The original is named by its hash alone: names of files are often names of people."""
    counts = collections.Counter(r for of_frame in done.reasons for r in of_frame)
    return {
        "format": "pbl-deidentified",
        "version": SIDECAR_VERSION,
        "status": done.status,
        "reason": done.reason,
        "how": done.how,
        "n_frames": info.n_frames,
        "n_heads": done.n_heads,
        "n_uncertain": done.n_uncertain,
        "uncertain": [
            {
                "first": first,
                "last": last,
                "first_s": round(float(info.time_s[first]), 4),
                "last_s": round(float(info.time_s[last]), 4),
                "why": list(done.why(first, last)),
            }
            for first, last in done.uncertain
        ],
        "frames_by_reason": {r: counts[r] for r in REASONS if counts[r]},
        "kept": sorted(keep),
        "original_sha256": info.sha256,
        "sha256": sha256,
        "parameters": dataclasses.asdict(params),
        "code_version": code_version(),
    }
