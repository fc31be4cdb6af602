"""Comparison of what a sensor's file says with a body, gravity and the clock: no wrong unit becomes a number."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NoReturn, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import bounded
from pbl_pipeline.errors import as_said, said
from pbl_pipeline.sampling import interval_of

from .formats.samples import Samples, log_error
from .log import SensorLog

#: Rates of sampling (Hz), median length (m/s2) of an acceleration with gravity, and the angular speed (rad/s) that one
#: sample in a hundred exceeds: a foot reaches 15 in walking, 25 in a sprint.
_HZ, _GRAVITY, _FASTEST = (20.0, 2000.0), (7.5, 13.0), 40.0
#: Most stamps that repeat the one before, most samples at the end of a sensor's range, as shares.
_MOST_REPEATS, _MOST_CLIPPED = 0.1, 0.05
#: Where a sensor's range can end, from: 250 deg/s and 2 g, less what a calibration takes.
_CLIPS = {"rate": (4.1, "angular rate"), "acceleration": (18.0, "acceleration")}
#: Differences of two clocks (fraction) that are said, and that are refused.
_DRIFT, _OTHER_RATE = 1e-4, 0.01
#: Tilt (deg) of an orientation against the mean acceleration, and wander of its heading (deg) against the gyroscope.
_TILT_DEG, _WANDER_DEG = 25.0, 15.0
#: A comparison of two rates needs this much movement (rad/s) and so many samples.
_MOVES, _ENOUGH, _MOST_COMPARED = 0.3, 50, 50_000
#: Least share of quarters of a second in which accelerations keep the length of gravity; and the turn (deg) that wrong
#: rates then leave of it. Right ones left up to 1 on recorded logs, 7 on a synthetic one; turned or dead axes left 23.
_QUIET, _AGAINST_DEG = 0.2, 15.0
_DAY_S = 86400.0
#: Difference (s) of the wall clocks of a phone and of sensors, which networks set; the time of recording is cut to
#: seconds. The next walk of a visit is further away.
_WALL_CLOCKS_S = 10.0
#: Raises the error for what was found, what is expected and the next step.
Refuse = Callable[..., NoReturn]


class HasTimes(Protocol):
    """Has the times (T,) of its frames (s)."""

    @property
    def time_s(self) -> np.ndarray: ...


def checked(samples: Samples, segment: str, path: Path, begin: float = 0.0) -> SensorLog:
    """The log of a sensor on a segment; `begin`: the stamp that becomes time 0.

    Raises `PblError` SENSOR_LOG: stamps that go back, repeat, or are not of seconds; neither rate and acceleration nor
    orientation; accelerations in g or without gravity; rates in degrees; an orientation whose world is not upright or
    that does not belong to the rates; a sensor that reached the end of its range too often.
    """
    notes: list[str] = []

    def refuse(found: str, expected: str, next_step: str = "") -> NoReturn:
        on, more = as_said(segment), {"next_step": next_step} if next_step else {}
        about = said("sensor {name} on {segment}: {found}", name=samples.name, segment=on, found=as_said(found))
        raise log_error(about, expected, key=path, **more)

    kept = _kept(samples, notes, refuse)
    time = samples.stamp[kept]
    rate, acceleration, turns = (
        None if x is None else np.where(np.isfinite(x[kept]).all(axis=1, keepdims=True), x[kept], np.nan)
        for x in (samples.rate, samples.acceleration, samples.orientation)
    )
    if acceleration is not None:  # a sample that is missing may be zeros
        none = ~np.asarray(acceleration.any(axis=1))[:, None]
        rate, acceleration = (None if x is None else np.where(none, np.nan, x) for x in (rate, acceleration))
    if turns is None and (rate is None or acceleration is None):
        refuse(
            "no orientation, and not both an angular rate and an acceleration",
            "angular rate and acceleration, or orientation",
            "export it with the gyroscope, or with the orientation",
        )
    if turns is not None:
        turns = _unit(turns, refuse)
        if (share := float(np.isfinite(turns).all(axis=1).mean())) < 0.5:
            refuse(said("an orientation in {share:.0%} of the samples", share=share), "at least half of them")
        if share < 1:
            notes.append(f"{share:.0%} of the samples have an orientation")
    if acceleration is not None:
        _check_gravity(acceleration, refuse)
        if turns is not None:
            _check_upright(turns, acceleration, refuse)
    rate = _unclipped(rate, *_CLIPS["rate"], notes, refuse)
    acceleration = _unclipped(acceleration, *_CLIPS["acceleration"], notes, refuse)
    if rate is not None:
        _check_rate(time, rate, acceleration, turns, refuse)
        _note_heading(time, rate, turns, notes)
    elif turns is not None:
        notes.append("no angular rate: the orientation is that of the sensor's program, its heading may be a magnet's")
    start = None if samples.start_utc is None else float(samples.start_utc + begin)
    measured = time - begin, rate, acceleration, turns
    return SensorLog(samples.name, segment, *measured, start, tuple(notes), samples.mounting)


def _kept(samples: Samples, notes: list[str], refuse: Refuse) -> np.ndarray:
    """Rows (K,) whose stamps increase."""
    rows = np.flatnonzero(np.isfinite(samples.stamp))
    step = np.diff(samples.stamp[rows])
    back, same = int((step < 0).sum()), int((step == 0).sum())
    if back:
        refuse(said("{n} of {all} stamps go back", n=back, all=len(rows)), "times that increase")
    if same > _MOST_REPEATS * len(rows):
        repeated = said("{n} of {all} stamps repeat the one before", n=same, all=len(rows))
        refuse(repeated, "a different stamp for each sample")
    if same or len(rows) < len(samples.stamp):
        notes.append(f"{same} repeated rows and {len(samples.stamp) - len(rows)} without a time were left out")
    rows = rows[np.concatenate([[True], step > 0])] if len(rows) else rows
    time = samples.stamp[rows]
    hz = 1 / interval_of(time) if len(time) > 1 else 0.0
    if not _HZ[0] <= hz <= _HZ[1] or bounded.span_s(time) > bounded.MAX_SECONDS:
        most = f"at most {bounded.MAX_SECONDS:g} s"
        expected = f"times in s, {_HZ[0]:g} to {_HZ[1]:g} samples a second, {most}"
        refuse(said("{n} samples, {hz:.3g} a second", n=len(time), hz=hz), expected)
    if samples.counter is not None and samples.stated_hz and len(time) >= _ENOUGH:
        counter = samples.counter[rows]
        off = (time[-1] - time[0]) * samples.stated_hz / max(counter[-1] - counter[0], 1) - 1
        if abs(off) > _OTHER_RATE:
            found = said("{n:g} samples in {s:.4g} s", n=counter[-1] - counter[0], s=time[-1] - time[0])
            refuse(found, f"{samples.stated_hz:g} a second, as the file states")
        if abs(off) > _DRIFT:
            notes.append(f"the stamps run {1e6 * off:+.0f} ppm against the stated {samples.stated_hz:g} Hz")
    return rows


def _unit(turns: np.ndarray, refuse: Refuse) -> np.ndarray:
    length = np.linalg.norm(turns, axis=1, keepdims=True)
    off = np.abs(length - 1) > 0.02
    if off.sum() > 0.5 * np.isfinite(length).sum():
        refuse(said("quaternions of length {n:.3g}", n=np.nanmedian(length)), "unit quaternions")
    return np.where(off, np.nan, turns / np.where(off, 1.0, length))


def _check_gravity(acceleration: np.ndarray, refuse: Refuse) -> None:
    length = np.linalg.norm(acceleration, axis=1)
    least, typical = np.quantile(length[np.isfinite(length)], (0.1, 0.5)) if np.isfinite(length).any() else (0.0, 0.0)
    if _GRAVITY[0] <= typical <= _GRAVITY[1]:
        return
    units = (words for words, g in ((", as in g", 1.0), (", as in mg", 1000.0)) if 0.75 * g <= typical <= 1.3 * g)
    in_g = next(units, None) if least > 0.5 * typical else None  # without gravity it comes to nearly 0
    cause = in_g or (", as without gravity" if typical < _GRAVITY[0] else "")
    found = said("accelerations of typically {a:.3g}{cause}", a=typical, cause=said(cause))
    scale = "multiply by 9.80665 and divide by 1000 where it is mg"
    refuse(found, "m/s2 with gravity, 9.81 at rest", scale if in_g else "export the acceleration with gravity")


def _slope(of: np.ndarray, on: np.ndarray) -> float:
    """Factor from the second vectors (T, 3) to the first ones; NaN where there is too little movement."""
    known = np.isfinite(of).all(axis=1) & np.isfinite(on).all(axis=1)
    size = np.linalg.norm(on, axis=1)
    known &= size > _MOVES
    if known.sum() < _ENOUGH:
        return np.nan
    return float((of[known] * on[known]).sum() / (on[known] ** 2).sum())


def _turning(time: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Angular rate (T, 3) of an orientation, in the axes of the sensor, NaN where it is not known."""
    out = np.full((len(time), 3), np.nan)
    known = np.asarray(np.isfinite(turns).all(axis=1))
    quat = np.where(known[:, None], turns, [1.0, 0, 0, 0])
    before, after = (Rotation.from_quat(q, scalar_first=True) for q in (quat[:-1], quat[1:]))
    out[:-1] = (before.inv() * after).as_rotvec() / np.diff(time)[:, None]
    out[:-1][~(known[1:] & known[:-1])] = np.nan
    return out


