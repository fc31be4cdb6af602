"""Facts of a video file that are known before its pictures are used.

Slow motion is stored in two ways. The phone's original has stamps of real time and some hundred frames a second. An
exported or edited copy plays 30 of these frames a second, so every duration comes out too long. Android states the
rate to which the camera was set (`com.android.capture.fps`), also of a time lapse and in low light; an edit list may
state a speed, which no decoder applies; in a copy that an iPhone exported nothing shows it.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import VideoReformatter

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.files import sha256_of
from pbl_pipeline.names import is_plain
from pbl_pipeline.qc import FAIL, PASS, WARN, Check
from pbl_pipeline.results.video_facts import FirstPicture, VideoInfo
from pbl_pipeline.runs import runs
from pbl_pipeline.sampling import interval_of

from .container_tags import Tags, read_tags
from .decode import Decoder, check_file
from .frames import Orientation, orientation_of
from .kept import keeping

#: A recorded rate that differs from the stored one by less than this factor is rounding or a dropped frame.
_MOST_RATIO = 1.1
#: Slow motion is recorded at more than 60 frames a second and plays at half the speed or less. A phone that lowers its
#: rate in low light states the one that it was set to (30 of 24): below this factor its stamps are real time.
_LEAST_SLOW_RATIO, _LEAST_SLOW_FPS = 1.5, 60.0
#: Time lapses are recorded at 15 frames a second or less.
_MOST_LAPSE_FPS = 15.0
#: From this many frames a second on, a phone calls it slow motion.
_SLOW_MOTION_FPS = 100.0


def speed_notes(fps: float, capture_fps: float | None, speeds: Sequence[float]) -> list[str]:
    """Notes on the playing speed of a video of `fps` frames a second; `speeds` are those of its edit list."""
    notes = []
    ratio, known = stretch(fps, capture_fps)
    rates = f"recorded at {capture_fps or 0:g} and stored at {fps:.4g} frames a second"
    if not known:
        notes.append(f"{rates}, as its phone states: whether its time is real cannot be told from the stamps")
    elif ratio > 1:
        notes.append(f"{rates}: its time runs {ratio:.2g} times too slow, and so does all that is computed from it")
    elif ratio < 1:
        notes.append(f"{rates} (time lapse): its time runs {1 / ratio:.2g} times too fast, and so does all of it")
    elif fps >= _SLOW_MOTION_FPS:
        notes.append(f"slow motion of {fps:.4g} frames a second; the stamps are taken as real time")
    odd = sorted({s for s in speeds if s not in (0.0, 1.0)})
    if odd:
        listed = ", ".join(f"{s:.3g}" for s in odd)
        notes.append(f"the edit list asks players for other speeds ({listed}): the stamps are those stored, without it")
    return notes


def stretch(fps: float, capture_fps: float | None) -> tuple[float, bool]:
    """Factor by which the stamps lengthen the movement, 1 for real time, and False if it cannot be told whether they
    do: then the factor if they did."""
    if capture_fps is None or not math.isfinite(fps) or fps <= 0:
        return 1.0, True
    ratio = capture_fps / fps
    if 1 / _MOST_RATIO <= ratio <= _LEAST_SLOW_RATIO:
        return 1.0, True
    if ratio > 1:
        return ratio, capture_fps > _LEAST_SLOW_FPS
    return ratio, capture_fps <= _MOST_LAPSE_FPS and ratio < 1 / _LEAST_SLOW_RATIO


def check_timing(video: VideoInfo) -> tuple[Check, ...]:
    """Check `time_stretch` of a video whose phone states the rate of recording; no check of others."""
    if video.capture_fps is None:
        return ()
    ratio, known = stretch(video.fps, video.capture_fps)
    if ratio == 1.0:
        return (Check("time_stretch", PASS, ratio, _MOST_RATIO),)
    # Each advice is written out: the pages' German is found by the whole of it.
    a, b = f"{video.capture_fps:g}", f"{video.fps:.4g}"
    if not known:
        advice = (
            f"recorded at {a} and stored at {b} frames a second: slow motion, a time lapse and a rate lowered in low "
            "light cannot be told apart here; compare the cadence with the person's"
        )
        return (Check("time_stretch", WARN, ratio, _MOST_RATIO, advice),)
    if ratio > 1:
        advice = (
            f"slow motion: recorded at {a} and stored at {b} frames a second, so every time, cadence and speed is "
            "wrong; copy the original from the phone, or film at normal speed"
        )
    else:
        advice = (
            f"time lapse: recorded at {a} and stored at {b} frames a second, so every time, cadence and speed is "
            "wrong; copy the original from the phone, or film at normal speed"
        )
    return (Check("time_stretch", FAIL, ratio, _MOST_RATIO, advice),)


#: Longer side (px) of the reduced grey picture, and its interval in frames.
_SIDE_PX, EVERY = 160, 10
#: Grey levels (of 255) by which a border may differ from its colour, over area and time, and by which the picture
#: beside it differs: the edge between the two is sharp, unlike light that falls off over a wall.
_LEVELS, _EDGE_LEVELS = 6, 20
#: Least width of the borders on two opposite sides, and least extent of the picture along them, as fractions of the
#: whole: a player fills the screen in one direction.
_LEAST_WIDTH, _LEAST_EXTENT = 0.03, 0.5
#: Fraction of a row that differs: least of the picture's rows at its edges (a room may be as dark as the border), most
#: of the border's row beside it at any time (the edge is straight), and on average (a clock, a progress bar).
_AT_EDGE, _BESIDE, _OUTSIDE = 0.3, 0.05, 0.2


#: A line of a screen (the edge of a window or bar) is a step between two rows of pixels, straight and sharp, unlike a
#: camera's edges: least step (grey levels), its least fraction of the step over six rows, the fraction of pixels that
#: have both, and the length of the line as a fraction of the row.
_STEP_LEVELS, _OF_STEP, _STRAIGHT, _LONG = 10, 0.6, 0.9, 0.4
#: Lines nearer to the picture's edge than this fraction are padding; least number of lines that show a screen, and the
#: fraction of the movement that they enclose.
_PADDING, _LEAST_LINES, _ENCLOSED = 0.015, 4, 0.9
#: Rows that are examined together, for the memory.
_ROWS_AT_ONCE = 64


class BorderMeter:
    """Statistics of a video's pictures that show borders and a screen: where, at a reduced size, the grey ever differs
    from that of the edges and how often it differs by far, where it moves, and the mean picture at full size."""

    def __init__(self) -> None:
        self._n = 0
        # One for all frames: a new one each time would start its threads again.
        self._to_grey, self._to_small = VideoReformatter(), VideoReformatter()
        self._sum: np.ndarray = np.empty(0, np.float32)
        self._first = self._last = self._before = np.empty(0)
        self._moved: np.ndarray = np.empty(0)
        self._colours: np.ndarray = np.empty(0)
        self._ever: np.ndarray = np.empty(0, bool)
        self._often: np.ndarray = np.empty(0, np.int64)

    def add(self, frame: av.VideoFrame) -> None:
        """Add a frame; all have one size."""
        scale = _SIDE_PX / max(frame.width, frame.height)
        size = max(2, round(frame.width * scale)), max(2, round(frame.height * scale))
        full = self._to_grey.reformat(frame, format="gray", threads=1)
        self._last = full.to_ndarray()
        small = self._to_small.reformat(full, *size, interpolation="AREA", threads=1)
        grey = small.to_ndarray().astype(np.int16)
        if not self._n:
            # Of the first and last row, and of the first and last column: a border keeps its colour.
            self._colours = np.array([np.median(grey[[0, -1]]), np.median(grey[:, [0, -1]])])[:, None, None]
            self._ever, self._often = np.zeros((2, *grey.shape), bool), np.zeros((2, *grey.shape), np.int64)
            self._sum, self._moved = np.zeros((frame.height, frame.width), np.float32), np.zeros(grey.shape)
            self._before = grey
        self._first = self._last if not self._n else self._first
        self._sum += self._last
        self._moved += np.abs(grey - self._before) > _EDGE_LEVELS
        self._before = grey
        off = np.abs(grey - self._colours)
        self._n += 1
        self._ever |= off > _LEVELS
        self._often += off > _EDGE_LEVELS

    def widths(self) -> tuple[float, float] | None:
        """Return the widths of the borders at two opposite sides of the stored picture, as fractions of it; None
        without borders."""
        if not self._n:
            return None
        # Half of the time: an object that moves over a flat background is not the picture.
        usual = self._often >= 0.5 * self._n
        return _at_ends(usual[0], self._ever[0]) or _at_ends(usual[1].T, self._ever[1].T)

    def lines(self) -> int:
        """Return the number of a screen's lines around the movement; 0 if they are too few, or the movement is not
        between them."""
        greys = (self._sum / max(self._n, 1), self._first, self._last)
        sides = [(greys, self._moved), ([g.T for g in greys], self._moved.T)] if self._n else []
        found = [(_lines(pictures), moved.sum(axis=1)) for pictures, moved in sides]
        around = (
            moved[int(at[0] * len(moved)) : round(at[-1] * len(moved)) + 1].sum() >= _ENCLOSED * moved.sum() > 0
            for at, moved in found
            if len(at) > 1
        )
        n = sum(len(at) for at, _ in found)
        return n if n >= _LEAST_LINES and any(around) else 0


def _lines(greys: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of the horizontal lines of a screen in (H, W) grey levels, as fractions of H; one of adjacent rows.

    greys: the mean of all pictures, and the first and the last, in which moving edges differ.
    """
    height, width = greys[0].shape
    n, rows = max(1, int(_LONG * width)), []
    # Few rows of a camera's picture have enough steps in the mean for the remaining conditions to matter.
    step = np.abs(greys[0][3:-2] - greys[0][2:-3])
    possible = np.flatnonzero(np.count_nonzero(step >= _STEP_LEVELS, axis=1) >= _STRAIGHT * n)
    for some in np.split(possible, range(_ROWS_AT_ONCE, len(possible), _ROWS_AT_ONCE)):
        around = some[:, None] + np.arange(6)
        parts = [grey[around].astype(np.float32) for grey in greys]
        for sign in (1, -1):
            hits = np.logical_and.reduce([_steps(sign * part, k) for part, k in zip(parts, (1, 0.5, 0.5), strict=True)])
            count = np.pad(np.cumsum(hits, axis=1, dtype=np.int32), ((0, 0), (1, 0)))
            straight = (count[:, n:] - count[:, :-n]).max(axis=1, initial=0) >= _STRAIGHT * n
            rows += (some[straight] + 3).tolist()
    found = np.unique(rows)
    at = found[np.diff(found, prepend=-9) > 3] / height
    return at[(at > _PADDING) & (at < 1 - _PADDING)]


