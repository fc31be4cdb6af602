"""Offset between the clocks of a phone's log and of its video, from the movement of the picture.

A log in UTC can be compared with the time of recording in the video's file, but that is rounded to seconds, and some
phones write the beginning, others the end. This is too coarse for a hand that shakes at 3 Hz, and the fit searches
half a second only. So the pictures decide if they can: a camera that turns moves the whole picture, and the movement of
the picture matches that of the log at only one shift of the clocks.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results.video_facts import VideoInfo

from .attitude import DEVICE, MAX_HOLE_S, Attitude, camera_in_device, check_roll, held_deg, log_error, unknown_at
from .frames import read_frames
from .phone_log import PICTURES_CLOCK, UTC_CLOCK, VIDEO_CLOCK, PhoneLog
from .sensor_logger import read_phone_log

#: Longer side (px) of the reduced picture, and the longest stretch of a video that is used (s): some seconds suffice.
_SIDE_PX, LONGEST_S = 256, 90.0
#: Parts of the picture along its shorter and its longer side.
_PARTS = (2, 3)


def picture_motion(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) of the frames and shifts (T - 1, 2) between neighbours, to the right and down, in longer sides.

    The median over six parts of the reduced grey picture, each by phase correlation, so that a person who walks through
    one or two of them does not matter. (On a rendered film with such a person the correlation with the true turns is
    0.97; with the whole picture at once it is 0.62.)
    """
    times, shifts = [], []
    last: list[np.ndarray] = []
    for frame in progress.track(read_frames(path), "movement of the picture"):
        if frame.time_s > LONGEST_S:
            break
        height, width = frame.image.shape[:2]
        scale = _SIDE_PX / max(width, height)
        size = (max(32, round(width * scale)), max(32, round(height * scale)))
        grey = cv2.cvtColor(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
        across, down = _PARTS if width < height else _PARTS[::-1]
        parts = [p for row in np.array_split(grey, down) for p in np.array_split(row, across, axis=1)]
        parts = [np.ascontiguousarray(p, np.float32) for p in parts]
        if last:
            moved = [_shift(a, b) for a, b in zip(last, parts, strict=True)]
            shifts.append(np.median(moved, axis=0) / max(size))
        times.append(frame.time_s)
        last = parts
    return np.array(times), np.array(shifts, np.float64).reshape(-1, 2)


def _shift(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    window = _window(before.shape[1], before.shape[0])
    (dx, dy), _ = cv2.phaseCorrelate(before, after, window)
    return dx, dy


@functools.lru_cache(maxsize=16)
def _window(width: int, height: int) -> np.ndarray:
    return cv2.createHanningWindow((width, height), cv2.CV_32F)


#: Largest error of the stated time of recording (s): it is rounded to seconds, and a recording takes time to start.
STATED_WITHIN_S = 2.0
#: Fraction of the video that a log must cover at a shift.
LEAST_COVER = 0.9
#: The pictures decide if their movement and the log's have at least this correlation, and one higher by this lead than
#: at any shift farther off than `_PEAK_S`.
LEAST_CORRELATION, LEAST_LEAD, _PEAK_S = 0.5, 0.15, 0.3
#: To overrule the time of recording in the file, the pictures need a higher correlation. Of 80 logs of other hands, a
#: minute each against 3 and 6 s of rendered film, the best shift has a correlation of 0.64 and a lead of 0.12 at most;
#: the right log has 0.97 and 0.26.
CERTAIN_CORRELATION = 0.75
#: Largest offset of a log that is nearly on the video's clock (s), as in the fit, and standard deviation of the
#: remaining offset after matching the pictures: on rendered films 2 ms at most; the fit's own estimate has 7
#: (docs/phone_capture.md).
NEARLY_S, PICTURES_SD_S = 0.5, 0.005
#: Steps (s) of the search, coarse and fine, and of the log's rate of turn.
_COARSE_S, _FINE_S, _STEP_S = 0.02, 0.002, 0.005
#: A phone that turns by less than this (deg, standard deviation) is on a stand: the shift does not matter.
_STILL_DEG = 0.3
_ZONE_S, _LARGEST_ZONES = 900.0, 56


@dataclasses.dataclass(frozen=True)
class Match:
    """Best shift (s) to add to the log's times, its correlation, and the highest correlation at other shifts."""

    shift_s: float
    correlation: float
    rival: float

    @property
    def decides(self) -> bool:
        return self.correlation >= LEAST_CORRELATION and self.correlation - self.rival >= LEAST_LEAD


class Aligned(NamedTuple):
    """Seconds to add to a log's times so that 0 is the first frame of its video, the source of this shift in words, and
    its standard deviation (s), NaN if the fit estimates the remaining offset."""

    shift_s: float
    how: str
    sd_s: float = math.nan


def align_clock(log: PhoneLog, quat_wxyz: np.ndarray, video: VideoInfo, path: Path) -> Aligned:
    """Bring a log's clock to that of its `video`.

    quat_wxyz (P, 4): the log's orientation, camera to world.

    Raises `PblError` PHONE_LOG: the log and the video are of different times (a time zone that explains it is named),
    or the part of the log that belongs to the video cannot be found.
    """
    duration = float(max(video.time_s[-1] - video.time_s[0], 1e-3)) if len(video.time_s) else 1e-3
    if log.clock in (VIDEO_CLOCK, PICTURES_CLOCK):
        if _cover(log, 0.0, duration, 0.0) == 0.0:
            raise log_error(
                said(
                    "a log from {start:.6g} to {end:.6g} s, without start_utc", start=log.time_s[0], end=log.time_s[-1]
                ),
                f"seconds from the first frame of the video, which lasts {duration:.1f} s",
                next_step="subtract the time at which the recording began, and write seconds; or add start_utc "
                "(docs/phone_capture.md)",
                key=path,
            )
        if log.clock == PICTURES_CLOCK and not _still(quat_wxyz):
            match = match_pictures(log.time_s, quat_wxyz, video, [(-NEARLY_S, NEARLY_S)])
            if match.decides and match.correlation >= CERTAIN_CORRELATION:
                how = f"{_by_pictures(match)}, which moved it by {1000 * match.shift_s:.0f} ms"
                return Aligned(match.shift_s, how, PICTURES_SD_S)
        return Aligned(0.0, "on the video's clock")
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
        return Aligned(shifts[0], "the phone stood still, so its clock does not matter")
    match = match_pictures(log.time_s, quat_wxyz, video, ranges)
    if match.decides:
        return Aligned(match.shift_s, _by_pictures(match))
    if stated and max(shifts) - min(shifts) <= STATED_WITHIN_S:
        how = "clock by the time of recording in the file, within 1 s: the pictures do not tell it better"
        return Aligned(shifts[0], how)
    raise log_error(
        said(
            "a log whose part that belongs to the video cannot be found (correlation with the movement of the pictures "
            "{best:.2f} at best, {other:.2f} elsewhere)",
            best=match.correlation,
            other=match.rival,
        ),
        "one shift at which the log moves as the pictures do, or a log that begins with the video",
        next_step="write time_s on the video's clock (docs/phone_capture.md), or leave the log out",
        key=path,
    )


def _against_the_file(
    log: PhoneLog, quat_wxyz: np.ndarray, video: VideoInfo, shift: float, duration: float, path: Path
) -> Aligned:
    """Match the pictures although the log and the file's time of recording disagree by `shift`: files lose that time
    when they are converted, and clocks are set to other zones. Raises `PblError` PHONE_LOG if they do not match."""
    if not _still(quat_wxyz) and _cover(log, -float(log.time_s[0]), duration, 0.0) >= LEAST_COVER:
        match = match_pictures(log.time_s, quat_wxyz, video, [_anywhere(log, duration, path)])
        if match.decides and match.correlation >= CERTAIN_CORRELATION:
            off = abs(match.shift_s - shift)
            apart = f"{off / 3600:.1f} h" if off < 86400 else f"{off / 86400:.1f} days"
            return Aligned(match.shift_s, f"{_by_pictures(match)}, {apart} from the time of recording in the file")
    raise _other_time(log, video, shift, duration, path)


def _by_pictures(match: Match) -> str:
    return f"clock by the pictures' movement (correlation {match.correlation:.2f})"


def _anywhere(log: PhoneLog, duration: float, path: Path) -> tuple[float, float]:
    """Range of shifts at which some part of the log covers the video. Raises `PblError` PHONE_LOG: too short a log."""
    last = float(log.time_s[-1]) - duration * LEAST_COVER
    if last < log.time_s[0]:
        raise log_error(
            said("a log of {s:.1f} s", s=log.time_s[-1] - log.time_s[0]),
            f"at least {LEAST_COVER:.0%} of the video's {duration:.1f} s",
            next_step="take the log of this recording, or leave it out",
            key=path,
        )
    return -last, -float(log.time_s[0]) + (1 - LEAST_COVER) * duration


def match_pictures(
    time_s: np.ndarray, quat_wxyz: np.ndarray, video: VideoInfo, ranges: list[tuple[float, float]]
) -> Match:
    """Find the shift in these ranges at which the log (P,), (P, 4) turns as the pictures move."""
    at, moved = picture_motion(video.path)
    grid = np.arange(time_s[0], time_s[-1], _STEP_S)
    turns = Slerp(time_s, Rotation.from_quat(quat_wxyz, scalar_first=True))(grid)
    # In the camera's axes; a turn to the right (about y) moves the picture to the left, one upwards (about x) down.
    w = (turns[:-1].inv() * turns[1:]).as_rotvec()
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([-w[:, 1], w[:, 0]], axis=1), axis=0)])

    def correlation(shift: float) -> float:
        t = at - shift
        inside = (t[:-1] >= grid[0]) & (t[1:] <= grid[-1]) & ~unknown_at(t, time_s, quat_wxyz)[1:]
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
    """Shifts for a time of recording that is the video's beginning, or its end; empty if a time is not known."""
    if log.clock != UTC_CLOCK or log.start_utc_s is None or video.recorded_utc is None:
        return []
    recorded = datetime.datetime.fromisoformat(video.recorded_utc).timestamp() + 0.5  # seconds are cut off
    begin = log.start_utc_s - recorded
    return [begin, begin + duration]


