#!/usr/bin/env bash
# pyxdf spreads a gap of lost samples over the whole stream: stamps are up to 2.7 s off.
#
# Seen 2026-11-30: pyxdf 1.17.5, numpy 2.4.6.
# Behaviour: `load_xdf` replaces the stamps of a regular stream by a line through them ("dejitter"), unless a gap is longer
#   than one second and 500 samples as well: 5 s at 100 Hz, 10 s at 50 Hz. Stamps before and behind a shorter gap move
#   towards it, and the gap is gone. The warning comes when the rate is off by more than 10 %.
# Matters: wearable sensors over the lab streaming layer lose packets; their stamps were right. With
#   `dejitter_timestamps=False` they are as recorded.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pyxdf==1.17.5 numpy==2.4.6
observe venv <<'PY'
import logging
import struct

import numpy as np
import pyxdf


def chunk(tag, content):
    return b"\x04" + struct.pack("<IH", len(content) + 2, tag) + content


def write(rate, stamps):
    """An XDF with one stream whose value is the true time."""
    header = (f"<info><name>shank</name><type>IMU</type><channel_count>1</channel_count><nominal_srate>{rate}</nominal_srate>"
              "<channel_format>double64</channel_format></info>")
    samples = b"".join(b"\x08" + struct.pack("<dd", t, t) for t in stamps)
    stream = struct.pack("<I", 1)
    with open("walk.xdf", "wb") as file:
        file.write(b"XDF:" + chunk(1, b"<info><version>1.0</version></info>") + chunk(2, stream + header.encode())
                   + chunk(3, stream + b"\x04" + struct.pack("<I", len(stamps)) + samples))


class Warned(logging.Handler):
    def emit(self, record):
        global warned
        warned = warned or "rate" in record.getMessage()


logging.getLogger().addHandler(Warned())
for rate, seconds, gap in ((100, 30, 0), (100, 30, 0.3), (100, 30, 2), (100, 30, 4.9), (100, 30, 5.1), (50, 60, 5.1)):
    stamps = 1000 + np.arange(rate * seconds) / rate
    write(rate, stamps[(stamps < 1010) | (stamps >= 1010 + gap)])
    warned = False
    (stream,), _ = pyxdf.load_xdf("walk.xdf")
    off = np.round(stream["time_stamps"] - stream["time_series"][:, 0], 2) + 0
    (plain,), _ = pyxdf.load_xdf("walk.xdf", dejitter_timestamps=False)
    print(f"{rate} Hz, {seconds} s, {gap} s lost: stamps off by {off.min():+.2f} to {off.max():+.2f} s,",
          f"longest interval {np.diff(stream['time_stamps']).max():.2f} s, {'a warning' if warned else 'no warning'};",
          f"not dejittered {abs(plain['time_stamps'] - plain['time_series'][:, 0]).max():.2f} s")
PY
expect <<'SEEN'
100 Hz, 30 s, 0 s lost: stamps off by +0.00 to +0.00 s, longest interval 0.01 s, no warning; not dejittered 0.00 s
100 Hz, 30 s, 0.3 s lost: stamps off by -0.17 to +0.13 s, longest interval 0.01 s, no warning; not dejittered 0.00 s
100 Hz, 30 s, 2 s lost: stamps off by -1.11 to +0.89 s, longest interval 0.01 s, no warning; not dejittered 0.00 s
100 Hz, 30 s, 4.9 s lost: stamps off by -2.67 to +2.23 s, longest interval 0.01 s, a warning; not dejittered 0.00 s
100 Hz, 30 s, 5.1 s lost: stamps off by +0.00 to +0.00 s, longest interval 5.11 s, no warning; not dejittered 0.00 s
50 Hz, 60 s, 5.1 s lost: stamps off by -2.38 to +2.72 s, longest interval 0.02 s, no warning; not dejittered 0.00 s
SEEN
