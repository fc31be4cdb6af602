#!/usr/bin/env bash
# OpenSim's `Storage.smoothSpline` returns coefficients of the spline as values: the ends are hundreds of degrees off.
#
# Seen 2026-11-30: opensim 4.6, numpy 2.4.6, scipy 1.17.1.
# Behaviour: `smoothSpline(degree, cutoff)` fits a smoothing spline and takes its control points for the smoothed signal.
#   Those of degree 3 and 5 are close to the signal within it and lie far from it at both ends; those of degree 1 are
#   values of the spline. SciPy's values of the same spline are right throughout, those of `lowpassIIR` off by 9 deg at
#   the ends. With rows of `pad`, to be cut off afterwards, the ends of `smoothSpline` are right as well.
#   `getDataColumn` by a column's name leaves out the rows before time 0, `getDataColumn` by its number and
#   `getTimeColumn` do not.
# Matters: derivatives at the ends of a motion, and its range, are those of the wrong values; a motion whose time 0 is an
#   event, read by name, is paired with the times of other rows.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install opensim==4.6 numpy==2.4.6 scipy==1.17.1
observe venv <<'PY'
import numpy as np
import opensim
from scipy.interpolate import make_smoothing_spline

opensim.Logger.setLevelString("off")
RATE = 100


def motion(begin):
    """A knee of 30 deg +- 30 deg once a second for 3 s, and its values."""
    time = begin + np.arange(3 * RATE + 1) / RATE
    knee = 30 + 30 * np.sin(2 * np.pi * time)
    rows = "".join(f"{t:.6f}\t{x:.9f}\n" for t, x in zip(time, knee))
    with open("walk.mot", "w") as file:
        file.write(f"walk\nversion=1\nnRows={len(time)}\nnColumns=2\ninDegrees=yes\nendheader\ntime\tknee\n{rows}")
    return opensim.Storage("walk.mot"), time, knee


def column(storage, which):
    values = opensim.ArrayDouble()
    storage.getDataColumn(which, values)
    return np.array([values.get(i) for i in range(values.getSize())])


def report(case, values, knee):
    off = abs(values - knee)
    ends = [int(float(f"{x:.2g}")) for x in (off[0], off[1], off[-1])]
    print(f"{case}: off by up to {off[RATE // 2 : -RATE // 2].max():.1f} deg inside;",
          f"first, second and last value by {ends} deg")


for degree in (1, 3, 5):
    storage, time, knee = motion(0)
    storage.smoothSpline(degree, 6)
    report(f"smoothSpline of degree {degree}, 6 Hz", column(storage, 0), knee)
storage, time, knee = motion(0)
storage.pad(RATE)
storage.smoothSpline(3, 6)
report("padded by 1 s, degree 3", column(storage, 0)[RATE:-RATE], knee)
cutoff = 2 * np.pi * 6 / (2**0.5 - 1) ** 0.25  # of a spline that is applied twice, in rad/s
once = make_smoothing_spline(time, knee, lam=RATE / cutoff**4)(time)
report("values of SciPy's spline", make_smoothing_spline(time, once, lam=RATE / cutoff**4)(time), knee)
storage, time, knee = motion(0)
storage.lowpassIIR(6)
report("lowpassIIR, 6 Hz", column(storage, 0), knee)

for begin in (0, 0.5, -0.5):
    storage, time, knee = motion(begin)
    stamps = opensim.ArrayDouble()
    storage.getTimeColumn(stamps)
    by_name, by_number = column(storage, "knee"), column(storage, 0)
    first = len(by_number) - len(by_name)
    assert np.array_equal(by_number[first:], by_name)
    print(f"from {begin} s: {stamps.getSize()} times, {len(by_number)} values by number, {len(by_name)} by name,",
          f"the first of them of {stamps.get(first):.1f} s")
PY
expect <<'SEEN'
smoothSpline of degree 1, 6 Hz: off by up to 0.7 deg inside; first, second and last value by [3, 2, 3] deg
smoothSpline of degree 3, 6 Hz: off by up to 0.0 deg inside; first, second and last value by [580, 30, 200] deg
smoothSpline of degree 5, 6 Hz: off by up to 0.1 deg inside; first, second and last value by [1500, 330, 370] deg
padded by 1 s, degree 3: off by up to 0.0 deg inside; first, second and last value by [0, 0, 0] deg
values of SciPy's spline: off by up to 0.0 deg inside; first, second and last value by [0, 0, 0] deg
lowpassIIR, 6 Hz: off by up to 0.0 deg inside; first, second and last value by [6, 4, 9] deg
from 0 s: 301 times, 301 values by number, 301 by name, the first of them of 0.0 s
from 0.5 s: 301 times, 301 values by number, 301 by name, the first of them of 0.5 s
from -0.5 s: 301 times, 301 values by number, 251 by name, the first of them of 0.0 s
SEEN
