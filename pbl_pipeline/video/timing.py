"""Whether the stamps of a video are the time in which the movement happened.

Slow motion is kept in two ways. The phone's original has stamps of real time and some hundred frames a second. An
exported or edited copy has the frames spread to 30 a second, and a second of it is a part of one: every duration comes
out too long. Android says so (`com.android.capture.fps`); an edit list may (its speed, which no decoder applies); of a
copy that an iPhone exported nothing in the file tells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pbl_pipeline.qc import FAIL, PASS, Check

from .types import VideoInfo

#: A recorded rate that lies above the stored one by less than this fraction is rounding or a dropped frame.
_MOST_RATIO = 1.1
#: From this many frames a second on, a phone calls it slow motion.
_SLOW_MOTION_FPS = 100.0


def speed_notes(fps: float, capture_fps: float | None, speeds: Sequence[float]) -> list[str]:
    """What a reader should know of a video of `fps` frames a second; `speeds` are those of its edit list."""
    notes = []
    ratio = stretch(fps, capture_fps)
    if ratio > _MOST_RATIO:
        notes.append(
            f"recorded at {capture_fps:g} and stored at {fps:.4g} frames a second: its time runs {ratio:.2g} times "
            "too slow, and so does all that is computed from it"
        )
    elif fps >= _SLOW_MOTION_FPS:
        notes.append(f"slow motion of {fps:.4g} frames a second; the stamps are taken as real time")
    odd = sorted({s for s in speeds if s not in (0.0, 1.0)})
    if odd:
        listed = ", ".join(f"{s:.3g}" for s in odd)
        notes.append(f"the edit list asks players for other speeds ({listed}): the stamps are those stored, without it")
    return notes


def stretch(fps: float, capture_fps: float | None) -> float:
    """How many times longer the stamps make a movement than it was; 1 where nothing says so."""
    if capture_fps is None or not math.isfinite(fps) or fps <= 0:
        return 1.0
    return max(1.0, capture_fps / fps)


def check_timing(video: VideoInfo) -> tuple[Check, ...]:
    """Check `time_stretch` of a video whose phone states the rate it recorded at; nothing of the others."""
    if video.capture_fps is None:
        return ()
    ratio = stretch(video.fps, video.capture_fps)
    if ratio <= _MOST_RATIO:
        return (Check("time_stretch", PASS, ratio, _MOST_RATIO),)
    advice = (
        f"slow motion: recorded at {video.capture_fps:g} and stored at {video.fps:.4g} frames a second, so every time, "
        "cadence and speed is wrong; copy the original from the phone, or film at normal speed"
    )
    return (Check("time_stretch", FAIL, ratio, _MOST_RATIO, advice),)