def _steps(grey: np.ndarray, part: float) -> np.ndarray:
    """(N, W) where six rows of grey levels (N, 6, W) rise in the middle by `part` of the step of a screen's line."""
    step, over = grey[:, 3] - grey[:, 2], grey[:, 5] - grey[:, 0]
    return (step >= part * _STEP_LEVELS) & (step >= part * _OF_STEP * over)


def _at_ends(usual: np.ndarray, ever: np.ndarray) -> tuple[float, float] | None:
    """Widths of the borders of one colour at the first and the last row, None if one is missing.

    Parameters
    ----------
    usual, ever
        (H, W) bool: the grey differs from the border's by far most of the time, or at all at any time.
    """
    of_columns = usual.mean(axis=0)
    columns = np.flatnonzero(of_columns > 0.5 * of_columns.max())
    across = slice(columns.min(initial=len(of_columns)), columns.max(initial=-1) + 1)
    if across.stop - across.start < _LEAST_EXTENT * len(of_columns):
        return None
    # The longest run of rows that differ: a progress bar or the text of an app is a shorter one.
    rows = max(runs(ever[:, across].mean(axis=1) > _BESIDE), key=lambda r: r.stop - r.start, default=None)
    if rows is None:
        return None
    top, end = rows.start, rows.stop
    widths = top / len(ever), 1.0 - end / len(ever)
    if min(widths) < _LEAST_WIDTH:
        return None
    # The row at an edge may belong to both.
    filled = usual[:, across].mean(axis=1)
    sharp = min(filled[top : top + 2].max(), filled[max(0, end - 2) : end].max()) >= _AT_EDGE
    return widths if sharp and max(ever[:top].mean(), ever[end:].mean()) <= _OUTSIDE else None


