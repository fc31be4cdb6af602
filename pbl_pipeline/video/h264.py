"""Writing pictures to a video file that browsers play, each at its own time stamp."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter

from pbl_pipeline.prefetch import prefetched
from pbl_pipeline.sampling import interval_of

_TICKS_PER_S = 90_000  # time base of the output: every common frame rate is a whole number of ticks
_AHEAD = 4  # pictures made ahead while one is encoded


def write_h264(
    path: str | Path,
    pictures: Iterable[tuple[float, np.ndarray]],
    size: tuple[int, int],
    time_s: np.ndarray,
    crf: int,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write H.264 in MP4 with the given times. The index is at the front, so that a browser starts at once.

    Parameters
    ----------
    pictures
        Time (s) and picture (H, W, 3) uint8 BGR, upright, in order.
    size
        Width and height (px). Colour has half the resolution if both are even, otherwise the full one, which not every
        browser plays.
    time_s : (T,)
        Stamps of all pictures, rounded here to 1/90,000 s.
    crf
        x264's quality, 0 (lossless) to 51.
    tags
        Metadata of the file, by name; the only other one is the name of the encoding library.
    """
    ticks = np.rint(np.asarray(time_s, float) * _TICKS_PER_S).astype(np.int64)
    step = round(interval_of(ticks)) if len(ticks) > 1 else _TICKS_PER_S // 30
    last = {int(a): int(b - a) for a, b in zip(ticks, np.append(ticks[1:], ticks[-1] + step), strict=True)}
    flags = "+faststart+use_metadata_tags" if tags else "+faststart"
    layout = "yuv420p" if size[0] % 2 == size[1] % 2 == 0 else "yuv444p"
    with av.open(str(path), "w", format="mp4", options={"movflags": flags}) as out:
        out.metadata.update(tags or {})
        # A key frame every two seconds or so: a viewer that drags the slider does not wait.
        options = {"crf": str(crf), "preset": "veryfast", "g": str(max(1, 2 * _TICKS_PER_S // step))}
        stream = out.add_stream("libx264", rate=Fraction(_TICKS_PER_S, step), options=options)
        stream.width, stream.height, stream.pix_fmt = *size, layout
        context = stream.codec_context
        context.time_base = Fraction(1, _TICKS_PER_S)
        # Untagged video is guessed to be BT.601 or BT.709 by its size; with the tag the colours are right everywhere.
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = 1
        converter = VideoReformatter()
        for t, picture in prefetched(pictures, _AHEAD):
            frame = converter.reformat(
                av.VideoFrame.from_numpy_buffer(picture, format="bgr24"),
                format=layout,
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                threads=1,
            )
            frame.pts, frame.time_base = round(t * _TICKS_PER_S), Fraction(1, _TICKS_PER_S)
            out.mux(_timed(stream.encode(frame), last))
        out.mux(_timed(stream.encode(None), last))


def _timed(packets: Sequence[av.Packet], duration: dict[int, int]) -> list[av.Packet]:
    for packet in packets:
        if packet.pts is not None:
            packet.duration = duration.get(packet.pts, packet.duration or 0)
    return list(packets)
