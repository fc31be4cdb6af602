"""Input of the event model: the joints of both legs in a frame that moves and turns with the body, on an even grid.

Everything here works on NumPy and on JAX arrays (`xp`), so that training and inference share the same code.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from pbl_pipeline.gait.motion import LEG_JOINTS

#: Frames a second of the grid.
GRID_HZ = 50.0
#: Per frame: each joint's place (3) and whether it is known (1), for left and right.
N_FEATURES = len(LEG_JOINTS) * 2 * 4
#: Frames over which the hip line is averaged, twice, for the heading: a stride or so.
HEADING_FRAMES = 51


def features(joints_m: Any, known: Any, up: Any, leg_m: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Features (T, 40) and whether the frame has any (T,), from joints (T, 5, 2, 3) and `known` (T, 5, 2).

    Origin: middle of the hips. Axes: ahead (horizontal, across the hip line averaged over a stride), left, `up` (3,).
    Unit: `leg_m`. Frames without both hips have none. Unknown values of `joints_m` do not matter.
    """
    hips = known[:, 0, 0] & known[:, 0, 1]
    clean = xp.where(known[..., None], joints_m, 0.0)
    pelvis = 0.5 * (clean[:, 0, 0] + clean[:, 0, 1])
    ahead = heading(clean[:, 0, 0] - clean[:, 0, 1], hips, up, xp)
    left = xp.cross(up, ahead)
    axes = xp.stack([ahead, left, xp.broadcast_to(up, ahead.shape)], axis=1)
    off = (clean - pelvis[:, None, None]) / leg_m
    body = xp.einsum("tij,tpsj->tpsi", axes, off)
    use = known & hips[:, None, None]
    body = xp.where(use[..., None], body, 0.0)
    n = body.shape[0]
    return xp.concatenate([body.reshape(n, -1), 1.0 * use.reshape(n, -1)], axis=1), hips


def mirrored(values: np.ndarray) -> np.ndarray:
    """Return the features (..., 40) of the mirror image of their walk: sides exchanged, the axis to the left turned."""
    places, known = np.split(values, [3 * N_FEATURES // 4], axis=-1)
    shape = (*values.shape[:-1], len(LEG_JOINTS), 2)
    places = places.reshape(*shape, 3)[..., ::-1, :] * np.array([1.0, -1.0, 1.0], values.dtype)
    known = known.reshape(shape)[..., ::-1]
    return np.concatenate([v.reshape(*values.shape[:-1], -1) for v in (places, known)], axis=-1)


def heading(line_m: Any, known: Any, up: Any, xp: ModuleType = np) -> Any:
    """Unit horizontal heading (T, 3) from the line right to left hip (T, 3): averaged, then left x up."""
    flat = line_m - (line_m @ up)[:, None] * up
    smooth, enough = _moving_mean(flat, known, HEADING_FRAMES, xp)
    smooth, _ = _moving_mean(smooth, enough, HEADING_FRAMES, xp)
    ahead = xp.cross(smooth, up)
    length = xp.sqrt(xp.sum(ahead**2, axis=1, keepdims=True) + 1e-12)
    return ahead / length


def leg_length(joints_m: Any, known: Any, xp: ModuleType = np) -> Any:
    """A length of the leg (m): nearly the greatest distance of the ankles from the middle of the hips.

    A heel replaces an ankle that is missing in the whole trial. NaN if neither is known.
    """
    pelvis = 0.5 * (joints_m[:, 0, 0] + joints_m[:, 0, 1])
    hips = known[:, 0, 0] & known[:, 0, 1]
    ankle = xp.linalg.norm(xp.where(known[:, 2, :, None], joints_m[:, 2] - pelvis[:, None], xp.nan), axis=-1)
    heel = xp.linalg.norm(xp.where(known[:, 3, :, None], joints_m[:, 3] - pelvis[:, None], xp.nan), axis=-1)
    ankle, heel = xp.where(hips[:, None], ankle, xp.nan), xp.where(hips[:, None], heel, xp.nan)
    use = xp.where(xp.any(xp.isfinite(ankle)), ankle, heel / HEEL_FURTHER)
    return xp.nanpercentile(use, 90.0)


#: The heel is further from the pelvis than the ankle by this factor.
HEEL_FURTHER = 1.07


def _moving_mean(values: Any, known: Any, frames: int, xp: ModuleType) -> tuple[Any, Any]:
    """Mean of the known rows (T, C) within half of `frames` to both sides; and where there is one."""
    half = frames // 2
    pad = [(half + 1, half), (0, 0)]
    total = xp.cumsum(xp.pad(xp.where(known[:, None], values, 0.0), pad), axis=0)
    count = xp.cumsum(xp.pad(1.0 * known[:, None], pad), axis=0)
    total, count = total[2 * half + 1 :] - total[: -2 * half - 1], count[2 * half + 1 :] - count[: -2 * half - 1]
    return total / xp.maximum(count, 1.0), count[:, 0] > 0.5