def probe(path: str | Path, *, threads: int | None = None) -> VideoInfo:
    """Decode `path` once and describe it.

    The whole file is decoded, because that alone shows which frames there are: edit lists, damaged ends and announced
    counts may differ. The frames and stamps are those of `read_frames`. Memory does not grow with the length.

    Raises `PblError` VIDEO_MISSING, VIDEO_EMPTY, VIDEO_NOT_A_VIDEO, VIDEO_TOO_LARGE, VIDEO_NO_FRAMES, VIDEO_TRUNCATED,
    VIDEO_DAMAGED, VIDEO_TIMESTAMPS, VIDEO_SCREEN, VIDEO_PIXELS.
    """
    path = check_file(path)
    sha256 = sha256_of(path)
    stamps: list[int] = []
    borders = BorderMeter()
    turn, pixel_format, width, height = Orientation(), "", 0, 0
    with Decoder(path, threads, exact=True) as decoder:
        stream, container = decoder.stream, decoder.container
        _check_square(path, stream.sample_aspect_ratio)
        n_interlaced = 0
        for pts, frame in progress.track(keeping(decoder), "reading video", total=decoder.n_announced or None):
            if not stamps:
                turn = orientation_of(frame)
                pixel_format = frame.format.name
                width, height = turn.size(frame.width, frame.height)
            if len(stamps) % EVERY == 0:
                borders.add(frame)
            stamps.append(pts)
            n_interlaced += bool(frame.interlaced_frame)
        if n_interlaced > 0.5 * len(stamps):
            raise PblError(
                "VIDEO_PIXELS",
                found=said(
                    "{n} of {all} pictures are interlaced: each shows two moments, line by line",
                    n=n_interlaced,
                    all=len(stamps),
                ),
                expected="pictures of one moment each",
                next_step='film progressively, or separate the moments ("ffmpeg -i in.mp4 -vf bwdif out.mp4")',
                key=path,
            )
        widths = borders.widths()
        n_lines = borders.lines() if widths is None else 0
        if widths is not None or n_lines:
            raise PblError(
                "VIDEO_SCREEN",
                found=said("{n} exactly straight lines around what moves, as of a screen's windows and bars", n=n_lines)
                if widths is None
                else said(
                    "borders of {one:.0%} and {other:.0%} of the picture at two opposite sides, which never change",
                    one=widths[0],
                    other=widths[1],
                ),
                expected="the whole picture of a camera",
                next_step="send the recording itself, not one of a screen on which it is played, nor an edited copy",
                key=path,
            )
        ticks = np.asarray(stamps, np.int64) - stamps[0]
        tick_s = float(decoder.time_base)
        time_s = ticks * tick_s
        interval_s, varies = _rate(time_s, tick_s, float(stream.average_rate) if stream.average_rate else None)
        tags = read_tags(path)
        metadata = _metadata(decoder, tags)
        capture_fps = _number(metadata, "com.android.capture.fps", "com.apple.quicktime.capture.fps")
        notes = decoder.notes + _picture_notes(turn)
        notes += speed_notes(1.0 / interval_s, capture_fps, tags.speeds)
        return VideoInfo(
            path=str(path),
            sha256=sha256,
            size_bytes=path.stat().st_size,
            container=_container_name(container.format.name, metadata),
            codec=stream.codec_context.name,
            pixel_format=pixel_format,
            width_px=width,
            height_px=height,
            rotation_deg=turn.rotation_deg,
            time_s=time_s,
            fps=1.0 / interval_s,
            duration_s=float(time_s[-1]) + interval_s,
            n_frames=len(time_s),
            n_frames_announced=decoder.n_announced,
            variable_frame_rate=varies,
            recorded_utc=_recorded_utc(metadata),
            notes=tuple(notes),
            capture_fps=capture_fps,
            **_phone(metadata),
        )


