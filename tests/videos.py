"""Small test videos made with PyAV: exact time stamps, a rotation flag, and any content."""

from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def write_video(
    path: str | Path,
    frames_bgr: Iterable[np.ndarray],
    time_s: Iterable[float],
    codec: str = "libx264",
    rotation_deg: int = 0,
    *,
    hflip: bool = False,
    ticks_per_s: int = 90_000,
    pixel_format: str = "yuv420p",
    gop: int = 30,
    b_frames: int = 0,
    crf: int = 18,
    container_options: Mapping[str, str] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write `frames_bgr` (H, W, 3 uint8, upright, even sizes) at times `time_s`; both may be long iterables.

    As a phone does, the pictures are stored turned and the file says so: `rotation_deg` (0, 90, 180, 270) is how far a
    player has to turn the stored picture clockwise; `hflip` mirrors what is shown. The frames read back are therefore
    `frames_bgr` for every `rotation_deg` (mirrored where `hflip` is set). The container follows the suffix
    (.mp4, .mov, .mkv, .webm, .avi). `container_options` go to the muxer, such as {"movflags": "+faststart"}.
    """
    if rotation_deg not in (0, 90, 180, 270):
        raise ValueError(f"rotation_deg must be 0, 90, 180 or 270, not {rotation_deg}")
    options = {"crf": str(crf), "preset": "veryfast"} if codec.startswith("libx26") else {}
    if codec == "libx265":
        options["x265-params"] = "log-level=none"
    time_base = Fraction(1, ticks_per_s)
    with av.open(str(path), "w", options={} if container_options is None else dict(container_options)) as container:
        container.metadata.update(metadata or {})
        stream = None
        for image, t in zip(frames_bgr, time_s, strict=True):
            stored = np.ascontiguousarray(np.rot90(image, rotation_deg // 90))  # rot90 turns counter-clockwise
            if stream is None:
                stream = container.add_stream(codec, rate=30, options=options)
                assert isinstance(stream, av.VideoStream)
                stream.height, stream.width = stored.shape[:2]
                stream.pix_fmt = pixel_format
                stream.codec_context.time_base = time_base
                stream.gop_size = gop
                stream.max_b_frames = b_frames
                if rotation_deg or hflip:
                    stream.set_display_rotation(-rotation_deg, hflip=hflip)
            frame = av.VideoFrame.from_ndarray(stored, format="bgr24")
            frame.time_base = time_base
            frame.pts = round(t * ticks_per_s)
            container.mux(stream.encode(frame))
        if stream is None:
            raise ValueError("no frames given")
        container.mux(stream.encode(None))
    return Path(path)


def write_as_they_are(path: Path, frames_bgr: Iterable[np.ndarray], fps: int = 30) -> Path:
    """Write an .avi with every pixel as it is: a codec without loss takes longer than what is tested."""
    frames = list(frames_bgr)
    how = {"codec": "rawvideo", "pixel_format": "bgr24", "ticks_per_s": fps}
    return write_video(path, frames, constant_rate(len(frames), fps), **how)


def numbered_frames(n: int, height: int = 64, width: int = 96) -> Iterable[np.ndarray]:
    """`n` distinct BGR pictures: grey level = 8 * (index % 30), a blue top-left and a red bottom-right corner block."""
    for i in range(n):
        image = np.full((height, width, 3), 8 * (i % 30), np.uint8)
        image[: height // 4, : width // 4] = (255, 0, 0)
        image[-height // 4 :, -width // 4 :] = (0, 0, 255)
        yield image


def constant_rate(n: int, fps: float = 30.0) -> np.ndarray:
    """Times of `n` frames at `fps`, first at 0 (s)."""
    return np.arange(n) / fps


def noise_frames(n: int) -> Iterator[np.ndarray]:
    """Pictures that do not compress, so that every part of the file is picture data."""
    rng = np.random.default_rng(1)
    for _ in range(n):
        yield rng.integers(0, 255, (64, 96, 3), np.uint8)
