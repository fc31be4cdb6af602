#!/usr/bin/env bash
# Orientations of vqf lead a sensor's samples by half an interval, because each rate turns the interval before its sample.
#
# Seen 2026-11-29: vqf 2.1.2, numpy 2.4.6.
# Behaviour: offlineVQF smooths forwards and backwards, so its quaternions look as if they were at the times of the
#   samples. They are those of the rates summed up to and with each sample: of a sensor that swings with rates and
#   accelerations measured at the times of the samples, each orientation is that of half an interval later.
# Matters: at 50 Hz it is 10 ms, and 2 degrees of a shank that swings: as much as soft tissue, and an offset between the
#   clocks of sensors and a video that no one set. Means of neighbouring rates, as ours, remove it.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install vqf==2.1.2 numpy==2.4.6
observe venv <<'PY'
import numpy as np
from vqf import offlineVQF

for rate in (50, 100, 200):
    t = np.arange(0, 60, 1 / rate)
    wave = 2 * np.pi * t  # one swing a second about the first axis
    angle, zero = 0.8 * np.sin(wave), 0 * t
    turning = np.stack([0.8 * 2 * np.pi * np.cos(wave), zero, zero], axis=1)
    upwards = 9.81 * np.stack([zero, np.sin(angle), np.cos(angle)], axis=1)

    def found(rates):
        q = offlineVQF(np.ascontiguousarray(rates), np.ascontiguousarray(upwards), None, 1 / rate)["quat6D"]
        return 2 * np.arctan2(q[:, 1], q[:, 0])

    def lead(angles):
        inside = (t > 20) & (t < 40)
        columns = np.stack([np.sin(wave), np.cos(wave), np.ones(len(t))], axis=1)[inside]
        a, b, _ = np.linalg.lstsq(columns, angles[inside], rcond=None)[0]
        return np.arctan2(b, a) / (2 * np.pi) * rate

    between = np.concatenate([turning[:1], (turning[1:] + turning[:-1]) / 2])
    print(f"{rate} Hz: {lead(found(turning)):.2f} intervals ahead, with means of two rates {abs(lead(found(between))):.2f}")
PY
expect <<'SEEN'
50 Hz: 0.50 intervals ahead, with means of two rates 0.00
100 Hz: 0.50 intervals ahead, with means of two rates 0.00
200 Hz: 0.50 intervals ahead, with means of two rates 0.00
SEEN