def read_first(path: str | Path) -> FirstPicture:
    """Size and rotation of a video's first picture, and the phone that recorded it. Nothing else is decoded.

    Raises `PblError` as `probe`.
    """
    path = check_file(path)
    with Decoder(path) as decoder:
        _, frame = next(iter(decoder))  # without a picture it raises
        turn = orientation_of(frame)
        metadata = _metadata(decoder, read_tags(path))
        width, height = turn.size(frame.width, frame.height)
        return FirstPicture(str(path), width, height, turn.rotation_deg, **_phone(metadata))


def packet_times(path: str | Path) -> np.ndarray:
    """(n,) time stamps (s) of a video's pictures as its container states them, the first 0. Nothing is decoded: a file
    with a damaged end or an edit list may decode to other frames (`probe`).

    Raises `PblError` VIDEO_MISSING, VIDEO_EMPTY, VIDEO_NOT_A_VIDEO, VIDEO_TRUNCATED, VIDEO_TOO_LARGE.
    """
    path = check_file(path)
    with Decoder(path) as decoder:
        stamps = decoder.packet_stamps()
    return (np.sort(stamps) - min(stamps, default=0)) * float(decoder.time_base)


def read_metadata(path: str | Path) -> dict[str, str]:
    """Return the metadata of a file (place, phone, times, ...): names in lower case, and texts of one line.

    Raises `PblError` as `probe`.
    """
    path = check_file(path)
    with Decoder(path) as decoder:
        found = _metadata(decoder, read_tags(path))
    return {name.lower(): text.strip() for name, text in found.items() if is_plain(text.strip())}


