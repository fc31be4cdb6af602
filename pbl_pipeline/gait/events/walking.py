"""Stretches of walking in a trial: without standing, turning on the spot, or gaps in view."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from pbl_pipeline.paramset import later
from pbl_pipeline.runs import runs

from ._preconditions import seated
from .network.features import GRID_HZ
from .network.predict import Grid, Phases

#: Shortest and longest stride of a walk (s): 120 and 30 strides a minute at most and least.
_STRIDE_S = (0.6, 3.0)


@dataclasses.dataclass(frozen=True)
class WalkingParams:
    """Parameters of the stretches of walking.

    probability
        Least probability of walking, averaged over `average_s`.
    shortest_s, pause_s
        Shorter stretches do not count; shorter pauses do not end one.
    max_gap_s
        Longer gaps in view end a stretch.
    max_turn_deg_per_stride
        A heading that changes by more within a stride is turning, not walking on: it ends a stretch. 0: not used.
    max_turn_deg_per_s
        The same by time, used if `max_turn_deg_per_stride` is 0 (version 1): it keeps slow walkers' turns and loses
        fast walkers' bends.
    min_swing_leg
        The ankles pass each other by at least this much along the heading (leg lengths).
    """

    probability: float = 0.5
    average_s: float = 0.3
    shortest_s: float = 0.8
    pause_s: float = 0.3
    max_gap_s: float = 0.3
    max_turn_deg_per_s: float = 50.0
    min_swing_leg: float = 0.15
    max_turn_deg_per_stride: float = later(0.0)


def walking_stretches(grid: Grid, phases: Phases, params: WalkingParams) -> list[tuple[int, int]]:
    """First and last frame of the grid of each stretch of walking: none while the person is seated."""
    frames = max(1, round(params.average_s * GRID_HZ))
    count = uniform_filter1d(phases.seen.astype(float), frames, mode="constant")
    mean = uniform_filter1d(phases.walking * phases.seen, frames, mode="constant") / np.maximum(count, 1e-9)
    walks = phases.seen & (mean >= params.probability)
    walks = _without_short(walks, False, round(params.pause_s * GRID_HZ))
    unseen = _without_short(~phases.seen, True, round(params.max_gap_s * GRID_HZ))
    walks = (walks | ~phases.seen) & ~unseen
    walks &= ~turns(grid, phases, params)
    walks &= ~_without_short(seated(grid), True, round(params.pause_s * GRID_HZ))
    walks = _without_short(walks, True, round(params.shortest_s * GRID_HZ))
    swing = swing_leg(grid)
    return [(run.start, run.stop - 1) for run in runs(walks) if reach_leg(swing[run]) >= params.min_swing_leg]


def turns(grid: Grid, phases: Phases, params: WalkingParams) -> Bool[np.ndarray, " N"]:
    """True if the person turns instead of walking on, of each frame."""
    if params.max_turn_deg_per_stride:
        return np.abs(turn_deg_per_stride(grid, phases)) > params.max_turn_deg_per_stride
    return np.abs(turning_deg_per_s(grid)) > params.max_turn_deg_per_s


def turn_deg_per_stride(grid: Grid, phases: Phases) -> Float[np.ndarray, " N"]:
    """Change of the heading to the left (deg) over the stride about each frame.

    A stride lasts a turn of the phases at their mean rate within half a second, between `_STRIDE_S`; its middle value
    where no phase is seen. Where it reaches beyond the recording, the part inside is extrapolated.
    """
    turned = np.sum(phases.z[1:] * np.conj(phases.z[:-1]), axis=1)
    turned = np.append(turned, turned[-1:]) if len(turned) else np.zeros(len(grid.time_s), complex)
    frames = round(GRID_HZ)
    mean = uniform_filter1d(np.real(turned), frames) + 1j * uniform_filter1d(np.imag(turned), frames)
    shortest, longest = _STRIDE_S
    rate = np.where(np.abs(mean) > 1e-6, np.angle(mean) * GRID_HZ / (2 * np.pi), 2 / (shortest + longest))
    half = 0.5 * np.clip(1 / np.maximum(rate, 1e-6), shortest, longest)
    heading = np.cumsum(turning_deg_per_s(grid)) / GRID_HZ
    time = grid.time_s
    first, last = np.maximum(time - half, time[0]), np.minimum(time + half, time[-1])
    change = np.interp(last, time, heading) - np.interp(first, time, heading)
    return change * 2 * half / np.maximum(last - first, 1 / GRID_HZ)


def turning_deg_per_s(grid: Grid) -> Float[np.ndarray, " N"]:
    """Rate at which the heading turns to the left."""
    side = np.cross(grid.up, grid.ahead[:-1])
    change = np.arctan2(np.sum(side * grid.ahead[1:], axis=1), np.sum(grid.ahead[:-1] * grid.ahead[1:], axis=1))
    rate = np.degrees(np.append(change, change[-1:])) * GRID_HZ if len(change) else np.zeros(len(grid.time_s))
    return uniform_filter1d(rate, 15, mode="nearest")


def swing_leg(grid: Grid) -> Float[np.ndarray, " N"]:
    """Distance of the left foot ahead of the right one (leg lengths): ankles, else heels, else toes; NaN if unseen."""
    out = np.full(len(grid.time_s), np.nan)
    for joint in (4, 3, 2):
        both = grid.known[:, joint].all(axis=1)
        apart = grid.joints_m[:, joint, 0] - grid.joints_m[:, joint, 1]
        out[both] = np.sum(apart * grid.ahead, axis=1)[both] / grid.leg_m
    return out


def reach_leg(swing: np.ndarray) -> float:
    """Distance by which the feet pass each other, to both sides together (leg lengths), from `swing_leg`: between its
    5th and 95th percentile, so that an outlier does not count."""
    seen = swing[np.isfinite(swing)]
    return float(np.diff(np.percentile(seen, [5, 95]))[0]) if len(seen) > 1 else 0.0


def _without_short(flags: np.ndarray, value: bool, frames: int) -> np.ndarray:
    """Invert runs of `value` shorter than `frames`; False runs at the ends of the trial stay."""
    out = flags.copy()
    for run in runs(flags == value):
        inside = value or (run.start > 0 and run.stop < len(flags))
        if run.stop - run.start < frames and inside:
            out[run] = not value
    return out
