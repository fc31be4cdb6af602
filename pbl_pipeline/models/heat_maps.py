"""Points of a landmark network refined by its heat maps, as one rule for NumPy and JAX.

BlazePose's landmark networks return, beside the points, a map of logits for each. The mean of a peak is more precise
than the regressed point. The rule is continuous: a point moves by no step where a peak crosses the border of a cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

#: Cells of a side of a map, and pixels of the network's picture from one to the next. Cell i is at i * `CELL_PX`: a
#: peak then lies, in the mean, where the regressed point lies, in the picture and in its mirror image.
SIDE, CELL_PX = 64, 4.0
#: A peak further than this (cells) along an axis from the regressed point is not seen.
_REACH = 7.5
_STEPS = 3
#: Weight of the point itself in each mean, in cells with a probability of 1: decides where a map is black.
_LEAST = 1e-6


def refined(points: Any, logits: Any, sd_cells: float, xp: Any = np) -> Any:
    """Move points towards the means of their peaks (mean shift in a Gaussian window): the nearer and the higher a
    peak, the further; not at all for a black map.

    Parameters
    ----------
    points : (J, 2)
        x, y in px of the network's picture, also beyond it.
    logits : (SIDE, SIDE, J)
        Map of each point, rows downwards.
    sd_cells
        Standard deviation of the window.
    xp
        `numpy`, or `jax.numpy` within a program.

    Returns
    -------
    (J, 2)
        In px.
    """
    start = points / CELL_PX
    half = int(_REACH + 0.5)
    first = xp.clip(xp.round(start).astype(int) - half, 0, SIDE - 2 * half - 1)
    cells = first[:, :, None] + np.arange(2 * half + 1)  # (J, 2, K)
    x, y, cells = cells[:, 0], cells[:, 1], cells.astype(points.dtype)
    near = xp.maximum(1.0 - ((cells - start[:, :, None]) / _REACH) ** 2, 0.0)
    found = logits[y[:, :, None], x[:, None, :], np.arange(len(points))[:, None, None]]
    values = (0.5 + 0.5 * xp.tanh(0.5 * found)) * near[:, 1, :, None] * near[:, 0, None, :]
    at = start
    for _ in range(_STEPS):
        off = cells - at[:, :, None]
        window = xp.exp(-0.5 * (off / sd_cells) ** 2)
        moments = xp.stack([window, window * off], axis=2)  # (J, 2, 2, K)
        sums = moments[:, 1] @ values @ xp.swapaxes(moments[:, 0], 1, 2)  # (J, 2, 2): orders in y, in x
        at = at + xp.stack([sums[:, 0, 1], sums[:, 1, 0]], axis=1) / (sums[:, :1, 0] + _LEAST)
    window = xp.exp(-0.5 * ((cells - at[:, :, None]) / sd_cells) ** 2)
    height = (values * window[:, 1, :, None] * window[:, 0, None, :]).max((1, 2))
    return CELL_PX * (start + height[:, None] * (at - start))


def decoded(outputs: Mapping[int, Any], sd_cells: float, xp: Any = np) -> dict[int, Any]:
    """Refine the points among the outputs of a network for one picture, keyed by their number of elements: rows of five
    values, of which the first two are x and y. The maps are left out."""
    n = max(outputs) // SIDE**2
    rows = outputs[5 * n].reshape(n, 5)
    points = refined(rows[:, :2], outputs[n * SIDE**2].reshape(SIDE, SIDE, n), sd_cells, xp)
    rows = xp.concatenate([points.astype(rows.dtype), rows[:, 2:]], axis=1)
    return {size: v for size, v in outputs.items() if size != n * SIDE**2} | {5 * n: rows.reshape(-1)}
