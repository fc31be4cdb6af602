"""From the joints of both legs to the model's phases: an even grid, features, windows, the network."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import PchipInterpolator

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.sampling import interval_of

from .features import GRID_HZ, features, heading, leg_length, mirrored

#: Frames of a window as in training; windows begin every `HOP`; so many are computed at once.
WINDOW, HOP, CHUNK = 256, 160, 8
#: A joint that is missing for no longer than this is interpolated (s).
MAX_GAP_S = 0.2
#: Recordings with more frames a second are averaged over a step of the grid.
_AVERAGE_ABOVE_HZ = 75.0
#: The network's outputs of the mirror image of a walk in the order of the walk's own.
_MIRRORED = [4, 5, 6, 7, 0, 1, 2, 3, 8]
DATA = Path(__file__).parents[1] / "data"


@dataclasses.dataclass(frozen=True, eq=False)
class Grid:
    """Joints on an even grid: `time_s` (N,), `joints_m` (N, 5, 2, 3), `known` (N, 5, 2), `up` (3,), `leg_m`,
    `ahead` (N, 3) the heading."""

    time_s: Float[np.ndarray, " N"]
    joints_m: Float[np.ndarray, "N 5 2 3"]
    known: Bool[np.ndarray, "N 5 2"]
    up: Float[np.ndarray, " 3"]
    ahead: Float[np.ndarray, "N 3"]
    leg_m: float


@dataclasses.dataclass(frozen=True, eq=False)
class Phases:
    """Output of the network: `z` (N, 4) complex phases of left down, right up, right down, left up, 0 where nothing is
    seen; `walking` (N,) probability; `seen` (N,)."""

    z: np.ndarray
    walking: Float[np.ndarray, " N"]
    seen: Bool[np.ndarray, " N"]


def on_grid(time_s: np.ndarray, legs_m: Float[np.ndarray, "T 5 2 3"], up: np.ndarray) -> Grid:
    """Joints at `GRID_HZ` from the first to the last time stamp. Short gaps are filled, long ones stay unknown."""
    time_s = np.asarray(time_s, float)
    n = int(np.floor((time_s[-1] - time_s[0]) * GRID_HZ + 1e-6)) + 1
    grid = time_s[0] + np.arange(n) / GRID_HZ
    joints, known = np.zeros((n, *legs_m.shape[1:])), np.zeros((n, *legs_m.shape[1:3]), bool)
    fast = len(time_s) > 2 and 1 / interval_of(time_s) > _AVERAGE_ABOVE_HZ
    for j in range(legs_m.shape[1]):
        for s in range(2):
            own = np.flatnonzero(np.isfinite(legs_m[:, j, s]).all(axis=1))
            if len(own) < 2:
                continue
            t, x = time_s[own], np.asarray(legs_m[own, j, s], float)
            if fast:
                x = _averaged(t, x, 1 / GRID_HZ)
            inside = (grid >= t[0]) & (grid <= t[-1])
            right = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
            gap = t[right] - t[right - 1]
            on_frame = np.abs(t[right] - grid) < 1e-6
            use = inside & ((gap <= MAX_GAP_S) | on_frame)
            if np.any(use):
                joints[use, j, s] = PchipInterpolator(t, x, axis=0)(grid[use])
                known[:, j, s] = use
    up = np.asarray(up, float)
    line = joints[:, 0, 0] - joints[:, 0, 1]
    hips = known[:, 0].all(axis=1)
    measured = np.any(known[hips, 2:4])
    leg = float(leg_length(joints, known)) if measured else float("nan")
    return Grid(grid, joints, known, up, heading(line, hips, up), leg)


def predict(grid: Grid, model: str, both: bool = False) -> Phases:
    """The network's phases on the grid: overlapping windows, the middle of each counting most. `both`: the mean of the
    outputs for the walk and for its mirror image."""
    values, seen = features(grid.joints_m, grid.known, grid.up, grid.leg_m)
    n = len(values)
    starts = list(range(0, max(n - WINDOW, 0) + HOP, HOP)) if n > WINDOW else [0]
    padded = np.zeros((starts[-1] + WINDOW, values.shape[1]), np.float32)
    there = np.zeros(len(padded), bool)
    padded[:n], there[:n] = values, seen
    cuts = np.array([s for s in starts if there[s : s + WINDOW].any()], int)
    total, weight = np.zeros((len(padded), 9)), np.zeros(len(padded))
    # The middle of a window has context on both sides; its ends count little where another window has its middle.
    ramp = 0.05 + np.minimum(np.arange(WINDOW), np.arange(WINDOW)[::-1]) / (WINDOW / 2)
    network, _ = load(model)
    run = _compiled()
    for i in range(0, len(cuts), CHUNK):
        own = cuts[i : i + CHUNK]
        batch = np.zeros((CHUNK, WINDOW, values.shape[1]), np.float32)
        mask = np.zeros((CHUNK, WINDOW), bool)
        for k, s in enumerate(own):
            batch[k], mask[k] = padded[s : s + WINDOW], there[s : s + WINDOW]
        if both:
            batch, mask = np.concatenate([batch, mirrored(batch)]), np.concatenate([mask, mask])
        out = np.asarray(run(network, batch, mask), float)
        if both:
            out = 0.5 * (out[:CHUNK] + out[CHUNK:, :, _MIRRORED])
        for k, s in enumerate(own):
            total[s : s + WINDOW] += ramp[:, None] * out[k]
            weight[s : s + WINDOW] += ramp
    mean = total[:n] / np.maximum(weight[:n, None], 1e-9)
    z = np.where(seen[:, None], mean[:, 0:8:2] + 1j * mean[:, 1:8:2], 0.0)
    walking = np.where(seen, 1 / (1 + np.exp(-np.clip(mean[:, 8], -50, 50))), 0.0)
    return Phases(z, walking, seen)


@functools.cache
def load(model: str) -> tuple[Any, dict[str, Any]]:
    """Network and its metadata (`probability`: the calibration), by its name in `data/` or by path."""
    from .transformer import load_model

    return load_model(model_path(model))


def model_path(model: str) -> Path:
    """Path of the weights of a model. Raises `PblError` ASSET_MISSING."""
    path = DATA / f"{model}.npz" if not model.endswith(".npz") else Path(model)
    if not path.is_file():
        raise PblError(
            "ASSET_MISSING",
            found=f"no weights {path.name} of the event model",
            expected="the weights that ship with the package",
            next_step="install the package again, or train them: docs/events.md",
        )
    return path


def check_model(model: str, sha256: str) -> None:
    """Raise `PblError` ASSET_MISSING unless the weights are those that the method names."""
    if sha256 and model_sha256(model) != sha256:
        raise PblError(
            "ASSET_MISSING",
            found=f"weights of the event model with SHA-256 {model_sha256(model)}",
            expected=f"SHA-256 {sha256}, as the method says",
            next_step="use the version of pbl-pipeline that the method came with, or a newer method",
        )


@functools.cache
def model_sha256(model: str) -> str:
    """SHA-256 of the weights' file."""
    return sha256_of(model_path(model))


@functools.cache
def _compiled() -> Any:
    import equinox as eqx
    import jax

    return eqx.filter_jit(lambda network, x, seen: jax.vmap(network)(x, seen))


def _averaged(time_s: np.ndarray, values: np.ndarray, window_s: float) -> np.ndarray:
    """Mean over `window_s` around each sample."""
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    low = np.searchsorted(time_s, time_s - window_s / 2 - 1e-9)
    high = np.searchsorted(time_s, time_s + window_s / 2 + 1e-9, side="right")
    return (total[high] - total[low]) / (high - low)[:, None]
