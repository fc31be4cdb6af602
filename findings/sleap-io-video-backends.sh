#!/usr/bin/env bash
# Which picture of a phone's video is frame i in sleap-io, and which way up it is, depends on the packages beside it.
#
# Seen 2026-11-29: sleap-io 0.9.5, imageio-ffmpeg 0.8.1, opencv-python-headless 5.0.0.93, av 15.1.0.
# Behaviour: a phone's video has frames at uneven times, and a note that it is to be turned. sleap-io as pip installs it
#   reads it through imageio-ffmpeg: where a frame lasts longer it is returned again, and as many of the last ones never;
#   the number of frames is right. With OpenCV beside it, which it then takes, frame i is the i-th picture; with PyAV it
#   also is, but the picture is not turned. No error or warning.
# Matters: points that were labelled or predicted in SLEAP belong to other moments (here up to 0.3 s) or have x and y
#   exchanged where the next program, or a colleague's installation, counts the frames of the same video.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install sleap-io==0.9.5 imageio==2.38.1 imageio-ffmpeg==0.8.1 av==15.1.0 numpy==2.4.6
observe venv <<'PY'
import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

WIDTH, HEIGHT, TICKS = 320, 192, 600
with av.open("made.mp4", "w") as made:
    stream = made.add_stream("libx264", rate=30, options={"crf": "10", "bf": "0"})
    stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    stream.codec_context.time_base = Fraction(1, TICKS)
    time = 0
    for number in range(40):  # 30 a second, each tenth one lasts for three; its grey is 6 times its number
        frame = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH, 3), 6 * number, np.uint8), format="rgb24")
        frame.pts, frame.time_base = time, Fraction(1, TICKS)
        time += 60 if number % 10 == 5 else 20
        made.mux(stream.encode(frame))
    made.mux(stream.encode())
data = bytearray(Path("made.mp4").read_bytes())
matrix = data.index(b"tkhd") + 44  # of the track: turned by 90 degrees to the right
data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, HEIGHT << 16, 0, 1 << 30)
Path("phone.mp4").write_bytes(data)
PY
cat >read.py <<'PY'
import logging

import sleap_io

logging.disable()


def read(**choice):
    video = sleap_io.load_video("phone.mp4", **choice)
    numbers = [round(float(video[i].mean()) / 6) for i in range(len(video))]
    print(f"{video.backend.plugin}: {len(video)} frames of {video.shape[2]} x {video.shape[1]}:", *numbers)
PY
observe venv <<<'import read; read.read()'
observe venv <<<'import read; read.read(plugin="pyav")'
install opencv-python-headless==5.0.0.93
observe venv <<<'import read; read.read()'
expect <<'SEEN'
FFMPEG: 40 frames of 192 x 320: 0 1 2 3 4 5 5 5 6 7 8 9 10 11 12 13 14 15 15 15 16 17 18 19 20 21 22 23 24 25 25 25 26 27 28 29 30 31 32 33
pyav: 40 frames of 320 x 192: 0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32 33 34 35 36 37 38 39
opencv: 40 frames of 192 x 320: 0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32 33 34 35 36 37 38 39
SEEN
