"""Where somebody walks: stretches of a trial without standing, turning on the spot, or gaps in view."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from pbl_pipeline.runs import runs

from ._preconditions import seated
from .network.features import GRID_HZ
from .network.predict import Grid, Phases


@dataclasses.dataclass(frozen=True)
class WalkingParams:
    """When a stretch counts as walking.

    probability
        Least probability of walking, averaged over `average_s`.
    shortest_s, pause_s
        Shorter stretches do not count; shorter pauses do not end one.
    max_gap_s
        Longer gaps in view end a stretch.
    max_turn_deg_per_s
        Faster changes of the heading are turning, not walking on: they end a stretch.
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


def walking_stretches(grid: Grid, phases: Phases, params: WalkingParams) -> list[tuple[int, int]]:
    """First and last frame of the grid of each stretch of walking: none while somebody sits."""
    frames = max(1, round(params.average_s * GRID_HZ))
    count = uniform_filter1d(phases.seen.astype(float), frames, mode="constant")
    mean = uniform_filter1d(phases.walking * phases.seen, frames, mode="constant") / np.maximum(count, 1e-9)
    walks = phases.seen & (mean >= params.probability)
    walks = _without_short(walks, False, round(params.pause_s * GRID_HZ))
    unseen = _without_short(~phases.seen, True, round(params.max_gap_s * GRID_HZ))
    walks = (walks | ~phases.seen) & ~unseen
    walks &= ~(np.abs(turning_deg_per_s(grid)) > params.max_turn_deg_per_s)
    walks &= ~_without_short(seated(grid), True, round(params.pause_s * GRID_HZ))
    walks = _without_short(walks, True, round(params.shortest_s * GRID_HZ))
    swing = swing_leg(grid)
    return [(run.start, run.stop - 1) for run in runs(walks) if reach_leg(swing[run]) >= params.min_swing_leg]


def turning_deg_per_s(grid: Grid) -> Float[np.ndarray, " N"]:
    """How fast the heading turns to the left."""
    side = np.cross(grid.up, grid.ahead[:-1])
    change = np.arctan2(np.sum(side * grid.ahead[1:], axis=1), np.sum(grid.ahead[:-1] * grid.ahead[1:], axis=1))
    rate = np.degrees(np.append(change, change[-1:])) * GRID_HZ if len(change) else np.zeros(len(grid.time_s))
    return uniform_filter1d(rate, 15, mode="nearest")


def swing_leg(grid: Grid) -> Float[np.ndarray, " N"]:
    """How far the left foot is ahead of the right one (leg lengths): ankles, else heels, else toes; NaN if not seen."""
    out = np.full(len(grid.time_s), np.nan)
    for joint in (4, 3, 2):
        both = grid.known[:, joint].all(axis=1)
        apart = grid.joints_m[:, joint, 0] - grid.joints_m[:, joint, 1]
        out[both] = np.sum(apart * grid.ahead, axis=1)[both] / grid.leg_m
    return out


def reach_leg(swing: np.ndarray) -> float:
    """How far the feet pass each other, to both sides together (leg lengths), from `swing_leg`: between its 5th and
    95th percentile, so that a point far off does not count."""
    seen = swing[np.isfinite(swing)]
    return float(np.diff(np.percentile(seen, [5, 95]))[0]) if len(seen) > 1 else 0.0


def _without_short(flags: np.ndarray, value: bool, frames: int) -> np.ndarray:
    """Runs of `value` shorter than `frames` are turned over; at the ends of the trial, too."""
    out = flags.copy()
    for run in runs(flags == value):
        inside = value or (run.start > 0 and run.stop < len(flags))
        if run.stop - run.start < frames and inside:
            out[run] = not value
    return out
