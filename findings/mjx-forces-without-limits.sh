#!/usr/bin/env bash
# In MJX the accelerometers and the sensors of force and torque of a model without constraints read zero.
#
# Seen 2026-11-29: mujoco 4.0.0, mujoco-mjx 3.17.0, jax 0.10.2 (as with mujoco 3.17.0).
# Behaviour: `mjx.forward` and `mjx.step` return before the sensors of the stage of accelerations if no row of
#   constraints can ever be there: no contact pair, no limit, no friction, no equality. Accelerometer, framelinacc,
#   frameangacc, force, torque and actuatorfrc stay 0, without a word; those of positions and velocities are right. With
#   a limit that is never reached all are right, but force and torque leave out the pull of a spatial tendon.
# Matters: a body that is moved without a floor is what is simulated for worn sensors and for joint loads. Its
#   accelerometers lack gravity as well, so that the zeros look like free fall.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install mujoco==4.0.0 mujoco-mjx==3.17.0 jax==0.10.2 jaxlib==0.10.2 numpy==2.4.6
export JAX_PLATFORMS=cpu
observe venv <<'PY'
import contextlib
import io

import jax
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # it prints that NVIDIA's Warp is missing
    from mujoco import mjx

jax.config.update("jax_enable_x64", True)
TENDON = '<tendon><spatial stiffness="500" springlength="0.1"><site site="hip"/><site site="foot"/></spatial></tendon>'
SENSORS = ("gyro", "accelerometer", "force", "torque")


def seen(case, limit="", tendon=""):
    """Lengths of the sensors' vectors on the shank of a leg that hangs and swings; the first of each pair is C's."""
    sensors = "".join(f'<{kind} site="shank"/>' for kind in SENSORS)
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
        <default><geom type="capsule" size="0.05 0.2" contype="0" conaffinity="0"/><joint axis="0 1 0" {limit}/></default>
        <worldbody><body pos="0 0 1"><joint/><geom mass="8" pos="0 0 -0.2"/><site name="hip" pos="0.1 0 0"/>
          <body pos="0 0 -0.4"><joint/><geom mass="4" pos="0 0 -0.2"/><site name="shank" pos="0 0 -0.1"/>
            <site name="foot" pos="0.1 0 -0.4"/></body></body></worldbody>
        {tendon}<sensor>{sensors}</sensor></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.3, -0.4], [2, 1]
    found = mjx.forward(mjx.put_model(model), mjx.put_data(model, data))
    mujoco.mj_forward(model, data)
    assert np.allclose(found.qacc, data.qacc)
    for at, kind in enumerate(SENSORS):
        c, jax_ = (np.linalg.norm(np.asarray(x.sensordata)[3 * at : 3 * at + 3]) for x in (data, found))
        print(f"{case}: {kind} {c:.2f} {jax_:.2f}")


seen("free")
seen("limits at 170 degrees", limit='range="-170 170"')
seen("the same with a tendon", limit='range="-170 170"', tendon=TENDON)
PY
expect <<'SEEN'
free: gyro 3.00 3.00
free: accelerometer 10.83 0.00
free: force 43.17 0.00
free: torque 0.97 0.00
limits at 170 degrees: gyro 3.00 3.00
limits at 170 degrees: accelerometer 10.83 10.83
limits at 170 degrees: force 43.17 43.17
limits at 170 degrees: torque 0.97 0.97
the same with a tendon: gyro 3.00 3.00
the same with a tendon: accelerometer 38.84 38.84
the same with a tendon: force 175.47 193.36
the same with a tendon: torque 5.79 44.99
SEEN
