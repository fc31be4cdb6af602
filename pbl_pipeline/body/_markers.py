"""Marker sets: the observed points of the body, from tables of (name, body, x, y, z)."""

from __future__ import annotations

import csv
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.body.model import load_body
from pbl_pipeline.bounded import read_text
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import is_plain

_DATA = Path(__file__).parent / "data"
_COLUMNS = ("name", "body", "x", "y", "z")
#: Largest table of markers (bytes), about a thousand of them.
_LARGEST = 1 << 17

#: Names of the included marker sets.
MARKER_SETS: tuple[str, ...] = tuple(sorted(p.stem.removeprefix("markers_") for p in _DATA.glob("markers_*.csv")))
_format_error = functools.partial(
    PblError,
    "FILE_FORMAT",
    expected="CSV with name, body, x, y, z in metres",
    next_step="compare with pbl_pipeline/body/data/markers_blazepose_33.csv",
)


@dataclasses.dataclass(frozen=True, eq=False)
class MarkerSet:
    """J named points fixed to bodies."""

    name: str  # "blazepose_33" and so on; the stem of the file for a lab's own table
    #: J marker names (all different) and the body each is fixed to.
    names: tuple[str, ...]
    body_names: tuple[str, ...]
    body_index: np.ndarray  # (J,) int index into `Body.body_names`
    #: (J, 3) position on the unscaled body, in the body's frame (x forward, y up, z right), metres.
    position_m: np.ndarray
    #: (J,) weight of the point's 3D position, 0 (only its pixels count) to 1, a property of the detector;
    #: 1 unless the table has a column `weight_3d`.
    weight_3d: np.ndarray
    #: Other name -> name: how programs spell it that write such markers.
    also: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def check_names(self, names: Sequence[str]) -> None:
        """Raise `PblError` MARKER_SET_UNKNOWN unless `names` are this set's, in this order."""
        if tuple(names) == self.names:
            return
        missing = [n for n in self.names if n not in set(names)]
        extra = [n for n in names if n not in set(self.names)]
        found = f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(extra) or 'none'}"
        raise PblError(
            "MARKER_SET_UNKNOWN",
            found=found if missing or extra else "the names in another order",
            expected=f"the {len(self.names)} names of {self.name} in its order",
            next_step="rename or reorder the markers, or pass the marker set the file was made with",
            key=self.name,
        )


@functools.cache
def marker_set(name: str) -> MarkerSet:
    """Return an included marker set. Raises `PblError` MARKER_SET_UNKNOWN."""
    if name not in MARKER_SETS:
        raise PblError(
            "MARKER_SET_UNKNOWN",
            found=f"{name!r}",
            expected=f"one of {', '.join(MARKER_SETS)}",
            next_step="write the keypoints in one of these sets",
            key=name,
        )
    return load_marker_set(_DATA / f"markers_{name}.csv", name=name)


def load_marker_set(path: str | Path, name: str | None = None) -> MarkerSet:
    """Read a table of markers: CSV with the columns name, body, x, y, z in metres in the body's frame.

    The columns `weight_3d` (an empty cell means 1) and `also` (another name) are optional (`MarkerSet`). Lines that
    start with `#` are comments, other columns are ignored. `name` is the file's stem unless given.

    Raises `PblError` FILE_FORMAT: unreadable, a column missing, an invalid number, a name twice, a body the model
    lacks, no rows.
    """
    path = Path(path)
    known = load_body().body_names
    try:
        text = read_text(path, _LARGEST)
    except (OSError, ValueError) as error:
        raise _format_error(str(error), key=path) from error
    numbered = [(i, t) for i, t in enumerate(text.splitlines(), 1) if t.strip() and not t.lstrip().startswith("#")]
    table = csv.DictReader((t for _, t in numbered), skipinitialspace=True)
    absent = [c for c in _COLUMNS if c not in (table.fieldnames or ())]
    if absent:
        raise _format_error(f"no column {', '.join(absent)}", key=path)
    names: list[str] = []
    bodies: list[str] = []
    positions: list[list[float]] = []
    weights: list[float] = []
    also: dict[str, str] = {}
    for (number, _), row in zip(numbered[1:], table, strict=False):
        where = f"line {number}"
        marker, body = (row["name"] or "").strip(), (row["body"] or "").strip()
        if not marker or marker in names:
            raise _format_error(f"{where}: {'no name' if not marker else f'marker {marker} a second time'}", key=path)
        if not is_plain(marker):
            raise _format_error(f"{where}: a name with control characters", key=path)
        if body not in known:
            raise _format_error(f"{where}: body {body!r}", expected=f"one of {', '.join(known)}", key=path)
        try:
            position = [float(row[c]) for c in "xyz"]
            weight = float(row.get("weight_3d") or 1)
        except (TypeError, ValueError) as error:
            raise _format_error(f"{where}: {error}", key=path) from error
        # No point of a person is two metres from a body's origin: most often the table is in millimetres.
        if not np.all(np.isfinite(position)) or np.max(np.abs(position)) > 2:
            raise _format_error(f"{where}: position {position}", key=path)
        if not 0 <= weight <= 1:
            raise _format_error(f"{where}: weight_3d {weight}", expected="a number from 0 to 1", key=path)
        names.append(marker)
        bodies.append(body)
        positions.append(position)
        weights.append(weight)
        if other := (row.get("also") or "").strip():
            also[other] = marker
    if not names:
        raise _format_error("no markers", key=path)
    index = np.array([known.index(b) for b in bodies], np.int32)
    position_m, weight_3d = np.array(positions, np.float64), np.array(weights, np.float64)
    for array in (index, position_m, weight_3d):
        array.setflags(write=False)
    return MarkerSet(name or path.stem, tuple(names), tuple(bodies), index, position_m, weight_3d, also)
