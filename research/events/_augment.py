"""Clean points of a sequence as a detector, a fit or a laboratory would see them, computed on the device.

Of each example: pace, view, mirror, where the markers sit, lean and its drift, noise (across and along the line of
sight, with and without memory, at the frame rate of the recording), a wrong scale, exchanged legs, gross outliers,
missing feet, joints, legs and frames, short recordings. All sizes are in metres for legs of about 0.8 m.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pbl_pipeline.gait.events.network.features import GRID_HZ, features, leg_length
from pbl_pipeline.gait.motion import LEG_JOINTS

#: Frames of a training window, and of the stretch that it is taken from (the pace may be faster).
WINDOW, SOURCE = 256, 324
_UP = np.array([0.0, 0.0, 1.0], np.float32)
#: Columns of the mirror image: left down, right up, right down, left up change places.
_MIRRORED = np.array([2, 3, 0, 1])


def augment(key: Any, xyz: Any, phase: Any, walks: Any) -> dict[str, Any]:
    """One example from points (SOURCE, 6, 2, 3), phases (SOURCE, 4) in turns (NaN: not defined) and walking (SOURCE,).

    Returns `features` (WINDOW, 40), `seen` (WINDOW,), `target` (WINDOW, 4, 2) cosine and sine, `defined` (WINDOW, 4),
    `walks` (WINDOW,).
    """
    k = iter(jax.random.split(key, 64))
    xyz, phase, walks = _paced(next(k), xyz, phase, walks)
    joints, known, mirror = _seen_joints(k, xyz)
    phase = jnp.where(mirror, phase[:, _MIRRORED], phase)
    scale = jnp.exp(0.03 * jax.random.normal(next(k)))
    leg = scale * leg_length(joints, known, jnp)
    leg = jnp.where(jnp.isfinite(leg) & (leg > 0.05), leg, 0.7)
    values, seen = features(joints, known, jnp.asarray(_UP), leg, jnp)
    turns = 2 * np.pi * jnp.nan_to_num(phase)
    defined = jnp.isfinite(phase) & seen[:, None] & walks[:, None]
    target = jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=-1)
    return {"features": values, "seen": seen, "target": target, "defined": defined, "walks": walks}


def seen_joints(key: Any, xyz: Any) -> tuple[Any, Any, Any]:
    """Return the seen part of points (T, 6, 2, 3) of any length: joints (T, 5, 2, 3), which are known (T, 5, 2), and
    whether left and right have changed places. As in training, but at the pace of the points and without the wrong
    scale."""
    return _seen_joints(iter(jax.random.split(key, 64)), xyz)


def _seen_joints(k: Iterator[Any], xyz: Any) -> tuple[Any, Any, Any]:
    joints = _markers(next(k), next(k), next(k), xyz)
    mirror = jax.random.bernoulli(next(k))
    joints = jnp.where(mirror, joints[:, :, ::-1] * jnp.array([1.0, -1.0, 1.0]), joints)
    joints = _turned_about_up(joints, jax.random.uniform(next(k), maxval=2 * np.pi))
    joints = _leaning(next(k), joints)
    joints = joints + _noise(next(k), joints.shape)
    joints = _exchanged(next(k), joints)
    joints = _outliers(next(k), joints)
    return joints, _missing(next(k), joints.shape[:3]), mirror


def _paced(key, xyz, phase, walks):
    """The same movement faster or slower by up to 18 %, WINDOW frames of it."""
    a, b = jax.random.split(key)
    rate = jnp.exp(jax.random.uniform(a, minval=np.log(0.85), maxval=np.log(1.18)))
    start = 1.0 + jax.random.uniform(b) * (SOURCE - 4 - rate * (WINDOW - 1))
    at = start + rate * jnp.arange(WINDOW)
    i = jnp.floor(at).astype(int)
    u = (at - i).reshape(-1, 1, 1, 1)
    p = [xyz[i + d] for d in (-1, 0, 1, 2)]
    # Catmull-Rom: cubic through the two nearest frames with the slopes of their neighbours.
    xyz = p[1] + 0.5 * u * (
        p[2] - p[0] + u * (2 * p[0] - 5 * p[1] + 4 * p[2] - p[3] + u * (3 * (p[1] - p[2]) + p[3] - p[0]))
    )
    v = u[:, :, 0, 0]
    return xyz, (1 - v) * phase[i] + v * phase[i + 1], walks[i] & walks[i + 1]


def _markers(key_toe, key_sole, key_each, xyz):
    """Joints (T, 5, 2, 3) of a marker set: the toe anywhere from the toes' joint to their end and on the top of the
    foot, the heel's marker higher or lower, each a little off."""
    hip, knee, ankle, heel, mtp, tip = (xyz[:, i] for i in range(6))
    along = _unit(mtp - heel)
    top = _unit((knee - ankle) - jnp.sum((knee - ankle) * along, -1, keepdims=True) * along)
    up_m = jax.random.uniform(key_sole, (4,), minval=-0.005, maxval=0.04)
    toe = mtp + jax.random.uniform(key_toe, minval=-0.1, maxval=1.0) * (tip - mtp) + up_m[0] * top
    heel = heel + up_m[1] * top + (up_m[2] - 0.02) * along
    ankle = ankle + (up_m[3] - 0.015) * top
    joints = jnp.stack([hip, knee, ankle, heel, toe], axis=1)
    a, b, c = jax.random.split(key_each, 3)
    size = jnp.exp(jax.random.uniform(a, minval=np.log(0.002), maxval=np.log(0.035)))
    both = jax.random.normal(b, (1, 5, 1, 3))
    each = jax.random.normal(c, (1, 5, 2, 3))
    return joints + size * (0.7 * both * jnp.array([1.0, 0.0, 1.0]) + 0.7 * each)


