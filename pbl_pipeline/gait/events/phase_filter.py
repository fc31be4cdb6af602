"""Kalman filter and Rauch-Tung-Striebel smoother over phase, phase rate and three offsets (Cotton et al. 2022).

State: the phase of left initial contact (rad, unwrapped), its rate (rad/s), and the lead of the phases of right
toe-off, right initial contact and left toe-off over it (rad). Measured are the four phases, each modulo a turn: the
innovation is wrapped, so that the filter stays linear.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

_TURN = 2 * np.pi


@dataclasses.dataclass(frozen=True)
class FilterParams:
    """Noise parameters of the filter.

    rate_noise
        Random walk of the rate (rad/s per sqrt(s)).
    offset_noise
        Random walk of the offsets (rad per sqrt(s)).
    phase_noise
        Random walk of the phase against its rate (rad per sqrt(s)).
    memory_frames
        Errors of the model's phases are correlated over so many frames: their variance is multiplied by it.
    least_sd_rad
        Least standard deviation of a measured phase.
    """

    rate_noise: float = 1.5
    offset_noise: float = 0.3
    phase_noise: float = 0.1
    memory_frames: float = 6.0
    least_sd_rad: float = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class SmoothPhases:
    """`phase_rad` (T, 4): unwrapped phases in the order left down, right up, right down, left up; `sd_rad` (T, 4);
    `rate` (T,) rad/s."""

    phase_rad: Float[np.ndarray, "T 4"]
    sd_rad: Float[np.ndarray, "T 4"]
    rate: Float[np.ndarray, " T"]


def smooth_phases(z: np.ndarray, step_s: float, params: FilterParams, alike: bool = False) -> SmoothPhases:
    """Consistent phases from the model's complex numbers `z` (T, 4), cos + i sin; 0 or NaN is not measured.

    With `alike` each of the four phases wanders about their common one by `offset_noise`, so that no side is the first;
    else the phase of left initial contact is the common one.

    The length of a number is the model's certainty: if angles scatter with variance s^2, their mean has the length
    exp(-s^2 / 2).
    """
    z = np.where(np.isfinite(z), z, 0.0)
    length = np.clip(np.abs(z), 1e-3, 0.99999)
    variance = params.memory_frames * np.maximum(-2 * np.log(length), params.least_sd_rad**2)
    measured = np.angle(z)
    use = np.abs(z) > 0.05
    n = len(z)
    transition = np.eye(5)
    transition[0, 1] = step_s
    noise = np.diag(
        [
            params.phase_noise**2 * step_s,
            params.rate_noise**2 * step_s,
            *[params.offset_noise**2 * step_s] * 3,
        ]
    )
    x, p = _start(z, step_s), np.diag([1.0, 9.0, 0.5, 0.5, 0.5])
    if alike:  # the first phase also wanders: with it the lead of the others over it
        first = np.array([1.0, 0.0, -1.0, -1.0, -1.0])
        noise += params.offset_noise**2 * step_s * np.outer(first, first)
        p += 0.5 * np.outer(first, first)
    look = np.zeros((4, 5))
    look[:, 0] = 1.0
    look[1:, 2:] = np.eye(3)
    before_x, before_p, after_x, after_p = (np.empty((n, *s)) for s in ((5,), (5, 5), (5,), (5, 5)))
    for t in range(n):
        if t:
            x, p = transition @ x, transition @ p @ transition.T + noise
        before_x[t], before_p[t] = x, p
        rows = np.flatnonzero(use[t])
        if len(rows):
            h = look[rows]
            off = measured[t, rows] - h @ x
            off = (off + np.pi) % _TURN - np.pi
            s = h @ p @ h.T
            s[np.diag_indices(len(rows))] += variance[t, rows]
            gain = np.linalg.solve(s, h @ p).T
            x = x + gain @ off
            p = p - gain @ h @ p
            p = 0.5 * (p + p.T)
        after_x[t], after_p[t] = x, p
    smooth_x, smooth_p = after_x.copy(), after_p.copy()
    for t in range(n - 2, -1, -1):
        back = np.linalg.solve(before_p[t + 1], transition @ after_p[t]).T
        smooth_x[t] = after_x[t] + back @ (smooth_x[t + 1] - before_x[t + 1])
        smooth_p[t] = after_p[t] + back @ (smooth_p[t + 1] - before_p[t + 1]) @ back.T
    spread = np.einsum("ij,tjk,ik->ti", look, smooth_p, look)
    return SmoothPhases(smooth_x @ look.T, np.sqrt(np.maximum(spread, 0.0)), smooth_x[:, 1])


def _start(z: np.ndarray, step_s: float) -> np.ndarray:
    """State at the first frame: phase there, the middle rate of all frames, the middle offsets."""
    turn = np.angle(np.sum(z[1:] * np.conj(z[:-1]), axis=1)) / step_s
    rate = float(np.median(turn)) if len(turn) else _TURN
    offsets = [float(np.angle(np.sum(z[:, k] * np.conj(z[:, 0])))) for k in (1, 2, 3)]
    first = z[: max(1, round(0.2 / step_s))]
    at = np.arange(len(first)) * step_s
    turned = first * np.exp(-1j * (rate * at[:, None] + np.array([0.0, *offsets])))
    return np.array([float(np.angle(turned.sum())), rate, *offsets])


def crossings(phase_rad: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Times at which an unwrapped phase (T,) grows past a whole turn, between frames (linear)."""
    turns = phase_rad / _TURN
    k = np.floor(turns)
    i = np.flatnonzero(np.diff(k) > 0)
    fraction = (k[i + 1] - turns[i]) / (turns[i + 1] - turns[i])
    return time_s[i] + fraction * (time_s[i + 1] - time_s[i])
