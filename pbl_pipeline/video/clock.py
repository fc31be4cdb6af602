"""The clock of a phone's log against its video's.

A log that counts in UTC meets the time of recording in the video's file, which is rounded to seconds, and which some
phones write for the beginning and others for the end. That is too coarse for a hand that shakes at 3 Hz, and the fit
looks for half a second only. So the pictures decide where they can: a camera that turns moves the whole picture, and
the movement of the picture must be that of the log at one shift of the clocks only.
"""

from __future__ import annotations

import dataclasses
import datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pbl_pipeline.errors import PblError

from .frame_motion import picture_motion
from .phone_log import UTC_CLOCK, VIDEO_CLOCK, PhoneLog
from .types import VideoInfo

#: How far the stated time of recording may be off (s): rounded to seconds, and a recording takes time to start.
STATED_WITHIN_S = 2.0
#: Fraction of the video that a log must cover at a shift.
LEAST_COVER = 0.9
#: The pictures decide where their movement correlates with the log's by so much, and by so much better than at any
#: shift farther off than `_PEAK_S`.
LEAST_CORRELATION, LEAST_LEAD, _PEAK_S = 0.5, 0.15, 0.3
#: Against the time of recording in the file the pictures must speak more clearly. Of 80 logs of other hands, a minute
#: each against 3 and 6 s of rendered film, the best place correlates by 0.64 at most and leads by 0.12 at most; the
#: right log by 0.97 and by 0.26.
CERTAIN_CORRELATION = 0.75
#: Steps (s) of the search, coarse and fine, and of the log's rate of turn.
_COARSE_S, _FINE_S, _STEP_S = 0.02, 0.002, 0.005
#: A phone that turns by less than this (deg, standard deviation) is on a stand: the shift does not matter.
_STILL_DEG = 0.3
_ZONE_S, _LARGEST_ZONES = 900.0, 56


@dataclasses.dataclass(frozen=True)
class Match:
    """Best shift (s) to add to the log's times, its correlation, and the best one of other places."""

    shift_s: float
    correlation: float
    rival: float

    @property
    def decides(self) -> bool:
        return self.correlation >= LEAST_CORRELATION and self.correlation - self.rival >= LEAST_LEAD


def align_clock(log: PhoneLog, quat_wxyz: np.ndarray, video: VideoInfo, path: Path) -> tuple[float, str]:
    """Seconds to add to the log's times so that 0 is the first frame of `video`, and in words how they were found.

    quat_wxyz (P, 4): the log's orientation, camera to world.

    Raises `PblError` PHONE_LOG: the log and the video are of other times (a time zone is named where it explains that),
    or nothing tells which part of the log is the video's.
    """
    duration = _duration(video)
    if log.clock == VIDEO_CLOCK:
        if _cover(log, 0.0, duration, 0.0) == 0.0:
            raise _not_from_zero(log, duration, path)
        return 0.0, "on the video's clock"
    stated = _stated(log, video, duration)
    if stated:
        shifts = [s for s in stated if _cover(log, s, duration, STATED_WITHIN_S) >= LEAST_COVER]
        if not shifts:
            return _against_the_file(log, quat_wxyz, video, stated[0], duration, path)
        ranges = [(s - STATED_WITHIN_S, s + STATED_WITHIN_S) for s in shifts]
    else:
        ranges = [_anywhere(log, duration, path)]
        shifts = [-float(log.time_s[0])]
    if _still(quat_wxyz):
        return shifts[0], "the phone stood still, so its clock does not matter"
    match = match_pictures(log.time_s, quat_wxyz, video, ranges)
    if match.decides:
        return match.shift_s, f"clock by the pictures' movement (correlation {match.correlation:.2f})"
    if stated and max(shifts) - min(shifts) <= STATED_WITHIN_S:
        return shifts[0], "clock by the time of recording in the file, within 1 s: the pictures do not tell it better"
    raise PblError(
        "PHONE_LOG",
        found="a log of which nothing tells what part belongs to the video (the movement of the pictures correlates by "
        f"{match.correlation:.2f} at best, {match.rival:.2f} elsewhere)",
        expected="one place at which the log moves as the pictures do, or a log that begins with the video",
        next_step="write time_s on the video's clock (docs/phone_capture.md), or leave the log out",
        key=str(path),
    )


def _against_the_file(
    log: PhoneLog, quat_wxyz: np.ndarray, video: VideoInfo, shift: float, duration: float, path: Path
) -> tuple[float, str]:
    """By the file's time of recording the log is of another time (`shift`), which the pictures may disprove: files lose
    that time when they are converted, and clocks are set to other zones."""
    if not _still(quat_wxyz) and _cover(log, -float(log.time_s[0]), duration, 0.0) >= LEAST_COVER:
        match = match_pictures(log.time_s, quat_wxyz, video, [_anywhere(log, duration, path)])
        if match.decides and match.correlation >= CERTAIN_CORRELATION:
            off = abs(match.shift_s - shift)
            apart = f"{off / 3600:.1f} h" if off < 86400 else f"{off / 86400:.1f} days"
            how = f"clock by the pictures' movement (correlation {match.correlation:.2f})"
            return match.shift_s, f"{how}, {apart} from the time of recording in the file"
    raise _other_time(log, video, shift, duration, path)


def _anywhere(log: PhoneLog, duration: float, path: Path) -> tuple[float, float]:
    """The shifts at which some part of the log covers the video. Raises `PblError` PHONE_LOG where it is too short."""
    last = float(log.time_s[-1]) - duration * LEAST_COVER
    if last < log.time_s[0]:
        raise _too_short(log, duration, path)
    return -last, -float(log.time_s[0]) + (1 - LEAST_COVER) * duration