def _cover(log: PhoneLog, shift: float, duration: float, slack: float) -> float:
    """Fraction of the video that the log covers, `slack` seconds allowed at either end."""
    first, last = log.time_s[0] + shift - slack, log.time_s[-1] + shift + slack
    return float(np.clip(min(last, duration) - max(first, 0.0), 0, None) / duration)


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
    step = "take the log of this recording, or time_s on the video's clock (docs/phone_capture.md)"
    if hours is not None:
        step = said("the clocks are {h:g} h apart: one is in another time zone; write UTC into the log", h=abs(hours))
    return log_error(
        said("a log from {start} to {end} UTC", start=f"{begin:%Y-%m-%d %H:%M:%S}", end=f"{end:%H:%M:%S}"),
        f"the time of the video, {duration:.1f} s around {video.recorded_utc}",
        next_step=step,
        key=path,
    )


def load_attitude(path: str | Path, video: VideoInfo | None = None) -> Attitude:
    """Read a phone's sensor log (docs/phone_capture.md): R_nc of the camera on the video's clock.

    With the probed `video`, the phone's turn is taken from it if the log does not state one, and a log on another clock
    is brought to the video's (`align_clock`, which may read the pictures). Without it, the phone is assumed to have
    been held in portrait, and time 0 of the log is the first frame.

    Raises `PblError` FILE_MISSING, PHONE_LOG: see `read_phone_log`; a log by which the upright picture would lie on its
    side or stand on its head (a wrong `frame` or `rotation_deg`, or quaternions that turn the other way); a log of
    another time than the video's; a video of the front camera.
    """
    path = Path(path)
    return attitude_of(read_phone_log(path), path, video)


def attitude_of(log: PhoneLog, path: Path, video: VideoInfo | None = None) -> Attitude:
    """The camera's orientation from a log that was read; see `load_attitude`."""
    quat = log.quat_wxyz
    if log.frame == DEVICE:
        if video is not None and "front" in (video.lens or "").lower():
            raise log_error(said("a video of the {lens}", lens=video.lens), "the camera on the phone's back", key=path)
        turned = log.rotation_deg
        if turned is None:
            turned = held_deg(video, quat) if video is not None else 0.0
        turns = Rotation.from_quat(quat, scalar_first=True) * camera_in_device(turned)
        quat = turns.as_quat(scalar_first=True)
    check_roll(path, quat, log.frame)
    clock = Aligned(0.0, "") if video is None else align_clock(log, np.asarray(quat), video, path)
    source = f"{path.name} ({log.form})" + (f": {clock.how}" if clock.how else "")
    hole = float(np.diff(log.time_s).max())
    if hole > MAX_HOLE_S and not _still(quat):
        source += f"; without samples for up to {hole:.1f} s, where the orientation is unknown"
    return Attitude(log.time_s + clock.shift_s, quat, source, clock.sd_s)
