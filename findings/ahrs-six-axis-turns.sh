#!/usr/bin/env bash
# Of six filters of ahrs for gyroscope and accelerometer, two lose a turn about the vertical and one gives the inverse.
#
# Seen 2026-11-29: ahrs 0.4.0, numpy 2.4.6.
# Behaviour: a level sensor turns by 90 degrees about the vertical and then rests; rates in rad/s, accelerations in m/s2,
#   no magnetometer. Madgwick, Mahony and EKF give the turn. Complementary gives none at all (its heading comes from the
#   magnetometer alone), UKF a part of it, AQUA the inverse rotation (world to sensor). All of them show a sensor that is
#   inclined by 30 degrees, AQUA again inversely. Nothing is said.
# Matters: a laboratory that makes orientations of its sensors with one of them, and changes the filter, gets other hip
#   rotations, or angles with the other sign, from the same recording.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install ahrs==0.4.0 numpy==2.4.6
observe venv <<'PY'
import numpy as np
from ahrs import filters

RATE = 100
t = np.arange(0, 8, 1 / RATE)
turning = np.zeros((len(t), 3))
turning[(t >= 2) & (t < 5), 2] = np.deg2rad(30)  # 30 degrees a second for three seconds
level = np.tile([0, 0, 9.81], (len(t), 1))
tilt = np.deg2rad(30)  # about the first axis: the world's up, seen by the sensor
inclined = np.tile([0, 9.81 * np.sin(tilt), 9.81 * np.cos(tilt)], (len(t), 1))


def angle(q, axis):
    return round(np.rad2deg(2 * np.arctan2(q[1 + axis], q[0])))


for name in ("Madgwick", "Mahony", "EKF", "Complementary", "UKF", "AQUA"):
    make = getattr(filters, name)
    turn = make(gyr=turning, acc=level, frequency=RATE).Q[-1]
    lean = make(gyr=np.zeros((len(t), 3)), acc=inclined, frequency=RATE).Q[-1]
    print(f"{name}: turned by 90: {angle(turn, 2)}; inclined by 30: {angle(lean, 0)}")
PY
expect <<'SEEN'
Madgwick: turned by 90: 90; inclined by 30: 30
Mahony: turned by 90: 90; inclined by 30: 30
EKF: turned by 90: 90; inclined by 30: 30
Complementary: turned by 90: 0; inclined by 30: 30
UKF: turned by 90: 31; inclined by 30: 30
AQUA: turned by 90: -90; inclined by 30: -30
SEEN
