"""The video of the benchmark of detection: the demo recording at 1080p, without a jump."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np

from pbl_pipeline import assets, progress
from pbl_pipeline.video import read_frames

#: The frames of the demo recording in which the woman is wholly in the picture and not near its border.
_FIRST, _STOP = 60, 166
_SIZE = (1920, 1080)
_FPS = 30


def demo_clip(path: Path) -> Path:
    """Write the demo recording's walk there and back, 7 s of 1920x1080 H.264 at 30 fps and about 8 Mbit/s.

    Forwards and then backwards: repeated, the person does not jump. Raises the errors of `assets.fetch`.
    """
    source = assets.fetch("demo_video")
    forward = [cv2.resize(f.image, _SIZE, interpolation=cv2.INTER_CUBIC) for f in read_frames(source, _FIRST, _STOP)]
    _write(path, iter([*forward, *forward[-2:0:-1]]), 2 * len(forward) - 2)
    return path


def _write(path: Path, images: Iterator[np.ndarray], n: int) -> None:
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
