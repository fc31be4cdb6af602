"""Where a fit with sensors starts: their clock and how they sit on the body, from a fit of the video alone.

The clock is where the angular speeds of all sensors agree best with those of their segments. The rotation of a sensor
on its segment takes angular velocity and the vertical from the sensor's axes to the segment's (Wahba, SIAM Review 7,
1965). The pelvis hardly turns about a level axis; there the accelerations of walking tell how the sensor faces.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from .orientation import SAMPLE_S, Orientation, rate_of

#: What is stated of the log's time (s) at a video's time 0: it, its earliest and latest value, or nothing.
Stated = float | tuple[float, float] | None
#: Segment -> body of the model. A foot's sensor sits on the shoe, over the midfoot.
BODY_OF = {
    "pelvis": "pelvis",
    **{
        f"{ours}_{side}": f"{body}_{side}"
        for ours, body in (("thigh", "femur"), ("shank", "tibia"), ("foot", "calcn"))
        for side in "rl"
    },
}
#: Low pass of rates and accelerations (s, standard deviation of a Gaussian): a video's are noise above 5 Hz.
SMOOTH_S, SMOOTH_SLOW_S = 0.03, 0.06
#: Beside the ends of a recording, second differences of smoothed places are wrong (s).
EDGE_S = 0.2
#: Search around a stated clock (s), and finer steps around the best.
RANGE_S, FINE_S = 0.5, 0.15
#: Correlations (of angular speeds) closer than this at times further apart than this (s) do not tell which is right.
AMBIGUOUS, APART_S = 0.05, 0.3
#: Share of a video that the log must cover; of the turning (rad/s, mean of an axis) of a person who moves, which the
#: sensors must show: those that lie still are of another time. The correlation does not tell: that of another walk can
#: be 0.9, with sensors exchanged 0.2, which `better_pairing` names.
COVERED, MOVES, TURNING = 0.5, 0.5, 0.3
#: Errors of a video's angular velocity (rad/s) and of its verticals (rad), which weigh them against each other.
RATE_SD, UP_SD, HEADING_SD = 0.8, np.deg2rad(6.0), np.deg2rad(15.0)


@dataclasses.dataclass(frozen=True)
class Moved:
    """A recording as its video shows it, at even times (s of the video, every `SAMPLE_S`): rotations of segments, to
    the world, and of each the position of its origin (m)."""

    time: Float[np.ndarray, " T"]
    rotation: dict[str, Float[np.ndarray, "T 3 3"]]
    rate: dict[str, Float[np.ndarray, "T 3"]]  # rad/s, in the segment's axes, smoothed
    acceleration: dict[str, Float[np.ndarray, "T 3"]]  # m/s2, of the origin, in the world, smoothed


def moved(
    time: Float[np.ndarray, " F"],
    rotation: dict[str, Float[np.ndarray, "F 3 3"]],
    position: dict[str, Float[np.ndarray, "F 3"]],
) -> Moved:
    """Resample the segments of a recording to even times."""
    even = np.arange(time[0], time[-1], SAMPLE_S)
    turned = {k: Slerp(time, Rotation.from_matrix(R))(even) for k, R in rotation.items()}
    rates = {k: smooth(rate_of(r.as_quat(scalar_first=True))) for k, r in turned.items()}
    places = {k: np.stack([np.interp(even, time, v) for v in x.T], axis=1) for k, x in position.items()}
    second = {
        k: np.gradient(np.gradient(smooth(x, SMOOTH_SLOW_S), SAMPLE_S, axis=0), SAMPLE_S, axis=0)
        for k, x in places.items()
    }
    return Moved(even, {k: r.as_matrix() for k, r in turned.items()}, rates, second)


def smooth(x: np.ndarray, sd_s: float = SMOOTH_S) -> np.ndarray:
    """Low pass of values at every `SAMPLE_S`."""
    return gaussian_filter1d(x, sd_s / SAMPLE_S, axis=0, mode="nearest")


def clock_of(seen: Moved, sensors: Sequence[Orientation], stated: Stated) -> tuple[float, float]:
    """Time of the log at the video's time 0 (s), and how well the angular speeds agree there (their weighted
    correlation, -1 to 1).

    stated: that time, to `RANGE_S`; the earliest and latest one by wall clocks, which a place elsewhere overrules whose
    correlation is higher by `AMBIGUOUS`; or None.

    Raises `ValueError` if the log does not cover `COVERED` of the recording, fits it nowhere, or, where no time is
    stated to `RANGE_S`, as well at another stride.
    """
    n = len(seen.time)
    first, last = max(s.span[0] for s in sensors), min(s.span[1] for s in sensors)
    beyond = (1 - COVERED) * n * SAMPLE_S
    low, high = first - seen.time[0] - beyond, last - seen.time[-1] + beyond
    if isinstance(stated, float):
        low, high = max(low, stated - RANGE_S), min(high, stated + RANGE_S)
    if not low < high:
        raise ValueError("the log does not reach the recording")
    log_time = seen.time[0] + low + SAMPLE_S * np.arange(n + int((high - low) / SAMPLE_S))
    rates = {s.log.segment: _known_rate(s, log_time) for s in sensors}
    score, weight = np.zeros((2, len(log_time) - n + 1))
    for segment, rate in rates.items():
        ours = np.linalg.norm(seen.rate[segment], axis=1)
        agreement, share = _correlation(np.linalg.norm(rate, axis=1), ours)
        score += ours.var() * share * agreement
        weight += ours.var() * share
    score = np.clip(score / np.maximum(weight, 1e-9), 0.0, 0.9999)
    share = weight / sum(np.linalg.norm(seen.rate[k], axis=1).var() for k in rates)
    score = np.sqrt(1 - (1 - score**2) ** share)  # the correlation over all of it that tells as much
    best = int(np.argmax(score))
    if isinstance(stated, tuple):
        at = low + SAMPLE_S * np.arange(len(score))
        by_clocks = np.where((stated[0] <= at) & (at <= stated[1]), score, -1.0)
        if by_clocks.max() >= score[best] - AMBIGUOUS:
            best, score = int(np.argmax(by_clocks)), by_clocks
    away = np.abs(np.arange(len(score)) - best) * SAMPLE_S > APART_S
    if not isinstance(stated, float) and np.max(score, where=away, initial=-1.0) > score[best] - AMBIGUOUS:
        raise ValueError("the log fits the recording at several times")
    ours = float(np.mean([np.abs(seen.rate[k]) for k in rates]))
    if ours > MOVES and np.nanmean([np.abs(r[best : best + n]) for r in rates.values()]) < TURNING * ours:
        raise ValueError("the log fits the recording nowhere")
    lags = np.arange(max(0, best - int(FINE_S / SAMPLE_S)), min(len(score), best + int(FINE_S / SAMPLE_S) + 1))
    agreement = [sum(_turned_sum(seen.rate[k], r[i : i + n]) for k, r in rates.items()) for i in lags]
    at = int(np.argmax(agreement))
    if 0 < at < len(lags) - 1:  # the top of the parabola through three
        a, b, c = agreement[at - 1 : at + 2]
        shift = 0.5 * (a - c) / (a - 2 * b + c)
    else:
        shift = 0.0
    return float(low + SAMPLE_S * (lags[at] + shift)), float(score[best])


def _known_rate(sensor: Orientation, time: np.ndarray) -> np.ndarray:
    """Rates (T, 3) in all runs of a log, NaN elsewhere."""
    rate = np.full((len(time), 3), np.nan)
    for run in sensor.runs:
        quat, known = Orientation(sensor.log, (run,)).at(time)
        rate[known] = smooth(rate_of(quat))[known]
    return rate


def _correlation(long: np.ndarray, short: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of a signal with each part of a longer one, where that is known, and the share that is."""
    known, long, short = np.isfinite(long), np.nan_to_num(long), short - short.mean()
    from scipy.signal import fftconvolve  # takes longer to import than most commands run

    slide = lambda a, b: fftconvolve(a, b[::-1], "valid")  # noqa: E731
    ones = np.ones(len(short))
    n = np.maximum(slide(known, ones), 1.0)
    (x, xx), (y, yy) = ([slide(a, ones) / n for a in (long, long**2)], [slide(known, b) / n for b in (short, short**2)])
    spread = np.sqrt(np.maximum(xx - x**2, 1e-3) * np.maximum(yy - y**2, 1e-3 * short.var()))
    return (slide(long, short) / n - x * y) / spread, n / len(short)