def _leaning(key, joints):
    """Turn all points about a level axis (gravity not known, a detector that leans people), slowly changing."""
    k = jax.random.split(key, 5)
    axis = jax.random.uniform(k[0], maxval=2 * np.pi)
    fixed = 0.07 * jax.random.normal(k[1])
    size = 0.035 * jnp.abs(jax.random.normal(k[2]))
    hz = jnp.exp(jax.random.uniform(k[3], minval=np.log(0.05), maxval=np.log(0.8)))
    time = jnp.arange(joints.shape[0]) / GRID_HZ
    angle = fixed + size * jnp.sin(2 * np.pi * (hz * time + jax.random.uniform(k[4])))
    middle = joints.mean(axis=(1, 2), keepdims=True)
    x = _turned_about_up(joints - middle, -axis)
    c, s = jnp.cos(angle)[:, None, None], jnp.sin(angle)[:, None, None]
    x = jnp.stack([c * x[..., 0] + s * x[..., 2], x[..., 1], c * x[..., 2] - s * x[..., 0]], axis=-1)
    return _turned_about_up(x, axis) + middle


def _noise(key, shape):
    """Noise of points; along a line of sight (x; the view was drawn before) up to three times as large."""
    k = jax.random.split(key, 9)
    t = shape[0]
    size = jnp.exp(jax.random.uniform(k[0], minval=np.log(0.0008), maxval=np.log(0.035)))
    size = jnp.where(jax.random.bernoulli(k[1], 0.15), 0.0, size)
    # Fresh noise comes with the recording's frames; the grid interpolates between them.
    fps = jnp.take(jnp.array([24.0, 30.0, 30.0, GRID_HZ]), jax.random.randint(k[2], (), 0, 4))
    fresh = jax.random.normal(k[3], (t + 2, *shape[1:]))
    at = jnp.arange(t) * fps / GRID_HZ
    i = jnp.floor(at).astype(int)
    u = (at - i).reshape(-1, 1, 1, 1)
    white = (1 - u) * fresh[i] + u * fresh[i + 1]
    slow = [_box(jax.random.normal(q, (t + n - 1, *shape[1:])), n) for q, n in ((k[4], 5), (k[5], 15), (k[6], 45))]
    fraction = jax.random.dirichlet(k[7], jnp.array([1.5, 0.8, 0.8, 0.8]))
    weight = jnp.sqrt(fraction)
    noise = weight[0] * white + sum(weight[j + 1] * s for j, s in enumerate(slow))
    deep = jax.random.uniform(k[8], minval=1.0, maxval=3.0)
    per_joint = jnp.array([0.8, 1.0, 1.0, 1.1, 1.2]).reshape(1, 5, 1, 1)
    return size * per_joint * noise * jnp.stack([deep, jnp.ones(()), jnp.ones(())])


