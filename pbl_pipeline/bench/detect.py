"""Frames a second, processor time and memory of detection on one video, such as the demo recording at 1080p."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pbl_pipeline import assets, progress
from pbl_pipeline.temporary import new_folder

from .run import Column, Row, measured, mega, number, table

if TYPE_CHECKING:
    import numpy as np

#: The frames of the demo recording in which the woman is wholly in the picture and not near its border.
_FIRST, _STOP = 60, 166
_SIZE = (1920, 1080)
_FPS = 30


def demo_clip(path: Path) -> Path:
    """Write the demo recording's walk there and back, 7 s of 1920x1080 H.264 at 30 fps and about 8 Mbit/s.

    Forwards and then backwards: repeated, the person does not jump. Raises the errors of `assets.fetch`.
    """
    import cv2

    from pbl_pipeline.video import read_frames

    source = assets.fetch("demo_video")
    forward = [cv2.resize(f.image, _SIZE, interpolation=cv2.INTER_CUBIC) for f in read_frames(source, _FIRST, _STOP)]
    _write(path, iter([*forward, *forward[-2:0:-1]]), 2 * len(forward) - 2)
    return path


def numbered(film: bytes, number: int) -> bytes:
    """The bytes of an MP4 as another file with the same pictures: a box that readers skip holds the number."""
    return film + (16).to_bytes(4) + b"free" + number.to_bytes(8)


def _write(path: Path, images: Iterator[np.ndarray], n: int) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=_FPS, options={"preset": "veryfast", "crf": "20"})
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = _SIZE
        stream.pix_fmt = "yuv420p"
        stream.gop_size = 2 * _FPS
        stream.max_b_frames = 0
        for image in progress.track(images, "making the clip", total=n):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))


def run_detect(
    video: Path | None,
    person: int | None,
    repeat: int,
    timeout_s: float,
    note: Callable[[str], None] = lambda _: None,
    keypoints: Sequence[str] = (),
) -> Iterator[Row]:
    """Measure probe, tracking and keypoints on `video` (None: `demo_clip`): a row for each keypoint method of
    `keypoints` (none: the default), one after the other.

    The measured process does nothing else, and a failure in it is a row with `error`. Raises the `PblError`s of
    `demo_clip`, and VIDEO_MISSING.
    """

    with new_folder() as folder:
        if video is None:
            note("making a clip of 1920x1080 from the demo recording")
            path = demo_clip(folder / "demo1080.mp4")
        else:
            from pbl_pipeline.video import check_file

            check_file(video)  # raises what is wrong with the file before anything is measured
            path = video
        for method in keypoints or [""]:
            note(f"measuring {method}".strip())
            label = (str(video) if video else "demo recording at 1080p") + (f", {method}" if method else "")
            spec = {"video": str(path), "person": person, "repeat": repeat, "keypoints": method or None}
            spec["result"] = str(folder / f"{method}.json")
            yield {"label": label} | measured("pbl_pipeline.bench.detect_case", spec, timeout_s)


def detect_text(row: Row) -> str:
    """The row as a table of stages with what was measured above it."""
    if "error" in row:
        return f"{row['label']}: {row['error']}\n{row.get('error_text', '')}".strip()
    frames = row["frames"]
    columns: list[Column] = [
        ("stage", lambda r: r["stage"]),
        ("frames/s", lambda r: number(frames / r["seconds"], 1)),
        ("ms a frame", lambda r: number(1e3 * r["seconds"] / frames, 1)),
        ("CPU ms a frame", lambda r: number(1e3 * r["cpu_seconds"] / frames, 1)),
        ("memory MB", lambda r: mega(r["host_bytes"])),
        ("growth MB", lambda r: mega(r["growth_bytes"])),
    ]
    rows = [{"stage": name, **figures} for name, figures in row["stages"].items()]
    rows.append({"stage": "all", **{k: row[k] for k in ("seconds", "cpu_seconds", "host_bytes")}, "growth_bytes": None})
    head = (
        f"{row['label']}: {row['width_px']}x{row['height_px']} {row['codec']}, {row['mbit_per_s']:.1f} Mbit/s, "
        f"{frames:,} frames in {row['video_seconds']:.1f} s; people tracked: {row['persons']}, the measured one "
        f"in view in {row['frames_in_view']:,} frames; {row['cores']} cores; "
        f"the fastest of {len(row['runs_seconds'])} runs"
    )
    return f"{head}\n\n{table(rows, columns)}"