def match_pictures(
    time_s: np.ndarray, quat_wxyz: np.ndarray, video: VideoInfo, ranges: list[tuple[float, float]]
) -> Match:
    """The shift in these ranges at which the log (P,), (P, 4) turns as the pictures move."""
    at, moved = picture_motion(video.path)
    grid = np.arange(time_s[0], time_s[-1], _STEP_S)
    turns = Slerp(time_s, Rotation.from_quat(quat_wxyz, scalar_first=True))(grid)
    # In the camera's axes; a turn to the right (about y) moves the picture to the left, one upwards (about x) down.
    w = (turns[:-1].inv() * turns[1:]).as_rotvec()
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([-w[:, 1], w[:, 0]], axis=1), axis=0)])

    def correlation(shift: float) -> float:
        t = at - shift
        inside = (t[:-1] >= grid[0]) & (t[1:] <= grid[-1])
        if inside.sum() < max(10, 0.5 * len(inside)):
            return -1.0
        place = np.stack([np.interp(t, grid, path[:, k]) for k in (0, 1)], axis=1)
        a, b = np.diff(place, axis=0)[inside], moved[inside]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        size = np.sqrt(np.sum(a**2) * np.sum(b**2))
        return float(np.sum(a * b) / size) if size > 0 else -1.0

    shifts = np.unique(np.concatenate([np.arange(low, high + _COARSE_S, _COARSE_S) for low, high in ranges]))
    values = np.array([correlation(s) for s in shifts])
    best = shifts[np.argmax(values)]
    elsewhere = values[np.abs(shifts - best) > _PEAK_S]
    fine = best + np.arange(-_COARSE_S, _COARSE_S + _FINE_S, _FINE_S)
    fine_values = np.array([correlation(s) for s in fine])
    return Match(float(fine[np.argmax(fine_values)]), float(fine_values.max()), float(elsewhere.max(initial=-1.0)))


def _stated(log: PhoneLog, video: VideoInfo, duration: float) -> list[float]:
    """Shifts by which the video's time of recording is its beginning, or its end; none where either is not known."""
    if log.clock != UTC_CLOCK or log.start_utc_s is None or video.recorded_utc is None:
        return []
    recorded = datetime.datetime.fromisoformat(video.recorded_utc).timestamp() + 0.5  # seconds are cut off
    begin = log.start_utc_s - recorded
    return [begin, begin + duration]


def _cover(log: PhoneLog, shift: float, duration: float, slack: float) -> float:
    """Fraction of the video that the log covers, `slack` seconds allowed at either end."""
    first, last = log.time_s[0] + shift - slack, log.time_s[-1] + shift + slack
    return float(np.clip(min(last, duration) - max(first, 0.0), 0, None) / duration)


def _duration(video: VideoInfo) -> float:
    return float(max(video.time_s[-1] - video.time_s[0], 1e-3)) if len(video.time_s) else 1e-3


def _still(quat_wxyz: np.ndarray) -> bool:
    turns = Rotation.from_quat(quat_wxyz, scalar_first=True)
    off = (turns.mean().inv() * turns).magnitude()
    return bool(np.degrees(np.sqrt(np.mean(off**2))) < _STILL_DEG)


def _other_time(log: PhoneLog, video: VideoInfo, shift: float, duration: float, path: Path) -> PblError:
    spans = sorted(range(-_LARGEST_ZONES, _LARGEST_ZONES + 1), key=abs)
    hours = next(
        (k * _ZONE_S / 3600 for k in spans if k and _cover(log, shift + k * _ZONE_S, duration, STATED_WITHIN_S) >= 0.9),
        None,
    )
    begin = datetime.datetime.fromtimestamp((log.start_utc_s or 0.0) + log.time_s[0], datetime.UTC)
    end = datetime.datetime.fromtimestamp((log.start_utc_s or 0.0) + log.time_s[-1], datetime.UTC)
    zone = (
        f"the clocks are {abs(hours):g} h apart: one of them counts in another time zone; write UTC into the log"
        if hours is not None
        else "take the log of this recording"
    )
    return PblError(
        "PHONE_LOG",
        found=f"a log from {begin:%Y-%m-%d %H:%M:%S} to {end:%H:%M:%S} UTC",
        expected=f"the time of the video, {duration:.1f} s around {video.recorded_utc}",
        next_step=f"{zone}, or time_s on the video's clock (docs/phone_capture.md)",
        key=str(path),
    )


def _not_from_zero(log: PhoneLog, duration: float, path: Path) -> PblError:
    return PblError(
        "PHONE_LOG",
        found=f"a log from {log.time_s[0]:.6g} to {log.time_s[-1]:.6g} s, without start_utc",
        expected=f"seconds from the first frame of the video, which lasts {duration:.1f} s",
        next_step="subtract the time at which the recording began, and write seconds; or add start_utc "
        "(docs/phone_capture.md)",
        key=str(path),
    )


def _too_short(log: PhoneLog, duration: float, path: Path) -> PblError:
    return PblError(
        "PHONE_LOG",
        found=f"a log of {log.time_s[-1] - log.time_s[0]:.1f} s",
        expected=f"at least {LEAST_COVER:.0%} of the video's {duration:.1f} s",
        next_step="take the log of this recording, or leave it out",
        key=str(path),
    )
