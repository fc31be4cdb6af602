#!/usr/bin/env bash
# kielmat dates a gait sequence by the row of a 40 Hz signal: at 100 Hz a walk after 100 s is one after 40 s.
#
# Seen 2026-11-30: kielmat 0.0.5, numpy 1.26.4, scipy 1.17.1, pandas 2.3.3.
# Behaviour: `ParaschivIonescuGaitSequenceDetection` resamples to 40 Hz. Without `dt_data` it divides rows by 40: the
#   onsets are right. With the recording's stamps as `dt_data` the row at 40 Hz is looked up in those of the recording: the
#   time since the start is multiplied by 40 / rate. Durations and number are right, at 40 Hz the dates as well. At a lower
#   rate the dates are too late, and those behind the recording's end are missing, with a line printed.
# Matters: recordings of days at home are read with their dates; the walks of an evening are dated to the morning.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install kielmat==0.0.5 numpy==1.26.4 scipy==1.17.1 pandas==2.3.3
observe venv <<'PY'
import contextlib
import io

import numpy as np
import pandas as pd
from kielmat.modules.gsd import ParaschivIonescuGaitSequenceDetection

START = pd.Timestamp("2026-03-01 10:00")
WALKS = ((100, 130), (200, 240), (400, 430))
for rate in (25, 40, 100, 128):
    time = np.arange(500 * rate) / rate
    vertical = 1 + 0.002 * np.random.default_rng(0).standard_normal(len(time))
    for begin, end in WALKS:
        walks = (time >= begin) & (time < end)
        steps = 2 * np.pi * 1.8 * (time[walks] - begin)
        vertical[walks] += 0.25 * np.sin(steps) + 0.1 * np.sin(2 * steps)
    data = pd.DataFrame({"x": vertical, "y": 0.0, "z": 0.0})
    stamps = pd.Series(START + pd.to_timedelta(time, unit="s"))
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        plain = ParaschivIonescuGaitSequenceDetection().detect(data, rate).gait_sequences_
        dated = ParaschivIonescuGaitSequenceDetection().detect(data, rate, dt_data=stamps).gait_sequences_
    print(f"{rate} Hz: onsets {[round(s) for s in plain.onset]} s; dated",
          ", ".join("none" if pd.isna(date) else f"{date:%H:%M:%S}" for date in dated.onset),
          f"for {sum(dated.duration):.0f} s; {'a warning' if 'Warning' in said.getvalue() else 'no warning'}")
print("walked from", ", ".join(f"{START + pd.Timedelta(seconds=begin):%H:%M:%S}" for begin, _ in WALKS))
PY
expect <<'SEEN'
25 Hz: onsets [100, 200, 400] s; dated 10:02:40, 10:05:20, none for 98 s; a warning
40 Hz: onsets [100, 200, 400] s; dated 10:01:40, 10:03:20, 10:06:39 for 98 s; no warning
100 Hz: onsets [100, 200, 400] s; dated 10:00:40, 10:01:20, 10:02:40 for 98 s; no warning
128 Hz: onsets [100, 200, 400] s; dated 10:00:31, 10:01:02, 10:02:05 for 98 s; no warning
walked from 10:01:40, 10:03:20, 10:06:40
SEEN
