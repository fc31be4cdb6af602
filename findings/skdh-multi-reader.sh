#!/usr/bin/env bash
# skdh pairs the samples of two files by their rows if the rates are equal, and makes 1 g 0.989 g if they are not.
#
# Seen 2026-11-30: scikit-digital-health 0.17.18, numpy 2.4.6, pandas 3.1.1.
# Behaviour: `MultiReader(mode="combine")` joins the streams of several files. With equal rates the stamps of the last
#   file replace the others: a stream that began 3 s earlier is 3 s off.
#   With unequal rates streams are interpolated at the stamps of the slowest file; the filter before that is of
#   Chebyshev's first type and even order, with a gain of -0.05 dB at 0 Hz, and runs twice. A stream that begins later is
#   filled up with its first value. No warning.
# Matters: accelerometer and gyroscope, or left and right foot, start at different times. The same filter runs where
#   the package reduces the rate for its own gait and sleep measures.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install scikit-digital-health==0.17.18 numpy==2.4.6 pandas==3.1.1
observe venv <<'PY'
import warnings

import numpy as np
import pandas as pd
from skdh.io import MultiReader

START = 1767225600.0
COLUMNS = {"accel": ["acc_x", "acc_y", "acc_z"], "gyro": ["gyr_x", "gyr_y", "gyr_z"]}


def write(stream, begin, rate):
    """Samples of 60 s: x is the true time, z is 1."""
    time = begin + np.arange(60 * rate) / rate
    stamps = pd.to_datetime(np.round((START + time) * 1000).astype("int64"), unit="ms")
    x, y, z = COLUMNS[stream]
    pd.DataFrame({"time": stamps, x: time, y: 0.0, z: 1.0}).to_csv(f"{stream}.csv", index=False)


for *files, last in (
    (("accel", 0, 100), ("gyro", 0, 100), ""),
    (("accel", 0, 100), ("gyro", 3, 100), ""),
    (("gyro", 3, 100), ("accel", 0, 100), ""),
    (("accel", 0, 100), ("gyro", 0, 50), ""),
    (("accel", 0, 50), ("gyro", 3, 100), "gyro"),
):
    for file in files:
        write(*file)
    keywords = [{"time_col_name": "time", "column_names": {stream: COLUMNS[stream]}} for stream, *_ in files]
    reader = MultiReader(mode="combine", reader="ReadCSV", reader_kw=keywords)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read = reader.predict(files=[f"{stream}.csv" for stream, *_ in files])
    print(*(f"{stream} from {begin} s at {rate} Hz," for stream, begin, rate in files), f"{len(caught)} warnings")
    time = read["time"] - START
    for stream in COLUMNS:
        gain = np.median(read[stream][:, 2])
        n = min(len(time), len(read[stream]))
        off = np.median(read[stream][:n, 0] / gain - time[:n])
        print(f"  {stream}: {len(read[stream])} samples for {len(time)} stamps, {off + 0:.2f} s off, 1 is {gain:.4f}")
    if last:
        print(f"  {last} at {time[50]:.2f} s: the sample of {read[last][50, 0] / np.median(read[last][:, 2]):.1f} s")
PY
expect <<'SEEN'
accel from 0 s at 100 Hz, gyro from 0 s at 100 Hz, 0 warnings
  accel: 6000 samples for 6000 stamps, 0.00 s off, 1 is 1.0000
  gyro: 6000 samples for 6000 stamps, 0.00 s off, 1 is 1.0000
accel from 0 s at 100 Hz, gyro from 3 s at 100 Hz, 0 warnings
  accel: 6000 samples for 6000 stamps, -3.00 s off, 1 is 1.0000
  gyro: 6000 samples for 6000 stamps, 0.00 s off, 1 is 1.0000
gyro from 3 s at 100 Hz, accel from 0 s at 100 Hz, 0 warnings
  accel: 6000 samples for 6000 stamps, 0.00 s off, 1 is 1.0000
  gyro: 6000 samples for 6000 stamps, 3.00 s off, 1 is 1.0000
accel from 0 s at 100 Hz, gyro from 0 s at 50 Hz, 0 warnings
  accel: 3000 samples for 3000 stamps, 0.00 s off, 1 is 0.9886
  gyro: 3000 samples for 3000 stamps, 0.00 s off, 1 is 1.0000
accel from 0 s at 50 Hz, gyro from 3 s at 100 Hz, 0 warnings
  accel: 3000 samples for 3000 stamps, 0.00 s off, 1 is 1.0000
  gyro: 3000 samples for 3000 stamps, 0.00 s off, 1 is 0.9886
  gyro at 1.00 s: the sample of 3.0 s
SEEN
