#!/usr/bin/env bash
# The same call writes an MP4 that counts in milliseconds with av 18 and in the ticks of its track with av 19.
#
# Seen 2026-11-28: av 18.1.0 (FFmpeg 8.1.2), av 19.0.2 (FFmpeg 9.0.2), which needs Python 3.12.
# Behaviour: the time scale of the movie header was 1000 whatever the track's; FFmpeg 9 takes that of the track. The
#   option `movie_timescale` of the muxer restores 1000 in both.
# Matters: lengths in an edit list are counted in this scale. A program that patches one in milliseconds, without reading
#   the header, shows 1/90 of what it should after an upgrade of av, and no reader finds anything wrong.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

for version in 18.1.0 19.0.2; do
  install --into "av-$version" "av==$version" numpy==2.4.6
  observe "av-$version" <<'PY'
import struct
from fractions import Fraction
import av, numpy as np

def scale(**options):
    with av.open("a.mp4", "w", options=options) as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 90_000)
        for i in range(4):
            frame = av.VideoFrame.from_ndarray(np.full((72, 64), 60 * i, np.uint8), format="yuv420p")
            frame.pts, frame.time_base = 3000 * i, Fraction(1, 90_000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    data = open("a.mp4", "rb").read()
    return [struct.unpack_from(">I", data, data.index(box) + 16)[0] for box in (b"mvhd", b"mdhd")]

print(f"av {av.__version__}: movie, track {scale()}; asked for {scale(movie_timescale='1000')}")
PY
done
expect <<'SEEN'
av 18.1.0: movie, track [1000, 90000]; asked for [1000, 90000]
av 19.0.2: movie, track [90000, 90000]; asked for [1000, 90000]
SEEN
