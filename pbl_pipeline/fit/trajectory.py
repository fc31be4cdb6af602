"""The implicit trajectory: a network from time to pose and camera (the paper, section Implicit Representation)."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import Body

#: The time encoding is padded to a multiple of this many frequencies: trials of like duration share a program.
FREQUENCY_BUCKET = 8
#: Small output weights: the trajectory starts nearly constant at its bias, the start pose.
FINAL_SCALE = 0.1


def frequencies(duration_s: float, max_frequency_rad_s: float, pairs_per_octave: int) -> np.ndarray:
    """Angular frequencies (rad/s) of the time encoding, from half a turn over the trial up to the maximum."""
    lowest = math.pi / duration_s
    octaves = max(math.log2(max_frequency_rad_s / lowest), 1.0)
    k = np.arange(math.ceil(octaves * pairs_per_octave) + 1)
    return lowest * 2.0 ** (k / pairs_per_octave)


def encode(time_s: np.ndarray, omega_rad_s: np.ndarray) -> np.ndarray:
    """(..., 2 K) sines and cosines of times (...); K is the number of frequencies, padded with columns of 0."""
    phase = np.asarray(time_s)[..., None] * omega_rad_s
    pad = [(0, 0)] * (phase.ndim - 1) + [(0, -len(omega_rad_s) % FREQUENCY_BUCKET)]
    return np.concatenate([np.pad(np.sin(phase), pad), np.pad(np.cos(phase), pad)], axis=-1)


class Trajectory(eqx.Module):
    """`f_phi`: the encoded time (C,) to the pose and the camera's rotation vector (O,), before the joint limits are
    applied (`pose_of`). The encoding enters the first layer and, beside its output, the next `n_skip`.

    Weights and biases begin uniform within 1 / sqrt(inputs), as equinox' layers do; the last layer's weights are small
    and its biases 0.
    """

    layers: tuple[eqx.nn.Linear, ...]
    n_skip: int = eqx.field(static=True)

    def __init__(self, n_code: int, hidden: Sequence[int], n_skip: int, n_out: int, *, key: Array):
        layers, width = [], 0
        for i, out in enumerate([*hidden, n_out]):
            coded = i <= n_skip and i < len(hidden)
            key, own = jax.random.split(key)
            layers.append(eqx.nn.Linear(width + n_code * coded, out, key=own))
            width = out
        last = layers[-1]
        small = FINAL_SCALE * last.weight, jnp.zeros_like(last.bias)
        layers[-1] = eqx.tree_at(lambda a: (a.weight, a.bias), last, small)
        self.layers, self.n_skip = tuple(layers), n_skip

    def __call__(self, code: Float[Array, " C"]) -> Float[Array, " O"]:
        x = code[:0]
        for i, layer in enumerate(self.layers):
            coded = i <= self.n_skip and i < len(self.layers) - 1
            x = layer(jnp.concatenate([x, code]) if coded else x)
            x = jax.nn.relu(x) if i < len(self.layers) - 1 else x
        return x


def initial_trajectories(
    seed: int, n_trials: int, n_code: int, hidden: Sequence[int], n_skip: int, n_out: int
) -> Trajectory:
    """Random trajectories, one per trial, stacked; a trial's does not depend on how many there are."""
    keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(seed)))(jnp.arange(n_trials))
    return eqx.filter_vmap(lambda key: Trajectory(n_code, hidden, n_skip, n_out, key=key))(keys)


def evaluate(trajectories: Trajectory, code: Float[Array, "N B C"]) -> Float[Array, "N B O"]:
    """Outputs of each trial's trajectory at its own encoded times."""
    # GPUs round the factors of float32 products to ten bits unless told otherwise.
    with jax.default_matmul_precision("highest"):
        return eqx.filter_vmap(lambda f, times: jax.vmap(f)(times))(trajectories, code)


#: The pelvis angles have no limit in the body; the tanh needs one. Rotation gets a full turn either way so that no
#: heading lies where the tanh is flat.
PELVIS_RANGE_RAD = {"pelvis_tilt": math.pi, "pelvis_list": math.pi, "pelvis_rotation": 2 * math.pi}


def fit_ranges(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound (Q,) of each joint in the fit; those of slides are not used and only finite."""
    low, high = np.array(body.joint_range_rad.T)
    for name, bound in PELVIS_RANGE_RAD.items():
        if name in body.joint_names:
            i = body.joint_names.index(name)
            low[i], high[i] = -bound, bound
    low[body.is_slide], high[body.is_slide] = -1.0, 1.0
    return low, high


def pose_of(
    raw: Float[Array, "... Q"],
    low: Float[Array, " Q"],
    high: Float[Array, " Q"],
    is_slide: Array,
) -> Float[Array, "... Q"]:
    """qpos from the network's output: rotations through tanh onto their range, the pelvis position as it is."""
    limited = low + (high - low) * 0.5 * (jnp.tanh(raw) + 1.0)
    return jnp.where(is_slide, raw, limited)


def raw_of(qpos: np.ndarray, low: np.ndarray, high: np.ndarray, is_slide: np.ndarray) -> np.ndarray:
    """The inverse of `pose_of`; poses at or beyond a limit are first moved 1 % of the range inside."""
    unit = np.clip((qpos - low) / (high - low), 0.01, 0.99)
    return np.where(is_slide, qpos, np.arctanh(2 * unit - 1))
