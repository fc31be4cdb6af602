#!/usr/bin/env bash
# A trimmed clip: counts of frames include the hidden ones, and a copy of the stream shows those after the cut again.
#
# Seen 2026-11-28: av 18.1.0, opencv-python-headless 5.0.0.93.
# Behaviour: trimming on a phone hides frames by an edit list and keeps them in the file. Both libraries decode only what
#   is shown, but PyAV's `stream.frames` and OpenCV's CAP_PROP_FRAME_COUNT count all frames. Packets that PyAV demuxes
#   are those from the keyframe before the cut to the end of the file. Muxed into a new file (add_stream_from_template),
#   those before the cut stay hidden and those after it are shown.
# Matters: a progress bar or an array of CAP_PROP_FRAME_COUNT frames is too long, and a copy shows what was cut off.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install av==18.1.0 opencv-python-headless==5.0.0.93 numpy==2.4.6
observe venv <<'PY'
import struct
from fractions import Fraction
import av, cv2, numpy as np

N, RATE, KEY = 90, 30, 30
with av.open("whole.mp4", "w") as file:
    stream = file.add_stream("libx264", rate=RATE, options={"g": str(KEY), "bf": "0", "sc_threshold": "0", "crf": "4"})
    stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
    for i in range(N):  # the brightness is the number of the frame
        grey = np.full((72, 64), 128, np.uint8)
        grey[:48] = 20 + 2 * i
        frame = av.VideoFrame.from_ndarray(grey, format="yuv420p")
        frame.pts, frame.time_base = i, Fraction(1, RATE)
        file.mux(stream.encode(frame))
    file.mux(stream.encode())

# Show frames 45 to 74: the edit list's only entry, and the durations of track and movie, which are its sum.
data = bytearray(open("whole.mp4", "rb").read())
def put(box, at, form, *values):
    start = data.index(box) + 4 + at
    data[start:start + struct.calcsize(form)] = struct.pack(form, *values)
movie_scale, = struct.unpack_from(">I", data, data.index(b"mvhd") + 16)
media_scale, = struct.unpack_from(">I", data, data.index(b"mdhd") + 16)
put(b"mvhd", 16, ">I", movie_scale)
put(b"tkhd", 20, ">I", movie_scale)
put(b"elst", 4, ">IIiI", 1, movie_scale, media_scale * 45 // RATE, 1 << 16)
open("trimmed.mp4", "wb").write(data)

with av.open("trimmed.mp4") as source, av.open("copy.mp4", "w") as target:
    stream = source.streams.video[0]
    copy = target.add_stream_from_template(stream)
    for packet in source.demux(stream):
        if packet.dts is not None:
            packet.stream = copy
            target.mux(packet)

def number(frame):
    return round((float(frame.to_ndarray()[:48].mean()) - 20) / 2)

for path in ("whole.mp4", "trimmed.mp4", "copy.mp4"):
    with av.open(path) as file:
        counted = file.streams.video[0].frames
        shown = [number(f) for f in file.decode(video=0)]
    capture = cv2.VideoCapture(path)
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    read = 0
    while capture.read()[0]:
        read += 1
    print(f"{path}: PyAV counts {counted}, shows {len(shown)} ({shown[0]} to {shown[-1]}); OpenCV counts {frames}, shows {read}")
PY
expect <<'SEEN'
whole.mp4: PyAV counts 90, shows 90 (0 to 89); OpenCV counts 90, shows 90
trimmed.mp4: PyAV counts 90, shows 30 (45 to 74); OpenCV counts 90, shows 30
copy.mp4: PyAV counts 60, shows 45 (45 to 89); OpenCV counts 60, shows 45
SEEN
