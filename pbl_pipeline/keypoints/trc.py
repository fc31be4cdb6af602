"""TRC: markers as tab-separated text.

Line 1 names the format, lines 2 and 3 are a table of one row (DataRate, NumFrames, NumMarkers, Units, ...). Line 4
holds `Frame#`, `Time` and each marker's name over its three columns, line 5 the axes. Then a row for each frame.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from pbl_pipeline.bounded import MAX_TEXT, count_rows, read_bytes
from pbl_pipeline.errors import PblError

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_HEADER_LINES = 5
#: Spread of the markers of a frame that no room has and no body: the unit is another one than the file says.
_WIDEST_M, _NARROWEST_M = 50.0, 0.01


@dataclasses.dataclass(frozen=True)
class Trc:
    """`time_s` (T,); `names`, J; `xyz_m` (T, J, 3) in the file's own axes, NaN where a cell is empty or a marker's
    three numbers are 0."""

    time_s: np.ndarray
    names: tuple[str, ...]
    xyz_m: np.ndarray


def read_trc(path: str | Path) -> Trc:
    """Read a TRC file.

    Raises `PblError` FILE_MISSING: no such file. FILE_FORMAT: no TRC, other counts of frames or markers than its header
    says, a row with too few or too many cells, a cell that is not a finite number, times that do not increase, a unit
    other than mm, cm, m, or one that makes the markers lie further apart than 50 m or closer than 1 cm.
    """
    try:
        # Only names matter: a path in the first line may be in any encoding.
        lines = read_bytes(path, MAX_TEXT).decode("utf-8-sig", errors="replace").splitlines()
        count_rows(len(lines))
    except ValueError as error:
        raise _damaged(path, str(error), "some minutes of some hundred markers") from error
    except OSError as error:
        raise PblError(
            "FILE_MISSING",
            found=error.strerror or str(error),
            expected="a TRC file",
            next_step="check the path, and that you may read the file",
            key=str(path),
        ) from error
    if len(lines) < _HEADER_LINES or not lines[0].startswith("PathFileType"):
        raise _damaged(path, "no header of a TRC file", "five lines, the first beginning with PathFileType")
    header = dict(zip(_cells(lines[1]), _cells(lines[2]), strict=False))
    scale = _METRES.get(header.get("Units", "").lower())
    if scale is None:
        raise _damaged(path, f"Units {header.get('Units', '')!r}", "mm, cm or m")
    names = tuple(n for n in _cells(lines[3])[2:] if n)
    if not names or _count(path, header, "NumMarkers") != len(names):
        raise _damaged(path, f"{len(names)} names, NumMarkers {header.get('NumMarkers')}", "as many names as markers")
    rows = [(i, line) for i, line in enumerate(lines[_HEADER_LINES:], _HEADER_LINES + 1) if line.strip()]
    if not rows or _count(path, header, "NumFrames") != len(rows):
        raise _damaged(path, f"{len(rows)} rows, NumFrames {header.get('NumFrames')}", "a row for each frame")
    table = np.array([_numbers(path, i, line, 2 + 3 * len(names)) for i, line in rows])
    time_s, xyz = table[:, 1], scale * table[:, 2:].reshape(len(rows), len(names), 3)
    if not np.isfinite(time_s).all() or np.any(np.diff(time_s) <= 0):
        raise _damaged(path, "times that are missing, repeat or run backwards", "strictly increasing seconds")
    xyz[np.all(xyz == 0, axis=2)] = np.nan
    _check_unit(path, xyz, header["Units"])
    return Trc(time_s, names, xyz)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("\t")]


def _count(path: str | Path, header: dict[str, str], name: str) -> int:
    try:
        return int(float(header[name]))
    except (KeyError, ValueError, OverflowError) as error:
        raise _damaged(path, f"{name} {header.get(name, '')!r}", "a whole number") from error


def _numbers(path: str | Path, number: int, line: str, n_cells: int) -> np.ndarray:
    cells = _cells(line)
    if len(cells) < n_cells or any(cells[n_cells:]):
        raise _damaged(path, f"line {number}: {len(cells)} cells", f"{n_cells} cells between tabs")
    try:
        values = np.array([float(cell) if cell else np.nan for cell in cells[:n_cells]])
    except ValueError as error:
        raise _damaged(path, f"line {number}: {error}", "numbers, or empty cells where a marker is missing") from error
    if np.isinf(values).any():
        raise _damaged(path, f"line {number}: an infinite number", "finite numbers, or empty cells")
    return values


def _check_unit(path: str | Path, xyz_m: np.ndarray, unit: str) -> None:
    whole = xyz_m[np.sum(np.isfinite(xyz_m).all(axis=2), axis=1) >= 3]
    if not len(whole):
        return
    size = float(np.median(np.max(np.nanmax(whole, axis=1) - np.nanmin(whole, axis=1), axis=1)))
    if not _NARROWEST_M < size < _WIDEST_M:
        raise _damaged(
            path, f"markers that lie {size:.3g} m apart if Units {unit} is right", "the unit the numbers are in"
        )


def _damaged(path: str | Path, found: str, expected: str) -> PblError:
    return PblError(
        "FILE_FORMAT",
        found=found,
        expected=expected,
        next_step="export it again, tab-separated; docs/files.md, section markers of a laboratory, says what is read",
        key=str(path),
    )
