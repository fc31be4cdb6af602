"""The implicit trajectory: a network from time to pose and camera (the paper, section Implicit Representation)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import SLIDES

#: The time encoding is padded to a multiple of this many frequencies: trials of like duration share a program.
FREQUENCY_BUCKET = 8
#: Small output weights: the trajectory starts nearly constant at its bias, the start pose.
FINAL_SCALE = 0.1

#: One network per trial: for each layer weights (N, inputs, outputs) and biases (N, outputs).
Networks = list[tuple[Array, Array]]


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


def initial_networks(
    seed: int, n_trials: int, n_frequency: int, hidden: Sequence[int], n_skip: int, n_out: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random networks, one per trial; a trial's does not depend on how many there are.

    Weights and biases are uniform within 1 / sqrt(inputs), as usual for such layers; the last layer's weights are
    small and its biases 0. The encoding enters the first layer and, beside its output, the next `n_skip`.
    """
    n_code = 2 * n_frequency
    n_padded = 2 * (n_frequency + -n_frequency % FREQUENCY_BUCKET)
    networks = []
    for trial in range(n_trials):
        rng = np.random.default_rng([seed, trial])
        layers, width = [], 0
        for i, out in enumerate([*hidden, n_out]):
            coded = i <= n_skip and i < len(hidden)
            bound = 1 / math.sqrt(width + n_code * coded)
            weight = rng.uniform(-bound, bound, (width + n_padded * coded, out)).astype(np.float32)
            bias = rng.uniform(-bound, bound, out).astype(np.float32)
            last = i == len(hidden)
            layers.append((weight * (FINAL_SCALE if last else 1), bias * (not last)))
            width = out
        networks.append(layers)
    weights = [np.stack(w) for w in zip(*([w for w, _ in net] for net in networks), strict=True)]
    biases = [np.stack(b) for b in zip(*([b for _, b in net] for net in networks), strict=True)]
    return list(zip(weights, biases, strict=True))


def evaluate(networks: Networks, code: Float[Array, "N B C"]) -> Float[Array, "N B O"]:
    """Outputs of each trial's network at its own encoded times, before the joint limits are applied (`pose_of`)."""
    x = code[..., :0]
    for i, (weight, bias) in enumerate(networks):
        if weight.shape[1] > x.shape[-1]:
            x = jnp.concatenate([x, code], axis=-1)
        x = jnp.einsum("nbi,nio->nbo", x, weight, precision="highest") + bias[:, None]
        if i < len(networks) - 1:
            x = jax.nn.relu(x)
    return x


#: The pelvis angles have no limit in the body; the tanh needs one. Rotation gets a full turn either way so that no
#: heading lies where the tanh is flat.
PELVIS_RANGE_RAD = {"pelvis_tilt": math.pi, "pelvis_list": math.pi, "pelvis_rotation": 2 * math.pi}


def fit_ranges(joint_names: Sequence[str], joint_range_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper bound (40,) of each coordinate in the fit and which are translations (40,) bool."""
    low, high = np.array(joint_range_rad[:, 0]), np.array(joint_range_rad[:, 1])
    is_translation = np.array([n in SLIDES for n in joint_names])
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