def _turned_sum(a: np.ndarray, b: np.ndarray) -> float:
    """Largest sum of products of vectors (T, 3) with others, where those are known, under one rotation, of rates whose
    spread is the same."""
    power, known = np.sum(a**2), np.isfinite(b).all(axis=1)
    a, b = a[known], b[known]
    values, sign = np.linalg.svd(a.T @ b)[1], np.sign(np.linalg.det(a.T @ b))
    return float((values[0] + values[1] + sign * values[2]) * power / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-9))


def wahba(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The rotation (3, 3) that takes the second vectors of pairs (T, 3) best to the first ones."""
    U, _, Vt = np.linalg.svd(sum((a.T @ b for a, b in pairs), np.zeros((3, 3))))
    return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt


def vectors(seen: Moved, clock: float, sensor: Orientation, segment: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of vectors (T, 3) over their errors, in the axes of the segment and of the sensor: rates and verticals."""
    quat, known = sensor.at(seen.time + clock)
    pairs = [(seen.rate[segment][known], smooth(rate_of(quat))[known], RATE_SD)]
    pairs.append((*verticals(seen, clock, sensor, segment), UP_SD))
    heading = _heading(seen, sensor, seen.time + clock, known) if segment == "pelvis" else np.nan
    if np.isfinite(heading):
        turned = Rotation.from_rotvec([0.0, 0.0, heading]) * Rotation.from_quat(quat, scalar_first=True)
        pairs.append((seen.rotation[segment][known, 0], turned.as_matrix()[known, 0], HEADING_SD))
    return [(a / sd, b / sd) for a, b, sd in pairs]


def verticals(seen: Moved, clock: float, sensor: Orientation, segment: str) -> tuple[np.ndarray, np.ndarray]:
    """The vertical (T, 3) in the axes of the segment and of the sensor, where that was measured."""
    quat, known = sensor.at(seen.time + clock)
    return seen.rotation[segment][known, 2], Rotation.from_quat(quat, scalar_first=True).as_matrix()[known, 2]


def _heading(seen: Moved, sensor: Orientation, time: np.ndarray, known: np.ndarray) -> float:
    """Angle (rad) about the vertical from a sensor's world to the video's: that which makes the level accelerations
    most equal, each axis of the video's counted by its spread, which is the depth's noise in a view from the front.
    NaN without accelerations."""
    rows = () if sensor.log.acceleration is None else np.isfinite(sensor.log.acceleration).all(axis=1)
    if sensor.log.acceleration is None or not np.any(rows):
        return np.nan
    felt = [np.interp(time, sensor.log.time[rows], v) for v in sensor.log.acceleration[rows].T]
    felt = np.stack(felt, axis=1)
    felt = smooth(Rotation.from_quat(sensor.at(time)[0], scalar_first=True).apply(felt), SMOOTH_SLOW_S)
    inner = known.copy()
    inner[: int(EDGE_S / SAMPLE_S)] = inner[-int(EDGE_S / SAMPLE_S) :] = False
    ours, felt = (a[inner, :2] - a[inner, :2].mean(axis=0) for a in (seen.acceleration[sensor.log.segment], felt))
    angles = np.deg2rad(np.arange(360.0))
    turned = (felt @ [1, 1j]) * np.exp(1j * angles)[:, None]
    error = ours - np.stack([turned.real, turned.imag], axis=-1)
    costs = np.einsum("ati,ij,atj->a", error, np.linalg.inv(np.cov(ours.T)), error)
    return float(angles[np.argmin(costs)]) if np.isfinite(costs).all() else np.nan
