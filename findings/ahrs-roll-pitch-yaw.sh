#!/usr/bin/env bash
# In ahrs an orientation has other roll, pitch and yaw as a matrix than as a quaternion; its power is not a rotation.
#
# Seen 2026-11-29: ahrs 0.4.0, numpy 2.4.6.
# Behaviour: `Quaternion.to_angles` and `q2rpy` return the angles that the quaternion was made of. `DCM(q=...).to_rpy` and
#   `q2euler` return those of the inverse rotation, with the other sign for a turn about one axis and other sizes else;
#   a DCM made of `rpy` takes the yaw first (a note says so), and its own `to_rpy` does not return them. `q**0.5`, half of
#   the turn in other libraries, has the length 2.28 for a quarter turn. `angular_velocities` has the opposite rate where
#   q becomes -q, which is the same orientation. No error or warning.
# Matters: exports of worn sensors hold such angles, and quaternions whose sign jumps. A roll of 10 degrees is read as
#   one of -10 or 1, and one sample says that the limb swings back.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install ahrs==0.4.0 numpy==2.4.6
observe venv <<'PY'
import numpy as np
from ahrs import DCM, Quaternion, QuaternionArray
from ahrs.common.orientation import q2euler, q2rpy


def show(name, angles):
    print(f"  {name}:", *np.round(np.rad2deg(np.asarray(angles)), 1) + 0.0)


for made in ([10, 0, 0], [10, 20, 30]):
    rpy = np.deg2rad(made)
    q = np.asarray(Quaternion(rpy=rpy))
    print("made of", *made)
    show("Quaternion.to_angles", Quaternion(q).to_angles())
    show("q2rpy", q2rpy(q))
    show("q2euler", q2euler(q))
    show("DCM(q).to_rpy", DCM(q=q).to_rpy())
    show("DCM(rpy) as a quaternion", Quaternion(DCM(rpy=rpy).to_quaternion()).to_angles())
    show("DCM(rpy).to_rpy", DCM(rpy=rpy).to_rpy())

quarter = Quaternion(rpy=np.deg2rad([0, 0, 90]))
print("length of the power 1/2 of a quarter turn:", round(float(np.linalg.norm(np.asarray(quarter**0.5))), 2))
half = np.deg2rad(30) * 0.01 * np.arange(5) / 2  # 30 degrees a second about the first axis
turning = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
turning[3:] *= -1
show("rates about the first axis, deg/s", QuaternionArray(turning).angular_velocities(0.01)[:, 0])
PY
expect <<'SEEN'
made of 10 0 0
  Quaternion.to_angles: 10.0 0.0 0.0
  q2rpy: 10.0 0.0 0.0
  q2euler: -10.0 0.0 0.0
  DCM(q).to_rpy: -10.0 0.0 0.0
  DCM(rpy) as a quaternion: 0.0 0.0 10.0
  DCM(rpy).to_rpy: 0.0 0.0 -10.0
made of 10 20 30
  Quaternion.to_angles: 10.0 20.0 30.0
  q2rpy: 10.0 20.0 30.0
  q2euler: 1.1 -22.2 -28.5
  DCM(q).to_rpy: 1.1 -22.2 -28.5
  DCM(rpy) as a quaternion: 30.0 20.0 10.0
  DCM(rpy).to_rpy: -28.5 -22.2 1.1
length of the power 1/2 of a quarter turn: 2.28
  rates about the first axis, deg/s: 30.0 30.0 -30.0 30.0
SEEN