def _check_rate(
    time: np.ndarray, rate: np.ndarray, acceleration: np.ndarray | None, turns: np.ndarray | None, refuse: Refuse
) -> None:
    fastest = float(np.nanquantile(np.linalg.norm(rate, axis=1), 0.99))
    factor = np.nan
    if turns is not None:
        factor = _slope(rate, _turning(time, turns))
    elif acceleration is not None:
        factor = _by_gravity(time, rate, acceleration, refuse)
    if fastest > _FASTEST or factor > 20:
        found = said("angular rates of up to {w:.3g}, as in deg/s", w=fastest)
        refuse(found, f"rad/s, in which a person reaches less than {_FASTEST:g}", "multiply by pi / 180")
    if 0 < factor < 0.05:
        found = said("angular rates of up to {w:.3g} rad/s, 1/57 of what its other values turn by", w=fastest)
        back = "set the unit of the program's export back to deg/s"
        refuse(found, "rates in the unit that the format states", back)
    if not (np.isnan(factor) or 0.8 <= factor <= 1.25):
        found = said("rates that are {f:.2f} times those of its orientation", f=factor)
        refuse(found, "an orientation from the sensor's axes to a world, which turns as the rates say")


def _by_gravity(time: np.ndarray, rate: np.ndarray, acceleration: np.ndarray, refuse: Refuse) -> float:
    """Factor (57.3 or its inverse) by which rates are too large, as gravity tells: where nothing else accelerates, it
    keeps its direction over a quarter of a second once the sensor's turns are taken out. NaN where it tells nothing.
    Refuses rates that contradict it."""
    n = min(len(time), _MOST_COMPARED)
    length = np.linalg.norm(acceleration[:n], axis=1)
    still = (np.abs(length - np.nanmedian(length)) < 0.1 * np.nanmedian(length)) & np.isfinite(rate[:n]).all(axis=1)
    later = max(int(0.25 / interval_of(time)), 1)
    both, quiet = still[:-later] & still[later:], np.convolve(still, np.ones(later + 1), "valid") > later + 0.5
    if both.sum() < _ENOUGH:
        return np.nan
    turn, up = np.nan_to_num(rate[:n]) * np.gradient(time[:n])[:, None], acceleration[:n] / length[:, None]
    off, against = {}, 0.0
    for factor in (57.3, 1.0, 1 / 57.3):
        q, done = Rotation.from_rotvec(turn / factor), 1
        while done < n:  # each becomes the product of all up to it
            q = Rotation.concatenate([q[:done], q[:-done] * q[done:]])
            done *= 2
        world = q.apply(np.nan_to_num(up))
        angle = np.arccos(np.clip(np.sum(world[:-later] * world[later:], axis=1), -1, 1))
        off[factor] = float(np.median(angle[both]))
        if factor == 1.0 and quiet.mean() > _QUIET:
            against = float(np.degrees(np.median(angle[quiet])))
    best = min(off, key=lambda factor: off[factor])
    if off[1.0] > np.radians(3) and off[best] < 0.4 * off[1.0]:
        return best
    if against > _AGAINST_DEG:
        found = said("angular rates that turn gravity by {off:.0f} deg in a quarter of a second", off=against)
        expected = "rates and accelerations of one sensor, in the same axes: gravity keeps its direction"
        refuse(found, expected, "check the axes and signs of the gyroscope, and that it was on")
    return np.nan


