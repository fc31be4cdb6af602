#!/usr/bin/env bash
# kielmat's Madgwick filter makes the caller's accelerations unit vectors, and its quaternion grows in turns.
#
# Seen 2026-11-30: kielmat 0.0.5, numpy 1.26.4, scipy 1.17.1, pandas 2.3.3.
# Behaviour: `BasicMadgwickAHRS.update` divides the arrays that it is given by their length, in place: a row of a
#   recording in m/s2 has the length 1 afterwards, one of the magnetometer as well.
#   The quaternion is not normalised. Its length is held by the correction to gravity alone, which cannot see it where the
#   sensor's z axis is vertical: after a minute of turns at 200 deg/s it is 2.5, and `quat2rotm` makes 9.9 m of 1 m. With
#   the axis 15 deg off the vertical the orientation is 12 deg off, 1.2 if the quaternion is normalised after each step.
#   From 30 deg on, and with a magnetometer, the length is held.
#   With `scalar_first=False` `quatconj`, `quatinv` and `quatmultiply` move the scalar part of the caller's array to the
#   front: the second call with the same array has another result, and so has a product of an array with itself.
#   `axang2rotm` makes the caller's axes unit vectors.
# Matters: what is computed from the accelerations afterwards (velocity, height of a step, activity) is that of unit
#   vectors; the z axis of a sensor that lies flat on a foot is near the vertical.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install kielmat==0.0.5 numpy==1.26.4 scipy==1.17.1 pandas==2.3.3
observe venv <<'PY'
import numpy as np
from kielmat.utils import quaternion
from kielmat.utils.orientation_estimation import BasicMadgwickAHRS
from scipy.spatial.transform import Rotation

RATE = 100
TIME = np.arange(60 * RATE + 1) / RATE
CASES = ((0, 0.1, False), (0, 0.03, False), (5, 0.1, False), (15, 0.1, False), (30, 0.1, False), (0, 0.1, True))


def scalar_first(rotation):
    return rotation.as_quat()[[3, 0, 1, 2]]


def run(true, beta, magnetic, normalise):
    """The last quaternion of a filter that begins at the truth, its accelerations and magnetometer afterwards."""
    rates = (true[:-1].inv() * true[1:]).as_rotvec() * RATE
    accelerations = true[1:].inv().apply([0, 0, 9.81])
    fields = true[1:].inv().apply([20, 0, -40])
    ahrs = BasicMadgwickAHRS(1 / RATE, q0=scalar_first(true[0]), beta=beta)
    for i in range(len(rates)):
        ahrs.update(rates[i], accelerations[i], fields[i] if magnetic else None)
        if normalise:
            ahrs._state.quat /= np.linalg.norm(ahrs._state.quat)
    return ahrs._state.quat, accelerations, fields


for deg_s in (0, 100, 200):
    turns = Rotation.from_rotvec(np.deg2rad(deg_s) * TIME[:, None] * [0, 0, 1])
    for tilt, beta, magnetic in CASES if deg_s == 200 else CASES[:1]:
        true = turns * Rotation.from_euler("y", tilt, degrees=True)
        off = []
        for normalise in (True, False):
            last, accelerations, fields = run(true, beta, magnetic, normalise)
            found = Rotation.from_quat(last[[1, 2, 3, 0]])
            off.append(np.degrees((found * true[-1].inv()).magnitude()))
        metre = np.linalg.norm(quaternion.quat2rotm(last) @ [1, 0, 0])
        print(f"{deg_s} deg/s, z axis {tilt} deg off the vertical, beta {beta}{', magnetometer' if magnetic else ''}:",
              f"length {np.linalg.norm(last):.2f}, {off[1]:.1f} deg off (normalised {off[0]:.1f}), 1 m is {metre:.1f} m")
print(f"accelerations of 9.81 m/s2 afterwards: {np.linalg.norm(accelerations, axis=1).mean():.2f};",
      f"magnetometer of 44.7 uT: {np.linalg.norm(fields, axis=1).mean():.2f}")

x, y = Rotation.from_rotvec([0.4, 0.8, -0.3]), Rotation.from_rotvec([-0.9, 0.2, 0.5])


def off(quaternion_xyzw, truth):
    return f"{np.degrees((Rotation.from_quat(quaternion_xyzw) * truth.inv()).magnitude()):.0f} deg off"


for name, call, truth in (
    ("quatconj(x)", lambda a, b: quaternion.quatconj(a, scalar_first=False), x.inv()),
    ("quatinv(x)", lambda a, b: quaternion.quatinv(a, scalar_first=False), x.inv()),
    ("quatmultiply(x, y)", lambda a, b: quaternion.quatmultiply(a, b, scalar_first=False), x * y),
    ("quatmultiply(x, x)", lambda a, b: quaternion.quatmultiply(a, a, scalar_first=False), x * x),
):
    a, b = x.as_quat(), y.as_quat()
    first = off(call(a, b), truth)
    print(f"{name}, scalar last: {first}; x is changed: {not np.array_equal(a, x.as_quat())};",
          f"the second call {off(call(a, b), truth)}")
axis_angle = np.array([0, 0, 2, 0.5])
quaternion.axang2rotm(axis_angle)
print("axis (0, 0, 2) after axang2rotm:", axis_angle[:3].tolist())
PY
expect <<'SEEN'
0 deg/s, z axis 0 deg off the vertical, beta 0.1: length 1.00, 0.0 deg off (normalised 0.0), 1 m is 1.0 m
100 deg/s, z axis 0 deg off the vertical, beta 0.1: length 1.26, 0.2 deg off (normalised 0.2), 1 m is 1.9 m
200 deg/s, z axis 0 deg off the vertical, beta 0.1: length 2.49, 1.2 deg off (normalised 1.2), 1 m is 9.9 m
200 deg/s, z axis 0 deg off the vertical, beta 0.03: length 2.49, 1.2 deg off (normalised 1.2), 1 m is 9.9 m
200 deg/s, z axis 5 deg off the vertical, beta 0.1: length 2.15, 6.9 deg off (normalised 1.2), 1 m is 6.9 m
200 deg/s, z axis 15 deg off the vertical, beta 0.1: length 1.16, 12.3 deg off (normalised 1.2), 1 m is 1.5 m
200 deg/s, z axis 30 deg off the vertical, beta 0.1: length 1.00, 0.6 deg off (normalised 1.2), 1 m is 1.0 m
200 deg/s, z axis 0 deg off the vertical, beta 0.1, magnetometer: length 1.00, 2.0 deg off (normalised 2.0), 1 m is 1.0 m
accelerations of 9.81 m/s2 afterwards: 1.00; magnetometer of 44.7 uT: 1.00
quatconj(x), scalar last: 0 deg off; x is changed: True; the second call 173 deg off
quatinv(x), scalar last: 0 deg off; x is changed: True; the second call 173 deg off
quatmultiply(x, y), scalar last: 0 deg off; x is changed: True; the second call 99 deg off
quatmultiply(x, x), scalar last: 97 deg off; x is changed: True; the second call 104 deg off
axis (0, 0, 2) after axang2rotm: [0.0, 0.0, 1.0]
SEEN
