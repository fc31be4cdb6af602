"""A video repeated until it lasts so long, to see whether memory stays flat.

python -m research.benchmarks.longer_video walk.mp4 --minutes 10 --out long.mp4
python -m research.benchmarks.longer_video --minutes 10 --out long.mp4     # the clip of `pbl bench detect`
pbl bench detect long.mp4 --repeat 1
"""

from __future__ import annotations

import tempfile
from fractions import Fraction
from pathlib import Path

import av
import click

from pbl_pipeline.bench.detect import demo_clip
from pbl_pipeline.errors import PblError


def repeated(source: Path, path: Path, seconds: float) -> Path:
    """Write the pictures of `source` again and again, without encoding anew, until it lasts `seconds`.

    Raises
    ------
    PblError
        VIDEO_TIMESTAMPS: pictures without a stamp, which cannot be put one after the other.
    """
    with av.open(str(path), "w") as out:
        stream, begin, last_dts = None, 0, -1
        while True:
            with av.open(str(source)) as container:
                video = container.streams.video[0]
                base = video.time_base
                if stream is None:
                    stream = out.add_stream_from_template(video)
                packets = [p for p in container.demux(video) if p.size]
                if base is None or not packets or any(p.pts is None or p.dts is None for p in packets):
                    raise PblError(
                        "VIDEO_TIMESTAMPS",
                        found="packets without a time stamp",
                        expected="a video in MP4 or MKV, whose packets have stamps",
                        next_step="convert the video",
                        key=str(source),
                    )
                stamps = sorted(int(p.pts) for p in packets if p.pts is not None)
                step = round((stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1)) or 1
                shift = begin - stamps[0]
                for packet in packets:
                    assert packet.pts is not None
                    assert packet.dts is not None
                    packet.pts, packet.dts = packet.pts + shift, max(packet.dts + shift, last_dts + 1)
                    last_dts = packet.dts
                    packet.stream = stream
                    out.mux(packet)
                begin += stamps[-1] - stamps[0] + step
                if begin * Fraction(base) >= seconds:
                    return path


@click.command()
@click.argument("video", required=False, type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--minutes", type=click.FloatRange(0, 600, min_open=True), required=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="FILE")
def main(video: Path | None, minutes: float, out: Path) -> None:
    """Write VIDEO to --out, repeated without encoding anew; without one the walk of the demo recording at 1080p."""
    with tempfile.TemporaryDirectory() as folder:
        repeated(video or demo_clip(Path(folder) / "demo1080.mp4"), out, 60 * minutes)


if __name__ == "__main__":
    main()