def _box(x, n: int):
    """Mean of n in a row, brought back to standard deviation 1."""
    total = jnp.cumsum(jnp.pad(x, [(1, 0)] + [(0, 0)] * (x.ndim - 1)), axis=0)
    return (total[n:] - total[:-n]) / np.sqrt(n)


def _exchanged(key, joints):
    """Left and right exchanged below the hips for a moment."""
    k = jax.random.split(key, 3)
    wrong = _span(k[0], joints.shape[0], 4, 18) & jax.random.bernoulli(k[1], 0.08)
    swapped = joints.at[:, 1:].set(joints[:, 1:, ::-1])
    return jnp.where(wrong[:, None, None, None], swapped, joints)


def _outliers(key, joints):
    k = jax.random.split(key, 3)
    hit = jax.random.bernoulli(k[0], 0.01, joints.shape[:3]) & jax.random.bernoulli(k[1], 0.25)
    return joints + hit[..., None] * 0.15 * jax.random.normal(k[2], joints.shape)


def _missing(key, shape):
    """Return which joints (T, 5, 2) are known."""
    k = iter(jax.random.split(key, 24))
    t = shape[0]
    known = jnp.ones(shape, bool)
    foot = np.array([name in ("heel", "toe") for name in LEG_JOINTS])

    def gone(p, joints):
        return jax.random.bernoulli(next(k), p) & jnp.asarray(joints)

    # Marker sets without feet, heels, toes, knees, ankles.
    for p, names in (
        (0.25, ("heel", "toe")),
        (0.05, ("heel",)),
        (0.05, ("toe",)),
        (0.05, ("knee",)),
        (0.05, ("ankle",)),
    ):
        known &= ~gone(p, np.isin(LEG_JOINTS, names))[None, :, None]
    # One joint, one leg, everything for a while.
    joint = jax.nn.one_hot(jax.random.randint(next(k), (), 1, 5), 5, dtype=bool)[:, None]
    side = jax.nn.one_hot(jax.random.randint(next(k), (), 0, 2), 2, dtype=bool)[None, :]
    span = _span(next(k), t, 8, 100)[:, None, None]
    known &= ~(span & joint & side & jax.random.bernoulli(next(k), 0.2))
    below = jnp.asarray(np.array(LEG_JOINTS) != "hip")[:, None]
    span = _span(next(k), t, 8, 60)[:, None, None]
    known &= ~(span & below & side & jax.random.bernoulli(next(k), 0.12))
    span = _span(next(k), t, 8, 60)[:, None, None]
    known &= ~(span & jax.random.bernoulli(next(k), 0.12))
    one_foot = jax.random.bernoulli(next(k), 0.03) & jnp.asarray(foot)[:, None] & side
    known &= ~one_foot
    # Single points.
    known &= ~(jax.random.bernoulli(next(k), 0.03, shape) & jax.random.bernoulli(next(k), 0.2) & below)
    # A short recording.
    length = jnp.where(jax.random.bernoulli(next(k), 0.45), jax.random.randint(next(k), (), 50, t + 1), t)
    first = jax.random.randint(next(k), (), 0, t - length + 1)
    frame = jnp.arange(t)
    return known & ((frame >= first) & (frame < first + length))[:, None, None]


def _span(key, t: int, shortest: int, longest: int):
    """One stretch of frames, anywhere."""
    a, b = jax.random.split(key)
    length = jax.random.randint(a, (), shortest, longest)
    first = jax.random.randint(b, (), -longest, t)
    frame = jnp.arange(t)
    return (frame >= first) & (frame < first + length)


def _turned_about_up(x, angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * x[..., 0] - s * x[..., 1], s * x[..., 0] + c * x[..., 1], x[..., 2]], axis=-1)


def _unit(x):
    return x / jnp.sqrt(jnp.sum(x**2, axis=-1, keepdims=True) + 1e-9)
