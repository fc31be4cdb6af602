#!/usr/bin/env bash
# pyedflib fills a recording of 60 s at 59.94 Hz up to 100 s with made-up samples, without a warning.
#
# Seen 2026-11-30: pyedflib 0.1.42, numpy 2.4.6.
# Behaviour: the file has no count of samples, only of blocks, whose length is sought so that they hold a whole number of
#   samples: 1 s at 60 Hz, 50 s at 59.94 Hz, 9.1 s at 1111.11 Hz. The rest of the last block is the physical
#   minimum of the channel, or 0 if it can hold that, and is read back as data. The docstrings do not mention it.
# Matters: 60 s of an accelerometer beside a camera of 59.94 Hz come back as 100 s, and their mean, range and last steps
#   are others. Keep the number of samples elsewhere.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install pyedflib==0.1.42 numpy==2.4.6
observe venv <<'PY'
import warnings

import numpy as np
from pyedflib import highlevel

for rate, seconds, low in ((60, 60, 5), (60, 60.5, 5), (59.94, 60, 5), (59.94, 60, -20), (29.97, 60, 5), (1111.11, 10, 5)):
    samples = round(rate * seconds)
    values = 9.81 + 2 * np.sin(np.arange(samples) / 10)
    header = highlevel.make_signal_header(
        "acc", "m/s2", sample_frequency=rate, physical_min=low, physical_max=20, digital_min=-32768, digital_max=32767)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        highlevel.write_edf("walk.edf", [values], [header])
        (back,), (seen,), _ = highlevel.read_edf("walk.edf")
    added = back[samples:]
    fill = f", filled with {added.min():.1f} to {added.max():.1f}" if len(added) else ""
    print(f"{rate} Hz, {samples} samples, channel from {low}: {len(back)} samples read, mean {values.mean():.2f} is {back.mean():.2f}",
          f"{fill}; {len(warned)} warnings", sep="")
PY
expect <<'SEEN'
60 Hz, 3600 samples, channel from 5: 3600 samples read, mean 9.82 is 9.82; 0 warnings
60 Hz, 3630 samples, channel from 5: 3660 samples read, mean 9.81 is 9.78, filled with 5.0 to 5.0; 0 warnings
59.94 Hz, 3596 samples, channel from 5: 5994 samples read, mean 9.81 is 7.89, filled with 5.0 to 5.0; 0 warnings
59.94 Hz, 3596 samples, channel from -20: 5994 samples read, mean 9.81 is 5.89, filled with 0.0 to 0.0; 0 warnings
29.97 Hz, 1798 samples, channel from 5: 1887 samples read, mean 9.83 is 9.60, filled with 5.0 to 5.0; 0 warnings
1111.11 Hz, 11111 samples, channel from 5: 20202 samples read, mean 9.81 is 7.65, filled with 5.0 to 5.0; 0 warnings
SEEN