def recorded_utc(path: str | Path) -> str | None:
    """Return the file's time of recording (YYYY-MM-DDTHH:MM:SSZ); None if it states none. Nothing is decoded.

    Raises `PblError` as `probe`.
    """
    return _recorded_utc(read_metadata(path))


def _metadata(decoder: Decoder, tags: Tags) -> dict[str, str]:
    """Metadata of the stream, the container and its atoms by name; the later ones take precedence."""
    return dict(decoder.stream.metadata) | dict(decoder.container.metadata) | tags.items


def _phone(metadata: Mapping[str, str]) -> dict[str, Any]:
    return {
        "make": _first(metadata, "com.apple.quicktime.make", "com.android.manufacturer", "make"),
        "model": _first(metadata, "com.apple.quicktime.model", "com.android.model", "model"),
        "lens": _first(metadata, "com.apple.quicktime.camera.lens_model"),
        "focal_35mm": _number(metadata, "com.apple.quicktime.camera.focal_length.35mm_equivalent"),
    }


def _rate(time_s: np.ndarray, tick_s: float, announced_fps: float | None) -> tuple[float, bool]:
    """Sampling interval (s), and True if intervals vary by more than a tenth and more than rounding explains."""
    if len(time_s) < 2:
        return (1.0 / announced_fps if announced_fps else float("nan")), False
    steps = np.diff(time_s)
    median = float(np.median(steps))
    # Stamps rounded to whole ticks put up to one tick between equal intervals (MKV: 1 ms).
    tolerance = max(0.1 * median, 1.001 * tick_s)
    return interval_of(time_s), bool(np.abs(steps - median).max() > tolerance)


#: Largest deviation of the pixels' sides from each other: rounded sizes of converted copies are below.
_SQUARE_WITHIN = 0.01


def _check_square(path: Path, pixel_aspect: Fraction | None) -> None:
    """Raise `PblError` VIDEO_PIXELS for pixels that are not square, whose camera has two focal lengths."""
    if pixel_aspect and abs(float(pixel_aspect) - 1) > _SQUARE_WITHIN:
        raise PblError(
            "VIDEO_PIXELS",
            found=said("pixels of {w}:{h}, as the file states", w=pixel_aspect.numerator, h=pixel_aspect.denominator),
            expected="square pixels",
            next_step='resample the pictures ("ffmpeg -i in.mp4 -vf scale=iw*sar:ih,setsar=1 out.mp4")',
            key=path,
        )


def _picture_notes(turn: Orientation) -> list[str]:
    notes = []
    if turn.mirrored:
        notes.append("the file asks for a mirrored picture: left and right are swapped as a player shows it")
    if not turn.exact:
        notes.append(f"the rotation is not a multiple of 90 degrees: {turn.rotation_deg} is used")
    return notes


def _container_name(format_name: str, metadata: Mapping[str, str]) -> str:
    first = format_name.split(",")[0]
    if first != "mov":
        return first
    return "mov" if metadata.get("major_brand", "").startswith("qt") else "mp4"


def _recorded_utc(metadata: Mapping[str, str]) -> str | None:
    text = _first(metadata, "com.apple.quicktime.creationdate", "creation_time")
    if text is None:
        return None
    try:
        when = datetime.datetime.fromisoformat(text)
    except ValueError:
        return None
    if when.tzinfo is None:
        when = when.replace(tzinfo=datetime.UTC)
    when = when.astimezone(datetime.UTC)
    # 1904 and 1970 are the zeros of two clocks: the camera did not know the time.
    return when.strftime("%Y-%m-%dT%H:%M:%SZ") if when.year > 1990 else None


def _first(metadata: Mapping[str, str], *names: str) -> str | None:
    lower = {key.lower(): value.strip() for key, value in metadata.items() if is_plain(value.strip())}
    return next((lower[name] for name in names if lower.get(name)), None)


def _number(metadata: Mapping[str, str], *names: str) -> float | None:
    """The positive number at the beginning of a tag ("27", "27.00mm"); None if there is none."""
    digits = re.match(r"\d+(\.\d+)?", _first(metadata, *names) or "")
    value = float(digits[0]) if digits else 0.0
    return value if value > 0 else None
