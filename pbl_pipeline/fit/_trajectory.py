"""The implicit trajectory: a network from time to pose (the paper, section Implicit Representation)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray


def frequencies(duration_s: float, max_frequency_rad_s: float, pairs_per_octave: int) -> np.ndarray:
    """Angular frequencies (rad/s) of the time encoding, from half a turn over the trial up to the maximum."""
    lowest = math.pi / duration_s
    octaves = max(math.log2(max_frequency_rad_s / lowest), 1.0)
    k = np.arange(math.ceil(octaves * pairs_per_octave) + 1)
    return lowest * 2.0 ** (k / pairs_per_octave)


class ImplicitTrajectory(eqx.Module):
    """Multi-layer perceptron on a sinusoidal encoding of time; the encoding also enters the first `n_skip` layers.

    Output: 40 numbers per time, before the joint limits are applied (`pose_of`).
    """

    layers: list[eqx.nn.Linear]
    n_skip: int = eqx.field(static=True)

    def __init__(
        self, n_frequency: int, hidden: Sequence[int], n_skip: int, n_out: int, final_scale: float, *, key: PRNGKeyArray
    ) -> None:
        n_code = 2 * n_frequency
        keys = jax.random.split(key, len(hidden) + 1)
        layers, width = [], n_code
        for i, (n, k) in enumerate(zip(hidden, keys[:-1], strict=True)):
            extra = n_code if 0 < i <= n_skip else 0
            layers.append(eqx.nn.Linear(width + extra, n, key=k))
            width = n
        last = eqx.nn.Linear(width, n_out, key=keys[-1])
        # Small output weights: the trajectory starts nearly constant at its bias, the start pose.
        last = eqx.tree_at(lambda m: (m.weight, m.bias), last, (last.weight * final_scale, jnp.zeros(n_out)))
        self.layers, self.n_skip = [*layers, last], n_skip

    def __call__(self, time_s: Float[Array, ""], omega_rad_s: Float[Array, " F"]) -> Float[Array, " 40"]:
        phase = omega_rad_s * time_s
        code = jnp.concatenate([jnp.sin(phase), jnp.cos(phase)])
        x = code
        for i, layer in enumerate(self.layers[:-1]):
            if 0 < i <= self.n_skip:
                x = jnp.concatenate([x, code])
            x = jax.nn.relu(layer(x))
        return self.layers[-1](x)


#: The pelvis angles have no limit in the body; the tanh needs one. Rotation gets a full turn either way so that no
#: heading lies where the tanh is flat.
PELVIS_RANGE_RAD = {"pelvis_tilt": math.pi, "pelvis_list": math.pi, "pelvis_rotation": 2 * math.pi}


def fit_ranges(joint_names: Sequence[str], joint_range_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper bound (40,) of each coordinate in the fit and which are translations (40,) bool."""
    low, high = np.array(joint_range_rad[:, 0]), np.array(joint_range_rad[:, 1])
    is_translation = np.array([n in ("pelvis_tx", "pelvis_ty", "pelvis_tz") for n in joint_names])
    for name, bound in PELVIS_RANGE_RAD.items():
        i = list(joint_names).index(name)
        low[i], high[i] = -bound, bound
    low[is_translation], high[is_translation] = -1.0, 1.0  # not used; keeps the arithmetic below finite
    return low, high, is_translation


def pose_of(
    raw: Float[Array, "... 40"],
    low: Float[Array, " 40"],
    high: Float[Array, " 40"],
    is_translation: Array,
) -> Float[Array, "... 40"]:
    """qpos from the network's output: rotations through tanh onto their range, the pelvis position as it is."""
    limited = low + (high - low) * 0.5 * (jnp.tanh(raw) + 1.0)
    return jnp.where(is_translation, raw, limited)


def raw_of(qpos: np.ndarray, low: np.ndarray, high: np.ndarray, is_translation: np.ndarray) -> np.ndarray:
    """The inverse of `pose_of`; poses at or beyond a limit are first moved 1 % of the range inside."""
    unit = np.clip((qpos - low) / (high - low), 0.01, 0.99)
    return np.where(is_translation, qpos, np.arctanh(2 * unit - 1))
