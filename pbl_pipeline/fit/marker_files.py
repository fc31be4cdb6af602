"""A laboratory's file as a trial: its markers in the order of the marker set that says where they sit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pbl_pipeline.body import MarkerSet, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import WorldMarkers


@dataclasses.dataclass(frozen=True)
class MarkerFile:
    """Markers of a file: `trial` has all names of `markers`, `in_file` the names that the file has."""

    trial: WorldMarkers
    markers: MarkerSet
    in_file: tuple[str, ...]

    @property
    def absent(self) -> tuple[str, ...]:
        """Names of the marker set that the file lacks, sorted."""
        return tuple(sorted(set(self.markers.names) - set(self.in_file)))

    @property
    def unused(self) -> tuple[str, ...]:
        """Names in the file that the marker set lacks, sorted."""
        return tuple(sorted(set(self.in_file) - set(self.markers.names)))

    def text(self) -> str:
        """Number of the set's markers in the file, such as "40 of 41 markers of our_lab"."""
        n = len(self.markers)
        return f"{n - len(self.absent)} of {n} markers of {self.markers.name}"


def read_markers(path: Path, table: MarkerSet | None = None, up: str = "y") -> MarkerFile:
    """Read markers of a laboratory: `.trc` (vertical axis `up`), else the `.npz` of docs/files.md.

    `table` says where the markers sit; None takes the shipped set that an `.npz` names. Markers are looked up by name,
    then by the other name that the set knows (`MarkerSet.also`).

    Raises `PblError` FILE_MISSING, FILE_FORMAT; USAGE for a `.trc` without a table; MARKER_SET_UNKNOWN where no name is
    the set's.
    """
    if path.suffix.lower() == ".trc":
        if table is None:
            raise PblError(
                "USAGE",
                found=f"{path.name} without --marker-set",
                expected="the marker set that says where on the body each marker sits",
                next_step="pass --marker-set with a name or a table (CSV: name, body, x, y, z); see docs/files.md",
                key=str(path),
            )
        seen = WorldMarkers.from_trc(path, table.name, up)
    else:
        seen = WorldMarkers.load(path)
    wanted = table or marker_set(seen.marker_set)
    own = {n: wanted.also[n] for n in seen.names if wanted.also.get(n, n) not in seen.names}
    seen = dataclasses.replace(seen, names=tuple(own.get(n, n) for n in seen.names))
    return MarkerFile(seen.select(wanted.names, wanted.name), wanted, seen.names)
