#!/usr/bin/env bash
# kielmat's low-pass filter of 20 Hz is one of 0.4 Hz at 100 samples a second: walking counts as sitting.
#
# Seen 2026-11-30: kielmat 0.0.5, numpy 1.26.4, scipy 1.17.1, pandas 2.3.3.
# Behaviour: `lowpass_filter(method="butter")` divides the cutoff by half the sampling rate and states the rate to SciPy as
#   well, which divides again: 2 * cutoff / rate is taken for Hz. `PhysicalActivityMonitoring` uses it before it leaves
#   out what is below 1 g: the steps are gone by then, and of 159 mg at 2 steps a second 0.05 remain. Slow movement passes.
#   It also divides the caller's table by 9.81 and adds columns: a second call with it has other minutes.
#   With pandas 3 it ends with an error.
# Matters: minutes of light, moderate and vigorous activity become sedentary, without a word.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install kielmat==0.0.5 numpy==1.26.4 scipy==1.17.1 pandas==2.3.3
observe venv <<'PY'
import numpy as np
import pandas as pd
import scipy.signal
from kielmat.modules.pam import PhysicalActivityMonitoring
from kielmat.utils.preprocessing import lowpass_filter


def gain(filtered):
    """The amplitude behind the filter, 1 before it, away from the ends."""
    return abs(filtered[len(filtered) // 3 : -len(filtered) // 3]).max()


for rate in (50, 100, 200):
    time = np.arange(90 * rate) / rate
    sos = scipy.signal.butter(4, 20, fs=rate, output="sos")
    found = []
    for hz in (0.1, 0.4, 0.8, 2, 10):
        wave = np.sin(2 * np.pi * hz * time)
        kielmat = gain(lowpass_filter(wave, method="butter", order=4, cutoff_freq_hz=20, sampling_rate_hz=rate))
        found.append(f"{hz} Hz {kielmat:.1f} (SciPy {gain(scipy.signal.sosfiltfilt(sos, wave)):.1f})")
    print(f"low-pass of 20 Hz at {rate} samples a second: {', '.join(found)}")


def report(case, table, mg):
    activity = PhysicalActivityMonitoring().detect(table, acceleration_unit="m/s^2", sampling_freq_Hz=100, plot=False)
    day = activity.physical_activities_.iloc[0]
    minutes = {name: day[f"{name}_time_min"] for name in ("sedentary", "light", "moderate", "vigorous")}
    most = max(minutes, key=minutes.get)
    print(f"{case}, {mg:.0f} mg: {minutes[most]:.0f} min {most} with {day[f'{most}_mean_enmo']:.1f} mg")


for case, hz, amplitude in (("still", 2, 0), ("walk", 2, 0.25), ("brisk walk", 2, 0.5), ("run", 3, 2), ("rocking", 0.2, 0.5)):
    time = np.arange(600 * 100) / 100
    g = 1 + amplitude * np.sin(2 * np.pi * hz * time)
    stamps = pd.date_range("2026-03-01 10:00", periods=len(time), freq="10ms", name="timestamp")
    table = pd.DataFrame({"x": 9.81 * g, "y": 0.0, "z": 0.0}, index=stamps)
    true = 1000 * np.maximum(abs(g) - 1, 0).mean()
    report(case, table, true)
report("the same table again", table, true)
print("columns of the table:", *table.columns)
PY
expect <<'SEEN'
low-pass of 20 Hz at 50 samples a second: 0.1 Hz 1.0 (SciPy 1.0), 0.4 Hz 1.0 (SciPy 1.0), 0.8 Hz 0.5 (SciPy 1.0), 2 Hz 0.0 (SciPy 1.0), 10 Hz 0.0 (SciPy 1.0)
low-pass of 20 Hz at 100 samples a second: 0.1 Hz 1.0 (SciPy 1.0), 0.4 Hz 0.5 (SciPy 1.0), 0.8 Hz 0.0 (SciPy 1.0), 2 Hz 0.0 (SciPy 1.0), 10 Hz 0.0 (SciPy 0.9)
low-pass of 20 Hz at 200 samples a second: 0.1 Hz 1.0 (SciPy 1.0), 0.4 Hz 0.0 (SciPy 1.0), 0.8 Hz 0.0 (SciPy 1.0), 2 Hz 0.0 (SciPy 1.0), 10 Hz 0.0 (SciPy 1.0)
still, 0 mg: 10 min sedentary with 0.0 mg
walk, 79 mg: 10 min sedentary with 0.0 mg
brisk walk, 159 mg: 10 min sedentary with 0.0 mg
run, 636 mg: 10 min vigorous with 435.9 mg
rocking, 159 mg: 10 min moderate with 158.5 mg
the same table again, 159 mg: 10 min vigorous with 16348.0 mg
columns of the table: x y z en enmo truncated_enmo
SEEN