def _check_upright(turns: np.ndarray, acceleration: np.ndarray, refuse: Refuse) -> None:
    known = np.isfinite(turns).all(axis=1) & np.isfinite(acceleration).all(axis=1)
    if not known.any():
        return
    r = Rotation.from_quat(turns[known], scalar_first=True)
    mean, other = (x.apply(acceleration[known]).mean(axis=0) for x in (r, r.inv()))
    tilt, inverse = (np.degrees(np.arccos(np.clip(m[2] / np.linalg.norm(m), -1, 1))) for m in (mean, other))
    if tilt <= _TILT_DEG:
        return
    axis = "xyz"[np.argmax(np.abs(mean))]
    sign = "" if mean["xyz".index(axis)] > 0 else "-"
    refuse(
        said("an orientation in whose world the acceleration at rest points {tilt:.0f} deg off z", tilt=tilt),
        "from the sensor's axes to a world whose z points up; an acceleration that is +9.81 upwards at rest",
        "turn the quaternion around: it is from the world to the sensor"
        if inverse <= _TILT_DEG
        else said("in this file up is {axis}: turn the world, or the sign of the accelerations", axis=sign + axis),
    )


def _note_heading(time: np.ndarray, rate: np.ndarray, turns: np.ndarray | None, notes: list[str]) -> None:
    if turns is None:
        return
    off = rate - _turning(time, turns)
    known = np.isfinite(off).all(axis=1)
    if known.sum() < _ENOUGH:
        return
    world = Rotation.from_quat(turns[known], scalar_first=True).apply(off[known])[:, 2]
    angle = np.degrees(np.cumsum(world * np.gradient(time)[known]))
    angle -= np.polyval(np.polyfit(time[known], angle, 1), time[known])  # a bias of the gyroscope
    if (wander := float(np.ptp(angle))) > _WANDER_DEG:
        notes.append(
            f"the heading of the orientation wanders {wander:.0f} deg against the gyroscope, as a magnet's does"
        )


