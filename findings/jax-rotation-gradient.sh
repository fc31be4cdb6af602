#!/usr/bin/env bash
# The gradient of JAX's own Rotation is not a number at rest, because it divides by the length of the rotation vector.
#
# Seen 2026-11-29: jax 0.10.2 (jaxlie 1.5.0 beside it).
# Behaviour: `jax.scipy.spatial.transform.Rotation` has the values of SciPy's. Its gradient at a rotation of zero is NaN:
#   of a point that is turned by a rotation vector, and of the rotation vector or the angle between two equal
#   orientations, also if these come from Euler angles or a matrix. A turn of 1e-6 has a gradient. That of a point turned
#   by Euler angles is finite, and all of jaxlie's are.
# Matters: poses are fitted from zero, and a perfect fit has no angle left; one NaN makes all parameters NaN.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install jax==0.10.2 jaxlib==0.10.2 jaxlie==1.5.0 numpy==2.4.6
export JAX_PLATFORMS=cpu
observe venv <<'PY'
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)
point = jnp.array([0.0, 0.0, 1.0])

cases = {
    "rotated point": lambda x: Rotation.from_rotvec(x).apply(point).sum(),
    "rotation vector": lambda x: Rotation.from_rotvec(x).as_rotvec().sum(),
    "angle squared": lambda x: Rotation.from_rotvec(x).magnitude() ** 2,
    "angles x, y, z": lambda x: Rotation.from_rotvec(x).as_euler("xyz").sum(),
    "rotation vector, of a matrix": lambda x: Rotation.from_matrix(jnp.eye(3) + jnp.cross(jnp.eye(3), x)).as_rotvec().sum(),
    "rotated point, of angles": lambda x: Rotation.from_euler("xyz", x).apply(point).sum(),
    "rotation vector, of angles": lambda x: Rotation.from_euler("xyz", x).as_rotvec().sum(),
    "jaxlie, rotated point": lambda x: (jaxlie.SO3.exp(x) @ point).sum(),
    "jaxlie, rotation vector": lambda x: jaxlie.SO3.exp(x).log().sum(),
    "jaxlie, angle squared": lambda x: (jaxlie.SO3.exp(x).log() ** 2).sum(),
}
for name, value in cases.items():
    at = [jax.grad(value)(jnp.array([size, 0.0, 0.0])) for size in (0.0, 1e-6)]
    words = ["finite" if np.isfinite(np.asarray(x)).all() else "not a number" for x in at]
    print(f"{name}: at rest {words[0]}, turned by 1e-6 {words[1]}")
PY
expect <<'SEEN'
rotated point: at rest not a number, turned by 1e-6 finite
rotation vector: at rest not a number, turned by 1e-6 finite
angle squared: at rest not a number, turned by 1e-6 finite
angles x, y, z: at rest not a number, turned by 1e-6 finite
rotation vector, of a matrix: at rest not a number, turned by 1e-6 finite
rotated point, of angles: at rest finite, turned by 1e-6 finite
rotation vector, of angles: at rest not a number, turned by 1e-6 finite
jaxlie, rotated point: at rest finite, turned by 1e-6 finite
jaxlie, rotation vector: at rest finite, turned by 1e-6 finite
jaxlie, angle squared: at rest finite, turned by 1e-6 finite
SEEN
