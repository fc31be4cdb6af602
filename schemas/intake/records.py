"""The records of intake: what is to be registered, what was read of it, and what became of it."""

from __future__ import annotations

import dataclasses
import datetime
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_height, check_label, check_mass, is_plain

from ..session import UNLABELLED
from ..subject_codes import check_subject


@dataclasses.dataclass(frozen=True)
class Methods:
    """Names of the methods that a recording goes through; None takes the default of the library."""

    tracking: str | None = None
    subject: str | None = None
    keypoint: str | None = None
    fit: str | None = None
    gait: str | None = None
    gdi: str | None = None
    norm: str | None = None
    kinetics: str | None = None


@dataclasses.dataclass(frozen=True)
class VisitRecord:
    """What is stated of a recording and its visit. None: the subject's and the visit's columns are left as they are."""

    subject: str
    session_label: str = UNLABELLED
    project: str | None = None  # of a subject that is new
    camera_file: str | Path | None = None
    camera_motion: str | None = None  # None: handheld with the phone's log, static without
    activity: str | None = None  # None: walking
    person: int | None = None  # of the tracking; None: chosen automatically
    population: str | None = None
    pace: str | None = None  # None: unknown
    height_m: float | None = None
    date: datetime.date | None = None  # None: the day that the label names
    mass_kg: float | None = None  # of the person at the visit

    def check(self, key: object = None) -> None:
        """Raise `PblError` USAGE for a code that could be a name or a label too long; FIT_INPUT for height or mass."""
        check_subject(self.subject, "pass such a code with --subject", key)
        for what, text, longest in (
            ("visit", self.session_label, 64),
            ("project", self.project, 32),
            ("activity", self.activity, 32),
            ("pace", self.pace, 32),
            ("population", self.population, 32),
        ):
            check_label(what, text or "", longest)
        check_height(self.height_m)
        check_mass(self.mass_kg)

    def text(self) -> str:
        """Return subject and session in words."""
        return f"subject {self.subject}, session {self.session_label}"


@dataclasses.dataclass(frozen=True)
class Registered:
    """The outcome for one file."""

    path: Path
    status: str  # registered, known (nothing changed), moved (path updated), updated (something was added), refused
    video_id: int | None = None
    note: str = ""  # the status in words
    error: PblError | None = None


@dataclasses.dataclass(frozen=True)
class File:
    """A file with the SHA-256 of its bytes and its length (bytes); camera: the row of its calibration."""

    path: Path
    sha256: str
    size: int
    camera: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, path: Path) -> File:
        """Read the bytes of a file. Raises `PblError` VIDEO_MISSING, VIDEO_EMPTY; USAGE for a path that no row can
        hold."""
        from pbl_pipeline.video import sha256_of

        if not os.path.isfile(path):  # not Path.is_file: that raises where a folder on the way may not be entered
            raise _no_video("VIDEO_MISSING", "it is not a file" if os.path.exists(path) else "no such file", path)
        check_path(path)
        if not path.stat().st_size:
            raise _no_video("VIDEO_EMPTY", "0 bytes", path)
        return cls(path, sha256_of(path), path.stat().st_size)


class Recording:
    """A recording that is to be registered: `OneCamera`, `SeveralCameras` or `LaboratoryMarkers`.

    `register` calls the methods in the order in which they stand here. One that does not apply to a kind does nothing.
    """

    visit: VisitRecord
    files: tuple[File, ...] = ()  # what `read` read
    markers: ClassVar[bool] = False  # whether it goes straight to the fit, without tracking and keypoints

    @property
    def paths(self) -> tuple[Path, ...]:
        """Its files, absolute."""
        raise NotImplementedError

    @property
    def motion(self) -> str:
        """Value of camera_motion in Video."""
        raise NotImplementedError

    def check(self, methods: Methods) -> None:
        """Raise what `VisitRecord.check` raises; `PblError` USAGE for what does not apply to this kind of recording."""
        self.visit.check()

    def read(self) -> None:
        """Read its files, without a look at the tables. Raises `PblError`, or `RefusedFile` where one of them cannot be
        registered, and the others with it."""
        raise NotImplementedError

    def check_known(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Raise `PblError` USAGE where its files are registered (`rows` of Video) as something else."""

    def update(self, row: Mapping[str, Any]) -> list[str]:
        """Add to a registered file (its row of Video) what is new of its kind; returns the changes in words."""
        return []

    def complete(self, chosen: Mapping[str, str]) -> None:
        """Read what only a new recording needs; `chosen`: keys of its methods. Raises `PblError`."""

    def check_session(self, session_id: int) -> None:
        """Raise `PblError` USAGE where it cannot be fitted together with what the session has."""

    def insert(self, numbers: Sequence[int]) -> list[str]:
        """Insert its rows beside those of Video, in a transaction; returns a note on each file."""
        return [""] * len(numbers)


class RefusedFile(Exception):
    """One of the files of a recording cannot be registered, and the others with it."""

    def __init__(self, path: Path, error: PblError) -> None:
        super().__init__(str(error))
        self.path, self.error = path, error

    def error_of(self, path: Path) -> PblError:
        """Return the error to report of a file of the recording."""
        if path == self.path:
            return self.error
        return usage(
            f"{path.name} with {self.path.name}, which is refused ({self.error.code})",
            "all videos of the trial",
            path,
            "correct that one, then register the trial again",
        )


def check_path(path: Path) -> None:
    """Raise `PblError` USAGE for a path that cannot be kept in a row."""
    if not is_plain(str(path)):
        raise usage(
            "a path with line breaks, other control characters, or bytes that are not UTF-8",
            "a path of ordinary characters",
            ascii(str(path)),
            "rename the file or folder",
        )
    if len(str(path)) > 1000:
        found = f"a path of {len(str(path))} characters"
        raise usage(found, "at most 1000", path, "move the file to a shorter path")


def _no_video(code: str, found: str, path: Path) -> PblError:
    next_step = "check the path" if code == "VIDEO_MISSING" else "copy it from the phone again"
    return PblError(code, found=found, expected="a video file", next_step=next_step, key=path)


def usage(found: str, expected: str, key: object = None, next_step: str = "see `pbl ingest --help`") -> PblError:
    """Return a `PblError` USAGE about a registration."""
    return PblError("USAGE", found=found, expected=expected, next_step=next_step, key=key)
