"""Recordings of laboratory markers (`pbl ingest --markers`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pbl_pipeline import methods as library_methods
from pbl_pipeline.files import sha256_of
from pbl_pipeline.names import check_label
from pbl_pipeline.temporary import new_folder

from .. import fit, video
from ..method_rows import method_row
from .records import File, Methods, Recording, VisitRecord, check_path, usage

if TYPE_CHECKING:
    from pbl_pipeline.body import MarkerSet
    from pbl_pipeline.fit import MarkerFile


@dataclasses.dataclass
class LaboratoryMarkers(Recording):
    """A file of laboratory markers (`.trc`, or the `.npz` of docs/files.md).

    It is read when it is registered and a copy, in metres with z up, is kept in the store: the file itself is not
    needed again. The markers of a session are fitted together, never with a video.
    """

    path: Path
    visit: VisitRecord
    marker_set: str | None = None  # name of a shipped set, or path of a custom table (.csv); needed for .trc
    up: str = "y"  # vertical axis of .trc files, "y" or "z"
    markers: ClassVar[bool] = True
    motion: ClassVar[str] = video.NO_CAMERA  # type: ignore[misc]
    found: MarkerFile = dataclasses.field(init=False)
    about: dict[str, str] = dataclasses.field(default_factory=dict, init=False)  # which set: columns of MarkerRecording
    in_view_share: float = dataclasses.field(default=np.nan, init=False)
    turned: str = dataclasses.field(default="", init=False)  # a note where the vertical is another axis

    @property
    def paths(self) -> tuple[Path, ...]:
        return (Path(self.path).absolute(),)

    def check(self, methods: Methods) -> None:
        """Raise what `Recording.check` raises; MARKER_SET_UNKNOWN, FILE_FORMAT for the marker set."""
        super().check(methods)
        stated = self.visit
        if stated.camera_file is not None or stated.camera_motion is not None or stated.person is not None:
            found = "a camera or a person's number for markers"
            raise usage(found, "neither: markers are one person's, in the world")
        if methods.tracking or methods.keypoint or methods.subject:
            found = "a method of tracking or keypoints for markers"
            raise usage(found, "methods of the fit, of events and of the index")
        self._set()

    @property
    def _table(self) -> Path | None:
        """The file of a marker set of the laboratory's own."""
        name = self.marker_set
        return Path(name) if name is not None and name.lower().endswith(".csv") else None

    def _set(self) -> MarkerSet | None:
        from pbl_pipeline.body import load_marker_set, marker_set

        if self._table is not None:
            check_label("--marker-set", self._table.stem, 64)
            return load_marker_set(self._table)
        return None if self.marker_set is None else marker_set(self.marker_set)

    def read(self) -> None:
        """Read the markers. Raises `PblError` FILE_MISSING, FILE_FORMAT, MARKER_SET_UNKNOWN, USAGE."""
        from pbl_pipeline.fit import read_markers

        (path,) = self.paths
        check_path(path)
        self.found = read_markers(path, self._set(), self.up)
        self.files = (File.of(path),)
        self.about = {
            "recording_marker_set": self.found.markers.name,
            "marker_table_sha256": "" if self._table is None else sha256_of(self._table),
        }

    def check_known(self, rows: Sequence[Mapping[str, Any]]) -> None:
        number, path = int(rows[0]["video_id"]), self.files[0].path
        recorded = (video.MarkerRecording & {"video_id": number}).to_dicts()
        if not recorded:
            raise usage(
                f"bytes that are registered as a video, video_id {number}",
                "markers that are new, or registered as markers",
                next_step=f"delete video_id {number} from video.Video where it was registered by mistake",
                key=path,
            )
        if self._other_set(recorded[0]):
            raise usage(
                f"marker set {self.about['recording_marker_set']} for markers that are registered, video_id {number}",
                f"{recorded[0]['recording_marker_set']} as it was registered",
                next_step=f"delete video_id {number} from video.Video, then register it with the other set",
                key=path,
            )

    def _other_set(self, row: Mapping[str, Any]) -> bool:
        return any(row[name] != value for name, value in self.about.items())

    def complete(self, chosen: Mapping[str, str]) -> None:
        """Check that the chosen method can fit them. Raises `PblError` FIT_INPUT."""
        from pbl_pipeline.fit import check_trial

        method = library_methods.stored(**method_row(fit.FitMethod, chosen))
        checked = check_trial(self.found.trial, self.files[0].path.stem, method, self.found.markers)
        self.in_view_share = checked.whole_share
        if checked.world is not None and checked.world.axis:
            self.turned = f"; the body stands along {checked.world.axis} of the world as read: the fit turns it"

    def check_session(self, session_id: int) -> None:
        there = video.MarkerRecording * video.Video.proj("session_id") & {"session_id": session_id}
        for row in there.proj(*self.about).to_dicts():
            if self._other_set(row):  # one body is fitted to all
                raise usage(
                    f"marker set {self.about['recording_marker_set']} in a session with another, or another table of "
                    "that name",
                    f"{row['recording_marker_set']}, as video_id {row['video_id']} of the session",
                    next_step="register it with that set, or in a separate session",
                    key=self.files[0].path,
                )

    def insert(self, numbers: Sequence[int]) -> list[str]:
        trial = self.found.trial
        row = {
            "video_id": numbers[0],
            **self.about,
            "vertical_axis": self.up if self.files[0].path.suffix.lower() == ".trc" else "z",
            "recording_n_frames": len(trial.time_s),
            "recording_n_markers": int(np.sum(np.any(trial.confidence > 0, axis=0))),
            "recording_duration": float(trial.time_s[-1] - trial.time_s[0]),
            "recording_in_view_share": self.in_view_share,
        }
        with new_folder() as folder:
            trial.save(folder / "markers.npz")
            files = {"markers_file": folder / "markers.npz", "marker_table_file": self._table}
            video.MarkerRecording.insert1({**row, **files})
        unused = f"; not in the marker set: {', '.join(self.found.unused)}" if self.found.unused else ""
        return [self.found.text() + unused + self.turned]
