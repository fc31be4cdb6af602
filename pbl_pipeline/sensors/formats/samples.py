"""Samples of a sensor as a file holds them, and the tables that they are read from."""

from __future__ import annotations

import collections
import csv
import dataclasses
import functools
import io
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import bounded
from pbl_pipeline.errors import PblError, os_errors_as

if TYPE_CHECKING:
    import pandas as pd

#: Bytes of a log, unpacked: six sensors in one file at 128 Hz for 20 minutes.
MAX_LOG = 4 * bounded.MAX_TEXT

_NEXT = "export it again as docs/imu.md says, or leave this sensor out"
log_error = functools.partial(PblError, "SENSOR_LOG", next_step=_NEXT)
unknown_error = functools.partial(PblError, "FILE_FORMAT", next_step=_NEXT)


@dataclasses.dataclass(frozen=True)
class Samples:
    """Samples of one sensor in a file: N rows in SI units and in the axes of the sensor, NaN where a cell is empty.

    Sensors with the same `clock` are synchronous; the stamps of "UTC" are seconds since 1970, others begin at 0 again
    after `wraps_s`, where that is known. A `counter` counts
    samples, of which the file states `stated_hz` a second. `orientation` (quaternions, scalar first) is from the sensor
    to a world whose z points up, as the program's documents say; `checked` compares it with the accelerations.
    """

    name: str
    clock: str
    stamp: np.ndarray  # (N,) s
    rate: np.ndarray | None = None  # (N, 3) rad/s
    acceleration: np.ndarray | None = None  # (N, 3) m/s2
    orientation: np.ndarray | None = None  # (N, 4)
    start_utc: float | None = None  # s since 1970 at stamp 0
    counter: np.ndarray | None = None  # (N,)
    stated_hz: float | None = None
    wraps_s: float | None = None
    mounting: np.ndarray | None = None  # (4,) of `SensorLog`


@dataclasses.dataclass(frozen=True)
class LogFile:
    """A file to read. `text` is empty for a folder or an archive; `rate_hz` is the rate that a person states, `called`
    the name of the file of which this one is a copy."""

    path: Path
    text: str
    rate_hz: float | None = None
    called: str | None = None

    @property
    def stem(self) -> str:
        """Name of the file without its suffixes."""
        name = self.called or self.path.name
        return name.removesuffix(".gz").rpartition(".")[0] or name

    def refuse(self, found: str, expected: str) -> PblError:
        """The error SENSOR_LOG about this file."""
        return log_error(found, expected, key=self.called or self.path)


@dataclasses.dataclass(frozen=True)
class Format:
    """A format of logs: its name, whether a file is of it, and the sensors in one. `reads` raises `PblError`."""

    name: str
    knows: Callable[[LogFile], bool]
    reads: Callable[[LogFile], Sequence[Samples]]


def opened(path: Path, rate_hz: float | None = None, called: str | None = None) -> LogFile:
    """Read the text of a log. Raises `PblError` FILE_MISSING, FILE_FORMAT (no text, or too long)."""
    if path.is_dir() or path.suffix.lower() == ".zip":
        return LogFile(path, "", rate_hz, called)
    name = called or path
    with os_errors_as("FILE_MISSING", "the log of a wearable sensor", "check the path", path):
        try:
            text = bounded.read_text(path, MAX_LOG)
        except ValueError as error:
            raise unknown_error(f"no text to read ({error})", "a log as docs/imu.md says", key=name) from error
    if not text.strip():
        raise unknown_error("an empty file", "a log as docs/imu.md says", key=name)
    return LogFile(path, text, rate_hz, called)


def table(file: LogFile, header: int, separator: str = ",", skip: Sequence[int] = ()) -> pd.DataFrame:
    """The table of a file whose line `header` has the names of its columns, without the lines `skip`; cells are texts.

    Raises `PblError` SENSOR_LOG.
    """
    import pandas as pd

    expected = "rows with a cell for each name in the header"
    try:
        line = next(itertools.islice(io.StringIO(file.text), header, None), "")
        names = [name.strip() for name in next(csv.reader([line], delimiter=separator), [])]
        rows = file.text.count("\n")
        bounded.count_rows(rows)
        bounded.count_cells(len(names), len(names))
        if rows * len(names) > len(file.text):
            raise ValueError("most rows have fewer cells")
        found = pd.read_csv(
            io.StringIO(file.text),
            sep=separator,
            header=None,
            names=[*range(len(names) + 1)],  # one more: cells beyond the last name
            skiprows=[*range(header + 1), *skip],
            index_col=False,
            dtype=str,
            comment="#",
        )
    except (ValueError, csv.Error) as error:
        raise file.refuse(f"no table ({error})", expected) from error
    if twice := [name for name, n in collections.Counter(names).items() if name and n > 1]:
        raise file.refuse(f"the column {twice[0]} twice", "each column once")
    if found.pop(len(names)).notna().any():
        raise file.refuse("rows with more cells than names", expected)
    found.columns = names
    return found


def numbers(file: LogFile, found: pd.DataFrame, names: Sequence[str]) -> np.ndarray | None:
    """Columns (N, K) of a table, or (N,) where `names` is one; None where one is absent or all cells are empty.

    Raises `PblError` SENSOR_LOG for a cell that is not a number.
    """
    from pandas import to_numeric

    wanted = [names] if isinstance(names, str) else list(names)
    if not set(wanted) <= set(found.columns):
        return None
    try:
        values = np.column_stack([np.asarray(to_numeric(found[n].str.strip()), float) for n in wanted])
    except (ValueError, TypeError) as error:
        raise file.refuse(f"columns {', '.join(wanted)}: {error}", "a number in each cell, or none") from error
    if np.isnan(values).all():
        return None
    return values[:, 0] if isinstance(names, str) else values


def counted_on(values: np.ndarray, wraps_at: float) -> np.ndarray:
    """A counter (N,) that goes on where it began at 0 again."""
    back = np.diff(values, prepend=values[:1]) < -wraps_at / 2
    return values + wraps_at * np.cumsum(back)


def quaternions(matrices: np.ndarray | None = None, euler_deg: np.ndarray | None = None) -> np.ndarray | None:
    """Quaternions (N, 4), scalar first, of rotation matrices (N, 9) by rows, or of roll, pitch and yaw (N, 3) in deg
    about x, y and z: R = Rz Ry Rx. NaN where a value is, or where a matrix is not a rotation."""
    values = matrices if matrices is not None else euler_deg
    if values is None:
        return None
    known = np.isfinite(values).all(axis=1)
    if matrices is not None:
        m = values.reshape(-1, 3, 3)
        off = np.abs(m @ m.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        known &= (off < 0.02) & (np.linalg.det(np.nan_to_num(m)) > 0)
        turns = Rotation.from_matrix(m[known]) if known.any() else None
    else:
        turns = Rotation.from_euler("ZYX", values[known][:, ::-1], degrees=True) if known.any() else None
    out = np.full((len(values), 4), np.nan)
    if turns is not None:
        out[known] = turns.as_quat(scalar_first=True)
    return out
