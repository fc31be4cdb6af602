"""Markers of a laboratory: points in the world, without a camera, and their TRC files of tab-separated text.

Line 1 of a TRC file names the format, lines 2 and 3 are a table of one row (DataRate, NumFrames, NumMarkers, Units,
...). Line 4 holds `Frame#`, `Time` and each marker's name over its three columns, line 5 the axes. Then a row for each
frame.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.assumptions import Origin
from pbl_pipeline.bounded import MAX_SECONDS, MAX_TEXT, count_rows, read_bytes, span_s
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.files import check_numbers, load_npz, text_of, texts_of
from pbl_pipeline.names import is_plain
from pbl_pipeline.sampling import interval_of

_SPELLED = ("er", "ers", "re", "res")
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_METRES |= {f"{p}met{end}": _METRES[u] for p, u in (("milli", "mm"), ("centi", "cm"), ("", "m")) for end in _SPELLED}
#: Largest relative difference between `DataRate` and the times, which some programs round to milliseconds.
_SAME_RATE = 0.05
_HEADER_LINES = 5
#: Spread of the markers of a frame beyond that of a room, or below that of a body: the stated unit is wrong.
_WIDEST_M, _NARROWEST_M = 50.0, 0.01
_FORMAT = "see docs/files.md, section markers of a laboratory"
_format_error = functools.partial(PblError, "FILE_FORMAT", next_step=_FORMAT)
_damaged = functools.partial(
    PblError,
    "FILE_FORMAT",
    next_step="export it again, tab-separated; docs/files.md, section markers of a laboratory, describes the format",
)


@dataclasses.dataclass(frozen=True)
class Trc:
    """Content of a TRC file."""

    time_s: np.ndarray  # (T,)
    names: tuple[str, ...]  # J
    xyz_m: np.ndarray  # (T, J, 3) in the file's axes, NaN where a cell is empty or a marker's three numbers are 0
    origin: Origin


def read_trc(path: str | Path, pixels: bool = False) -> Trc:
    """Read a TRC file; `pixels`: its numbers are taken as they are, whatever unit its header states.

    Raises `PblError` FILE_MISSING: no such file. FILE_FORMAT: not a TRC, other numbers of frames or markers than in its
    header, a row with too few or too many cells, a cell that is not a finite number, times that do not increase or
    contradict DataRate, a unit other than mm, cm, m, or one by which the markers lie further apart than 50 m or closer
    than 1 cm.
    """
    with os_errors_as("FILE_MISSING", "a TRC file", "check the path, and that you may read the file", path):
        try:
            # A path in the first line may be in any encoding.
            lines = read_bytes(path, MAX_TEXT).decode("utf-8-sig", errors="replace").splitlines()
            count_rows(len(lines))
        except ValueError as error:
            raise _damaged(str(error), "some minutes of some hundred markers", key=path) from error
    if len(lines) < _HEADER_LINES or not lines[0].startswith("PathFileType"):
        raise _damaged("no header of a TRC file", "five lines, the first beginning with PathFileType", key=path)
    header = dict(zip(_cells(lines[1]), _cells(lines[2]), strict=False))
    scale = 1.0 if pixels else _METRES.get(header.get("Units", "").lower())
    if scale is None:
        raise _damaged(f"Units {header.get('Units', '')!r}", "mm, cm or m", key=path)
    names = tuple(n for n in _cells(lines[3])[2:] if n)
    if not names or _count(path, header, "NumMarkers") != len(names):
        raise _damaged(
            f"{len(names)} names, NumMarkers {header.get('NumMarkers')}", "as many names as markers", key=path
        )
    rows = [(i, line) for i, line in enumerate(lines[_HEADER_LINES:], _HEADER_LINES + 1) if line.strip()]
    if not rows or _count(path, header, "NumFrames") != len(rows):
        raise _damaged(f"{len(rows)} rows, NumFrames {header.get('NumFrames')}", "a row for each frame", key=path)
    table = np.array([_numbers(path, i, line, 2 + 3 * len(names)) for i, line in rows])
    time_s, xyz = table[:, 1], scale * table[:, 2:].reshape(len(rows), len(names), 3)
    if not np.isfinite(time_s).all() or np.any(np.diff(time_s) <= 0):
        raise _damaged("times that are missing, repeat or run backwards", "strictly increasing seconds", key=path)
    zeros, origin = np.all(xyz == 0, axis=2), Origin([] if pixels else [f"unit {header['Units']}"])
    if zeros.any():
        found = ", ".join(name for name, lost in zip(names, zeros.any(axis=0), strict=True) if lost)
        origin.assumed.append(f"points of three zeros count as missing ({int(zeros.sum())} samples): {found}")
    xyz[zeros] = np.nan
    if not pixels:
        _check_unit(path, xyz, header["Units"])
    _check_rate(path, time_s, header.get("DataRate", ""))
    return Trc(time_s, names, xyz, origin)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("\t")]


def _count(path: str | Path, header: dict[str, str], name: str) -> int:
    try:
        return int(float(header[name]))
    except (KeyError, ValueError, OverflowError) as error:
        raise _damaged(f"{name} {header.get(name, '')!r}", "a whole number", key=path) from error


def _numbers(path: str | Path, number: int, line: str, n_cells: int) -> np.ndarray:
    cells = _cells(line)
    if len(cells) < n_cells or any(cells[n_cells:]):
        raise _damaged(f"line {number}: {len(cells)} cells", f"{n_cells} cells between tabs", key=path)
    try:
        values = np.array([float(cell) if cell else np.nan for cell in cells[:n_cells]])
    except ValueError as error:
        raise _damaged(
            f"line {number}: {error}", "numbers, or empty cells where a marker is missing", key=path
        ) from error
    if np.isinf(values).any():
        raise _damaged(f"line {number}: an infinite number", "finite numbers, or empty cells", key=path)
    return values


def _check_unit(path: str | Path, xyz_m: np.ndarray, unit: str) -> None:
    whole = xyz_m[np.sum(np.isfinite(xyz_m).all(axis=2), axis=1) >= 3]
    if not len(whole):
        return
    size = float(np.median(np.max(np.nanmax(whole, axis=1) - np.nanmin(whole, axis=1), axis=1)))
    if not _NARROWEST_M < size < _WIDEST_M:
        flat = "" if np.nanmax(np.abs(xyz_m[..., 2])) else "; of pixels, _px in the file's name, as Sports2D writes it"
        expected = f"the unit the numbers are in{flat}"
        raise _damaged(f"markers that lie {size:.3g} m apart if Units {unit} is right", expected, key=path)


def _check_rate(path: str | Path, time_s: np.ndarray, stated: str) -> None:
    try:
        rate = float(stated)
    except ValueError:
        return
    if len(time_s) < 2 or not np.isfinite(rate) or rate <= 0:
        return
    step = interval_of(time_s)
    ratio = rate * step
    if abs(ratio - 1) > _SAME_RATE:
        guess = {1000: ": milliseconds", round(rate): ": frame numbers"}.get(round(ratio), "")
        raise _damaged(
            f"DataRate {stated}, but frames {step:.4g} s apart by the column Time{guess}",
            f"times in seconds, {1 / rate:.4g} s apart",
            key=path,
        )


_FIELDS = ("time_s", "names", "marker_set", "xyz_world_m", "confidence")


@dataclasses.dataclass(frozen=True)
class WorldMarkers:
    """One trial of optical markers. A marker that was not seen is NaN with confidence 0.

    Raises `PblError` FILE_FORMAT: shapes, types, names that repeat, confidence outside 0..1, infinite values, NaN with
    a confidence above 0. The order of the stamps is checked where they are used (FIT_INPUT, GAIT_INPUT).
    """

    time_s: np.ndarray  # (T,) time stamps, finite
    names: tuple[str, ...]  # all different
    marker_set: str  # name of the marker set; for a laboratory's own, the stem of its table
    xyz_world_m: np.ndarray  # (T, J, 3) world: right-handed, z up, metres; origin and heading are the laboratory's
    confidence: np.ndarray  # (T, J) 0..1
    origin: Origin = dataclasses.field(default_factory=Origin, compare=False)  # of a file's data; not saved

    def __post_init__(self) -> None:
        for field in ("time_s", "xyz_world_m", "confidence"):
            try:
                object.__setattr__(self, field, np.asarray(getattr(self, field), np.float64))
            except (TypeError, ValueError) as error:
                raise _format_error(f"{field}: {error}", "numbers") from error
        names = tuple(str(n) for n in self.names)
        object.__setattr__(self, "names", names)
        n, j = self.time_s.size, len(names)
        if not n or not j:
            raise _format_error(f"{n} frames, {j} markers", "at least one of each")
        for field, shape in {"time_s": (n,), "xyz_world_m": (n, j, 3), "confidence": (n, j)}.items():
            if getattr(self, field).shape != shape:
                found = f"{field} has shape {getattr(self, field).shape}"
                raise _format_error(found, f"shape {shape} for {n} frames, {j} names")
        if not all(map(is_plain, (*names, self.marker_set))):
            raise _format_error("names with control characters", "one line each")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice or "" in names:
            raise _format_error(
                f"names that repeat: {', '.join(twice) or '(empty)'}", "a different name for each marker"
            )
        if not np.isfinite(self.time_s).all():
            raise _format_error("time stamps that are not finite", "seconds")
        if span_s(self.time_s) > MAX_SECONDS:
            raise _format_error(f"time stamps that span {span_s(self.time_s):.3g} s", f"at most {MAX_SECONDS:g} s")
        if np.isinf(self.xyz_world_m).any():
            raise _format_error("infinite positions", "metres, NaN where a marker was not seen")
        c = self.confidence
        if not np.all((c >= 0) & (c <= 1)):
            raise _format_error("confidence outside 0..1 or not finite", "0 for a missing marker, at most 1")
        lost = int(np.sum(np.isnan(self.xyz_world_m).any(axis=2) & (c > 0)))
        if lost:
            raise _format_error(f"{lost} markers that are NaN with a confidence above 0", "confidence 0 there")

    def save(self, path: str | Path) -> None:
        """Write the .npz of docs/files.md (markers as float32)."""
        np.savez_compressed(
            path,
            time_s=self.time_s,
            names=np.asarray(self.names),
            marker_set=np.asarray(self.marker_set),
            xyz_world_m=self.xyz_world_m.astype(np.float32),
            confidence=self.confidence.astype(np.float32),
        )

    @classmethod
    def load(cls, path: str | Path) -> WorldMarkers:
        """Read the .npz of docs/files.md. Raises `PblError` FILE_MISSING, FILE_FORMAT. Never unpickles."""
        data = load_npz(path, needed=_FIELDS, next_step=_FORMAT)
        n, j = data["time_s"].size, data["names"].size
        check_numbers(path, data, {"time_s": (n,), "xyz_world_m": (n, j, 3), "confidence": (n, j)})
        names, marker_set = texts_of(path, data, "names"), text_of(path, data, "marker_set")
        values = (data["time_s"], names, marker_set, data["xyz_world_m"], data["confidence"])
        return _about(path, *values)

    @classmethod
    def from_trc(cls, path: str | Path, marker_set: str, up: str = "y") -> WorldMarkers:
        """Read a TRC file (OpenSim's and most motion capture programs' text format).

        `up` is the file's vertical axis. "y": turned by 90 degrees about x into the world, (x, y, z) to (x, -z, y), so
        x stays (OpenSim's forward) and the frame stays right-handed. "z": taken as it is. Empty cells, NaN and three
        zeros, which some programs write into gaps, are missing: NaN with confidence 0; all else has confidence 1.

        Raises `PblError` FILE_MISSING, FILE_FORMAT (also for impossible units), USAGE for another `up`.
        """
        if up not in ("y", "z"):
            raise PblError(
                "USAGE",
                found=f"up {up!r}",
                expected="y or z, the vertical axis of the file",
                next_step="look at the file: the heads' markers are highest along this axis",
                key=str(path),
            )
        trc = read_trc(path)
        xyz = trc.xyz_m
        if up == "y":
            xyz = np.stack([xyz[..., 0], -xyz[..., 2], xyz[..., 1]], axis=-1)
        seen = np.asarray(np.isfinite(xyz).all(axis=2))
        xyz, confidence = np.where(seen[..., None], xyz, np.nan), seen.astype(float)
        return _about(path, trc.time_s, trc.names, marker_set, xyz, confidence, trc.origin)

    def select(self, names: Sequence[str], marker_set: str | None = None) -> WorldMarkers:
        """Return the markers of `names` in that order; those that the trial lacks were never seen.

        `marker_set` renames the set. Raises `PblError` MARKER_SET_UNKNOWN if the trial has none of them.
        """
        column = {name: i for i, name in enumerate(self.names)}
        there = [i for i, name in enumerate(names) if name in column]
        if not there:
            raise PblError(
                "MARKER_SET_UNKNOWN",
                found=f"markers {', '.join(self.names)}",
                expected=f"some of {', '.join(names)}",
                next_step="name the markers in the table of --marker-set as the recording does",
                key=marker_set or self.marker_set,
            )
        xyz = np.full((len(self.time_s), len(names), 3), np.nan)
        confidence = np.zeros(xyz.shape[:2])
        source = [column[names[i]] for i in there]
        xyz[:, there], confidence[:, there] = self.xyz_world_m[:, source], self.confidence[:, source]
        return WorldMarkers(self.time_s, tuple(names), marker_set or self.marker_set, xyz, confidence, self.origin)


def _about(path: str | Path, *values) -> WorldMarkers:
    """Markers from a file, with its path in errors."""
    try:
        return WorldMarkers(*values)
    except PblError as error:
        raise _format_error(error.found, error.expected, key=path) from error
