"""Times of initial contact and toe-off: rhythms of walking from 40 to 185 steps a minute, even and uneven."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.gait.normative import GRAVITY, gait_norm

from ._sequence import GRID_HZ

#: Limits of the cadence (steps/min).
SLOWEST_PER_MIN, FASTEST_PER_MIN = 38.0, 185.0
#: The rate of the phase is smoothed over this time (s): legs do not change their pace at once.
_SMOOTH_S = 0.015


@dataclasses.dataclass(frozen=True)
class Rhythm:
    """A person's rhythm. `speed` (dimensionless) chooses the curves; `step_s` mean step time (s); `foot_off` fraction
    of the stride that each foot [left, right] stands; `delay` of the right foot against the left in strides; `jitter`
    standard deviation of each event in step times; `wander` of the pace over seconds."""

    speed: float
    step_s: float
    foot_off: tuple[float, float]
    delay: float
    jitter: float
    wander: float
    runs: bool = False


def draw_rhythm(rng: np.random.Generator) -> Rhythm:
    """A rhythm of any person: children and adults, healthy or not, with a walking aid or without."""
    norm = gait_norm()
    speed = float(rng.uniform(norm.speed[0], norm.speed[-1]))
    leg_m = float(rng.uniform(0.45, 1.02))
    step_s = float(np.sqrt(leg_m / GRAVITY) / norm.cadence_at(speed) * np.exp(rng.normal(0, 0.15)))
    if rng.random() < 0.2:  # any pace at any length of the step
        step_s = float(60 / np.exp(rng.uniform(np.log(SLOWEST_PER_MIN), np.log(FASTEST_PER_MIN))))
    step_s = float(np.clip(step_s, 60 / FASTEST_PER_MIN, 60 / SLOWEST_PER_MIN))
    stance = norm.foot_off_at(speed) + rng.normal(0, 0.02)
    if rng.random() < 0.15:  # long double support, up to half of the stride
        stance = rng.uniform(0.64, 0.75)
    uneven = rng.random() < 0.3  # one bad leg, or a stick
    apart = rng.normal(0, 0.035 if uneven else 0.008)
    delay = 0.5 + rng.normal(0, 0.045 if uneven else 0.010)
    foot_off = (stance + apart, stance - apart)
    room = 0.04  # least fraction of a stride between two events
    low, high = max(delay, 1 - delay) + room, min(0.76, 1 - room)
    foot_off = tuple(float(np.clip(f, low, high)) for f in foot_off)
    return Rhythm(
        speed=speed,
        step_s=step_s,
        foot_off=(foot_off[0], foot_off[1]),
        delay=float(delay),
        jitter=float(np.exp(rng.uniform(np.log(0.005), np.log(0.06)))),
        wander=float(abs(rng.normal(0, 0.05))),
    )


def draw_run(rng: np.random.Generator) -> Rhythm:
    """Running: each foot stands for less than half of the stride."""
    stance = float(rng.uniform(0.30, 0.46))
    return Rhythm(
        speed=0.7,
        step_s=float(60 / rng.uniform(130, 195)),
        foot_off=(stance, stance),
        delay=0.5 + float(rng.normal(0, 0.01)),
        jitter=0.015,
        wander=0.01,
        runs=True,
    )


def schedule(rng: np.random.Generator, rhythm: Rhythm, seconds: float) -> tuple[np.ndarray, ...]:
    """Times (s) of left down, right up, right down, left up from before 0 to after `seconds`, strictly in turn."""
    stride = 2 * rhythm.step_s
    n = int(np.ceil(seconds / stride / 0.6)) + 8
    pace = 1 + gaussian_filter1d(rng.standard_normal(n), 2.0) * 2.5 * rhythm.wander
    start = np.cumsum(stride * np.clip(pace, 0.6, 1.6))
    start = start - start[0] - (3 + rng.random()) * stride
    length = np.append(np.diff(start), stride)
    left, right = rhythm.foot_off
    shares = np.array([0.0, rhythm.delay + right - 1, rhythm.delay, left])
    table = start[:, None] + length[:, None] * shares
    table += np.clip(rng.standard_normal(table.shape), -2, 2) * rhythm.jitter * rhythm.step_s
    if rhythm.runs:  # the other foot leaves before this one comes down
        order = np.argsort(shares)
        back = np.argsort(order)
        return tuple(_in_turn(table[:, order], 0.03 * stride)[:, back].T)
    return tuple(_in_turn(table, 0.03 * stride).T)


def _in_turn(table: np.ndarray, least_s: float) -> np.ndarray:
    """Push events apart that the jitter has brought closer than `least_s`."""
    flat = table.ravel().copy()
    for i in range(1, len(flat)):
        flat[i] = max(flat[i], flat[i - 1] + least_s)
    return flat.reshape(table.shape)


def leg_phase(down_s: np.ndarray, up_s: np.ndarray, curve_foot_off: float, time_s: np.ndarray) -> np.ndarray:
    """Phase (T,) in turns of the curves of one leg: whole at initial contact, `curve_foot_off` later at toe-off."""
    knots = np.concatenate([down_s, up_s])
    first_up = int(np.searchsorted(down_s, up_s[0]))  # the initial contact after which the first toe-off comes
    turns = np.concatenate([np.arange(len(down_s)), np.arange(len(up_s)) + first_up - 1 + curve_foot_off])
    order = np.argsort(knots)
    phase = PchipInterpolator(knots[order], turns[order])(np.clip(time_s, knots.min(), knots.max()))
    return gaussian_filter1d(phase, _SMOOTH_S * GRID_HZ, mode="nearest")