def _unclipped(
    values: np.ndarray | None, from_: float, what: str, notes: list[str], refuse: Refuse
) -> np.ndarray | None:
    """Values (T, 3) with NaN in the rows where an axis stays at the end of its range for three samples."""
    if values is None:
        return None
    clipped = np.zeros(len(values), bool)
    for x in values.T:
        for end in (np.nanmax(x), np.nanmin(x)):
            at = np.abs(x - end) <= 1e-4 * abs(end)
            if abs(end) >= from_ and len(at) >= 3:
                run = at[:-2] & at[1:-1] & at[2:]
                clipped |= np.convolve(run, [1, 1, 1]) > 0
    share = float(clipped.mean())
    if share > _MOST_CLIPPED:
        of = said(what)
        found = said("an {what} at the end of the sensor's range in {share:.0%} of the samples", what=of, share=share)
        refuse(found, f"at most {_MOST_CLIPPED:.0%}", "record with a larger range")
    if clipped.any():
        notes.append(f"{what}: {int(clipped.sum())} samples at the end of the sensor's range were left out")
    return np.where(clipped[:, None], np.nan, values)


def check_day(logs: Sequence[SensorLog], recorded: Mapping[str, str | None]) -> list[str]:
    """Compare logs that count in UTC with the days of videos; returns a note on each video of another day, whose clock
    is wrong where another video agrees. Raises `PblError` SENSOR_LOG where none does.

    recorded: time of recording of each video as its file states it (`VideoInfo.recorded_utc`), by its name.
    """
    in_utc = [(log.name, log.started_utc + log.time[[0, -1]]) for log in logs if log.started_utc is not None]
    days = {}
    for name, utc in recorded.items():
        if utc is not None and in_utc:
            moment = datetime.datetime.fromisoformat(utc).timestamp()
            days[name] = max((max(t[0] - moment, moment - t[1]) / _DAY_S, sensor) for sensor, t in in_utc)
    wrong = {name: off for name, off in days.items() if off[0] > 1}
    for name, (off, sensor) in wrong.items():
        if len(wrong) == len(days):
            found = said("sensor {sensor}: its log lies {days:.1f} days from the video", sensor=sensor, days=off)
            next_step = "name the log of this visit, or correct the clock of the recording"
            raise log_error(found, "the log of the same visit", next_step=next_step, key=name)
    return [
        said("{name} states a day {off:.1f} days from the log of the sensors", name=name, off=off)
        for name, (off, _) in wrong.items()
    ]


def places(
    logs: Sequence[SensorLog], recorded: Sequence[str | None], videos: Sequence[HasTimes]
) -> list[tuple[float, float] | None]:
    """Earliest and latest time of the logs (s) at time 0 of videos, by the wall clocks; None where a video or the logs
    state no time. recorded: as in `check_day`, the moment of the first or of the last frame."""
    starts = [log.started_utc for log in logs if log.started_utc is not None]
    out: list[tuple[float, float] | None] = []
    for utc, of_video in zip(recorded, videos, strict=True):
        moment = None if utc is None else datetime.datetime.fromisoformat(utc).timestamp()
        at = None if moment is None or not starts else moment - float(np.median(starts))
        out.append(None if at is None else (at - float(of_video.time_s[-1]) - _WALL_CLOCKS_S, at + _WALL_CLOCKS_S))
    return out
