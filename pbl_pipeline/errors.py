"""Errors a person can act on: a code, what was expected and found, and the next step.

`CODES` is the whole list; `docs/errors.md` explains each, and a test fails when the two differ.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import PurePath
from typing import NamedTuple
from unicodedata import category

#: Where the cause of an error lies: in what was given, which the same bytes will always meet (final); in this machine,
#: its services or this program, so the same may go well later; in what a person asked for or has to decide.
INPUT, MACHINE, CALL = "input", "machine", "call"


class Code(NamedTuple):
    """Meaning of an error code, and where its cause lies."""

    cause: str
    meaning: str


#: The code is what a lab searches for and what an error row stores.
CODES: dict[str, Code] = {
    "VIDEO_MISSING": Code(MACHINE, "the video file does not exist or cannot be opened"),
    "VIDEO_EMPTY": Code(INPUT, "the video file has no bytes"),
    "VIDEO_NOT_A_VIDEO": Code(INPUT, "no decoder recognises the file, or it holds no video stream"),
    "VIDEO_NO_FRAMES": Code(INPUT, "the container opens but not one frame decodes"),
    "VIDEO_TRUNCATED": Code(INPUT, "decoding breaks off before the end the container announces"),
    "VIDEO_DAMAGED": Code(INPUT, "frames inside the recording do not decode cleanly, or the picture size changes"),
    "VIDEO_TIMESTAMPS": Code(INPUT, "the frames carry no usable time stamps"),
    "VIDEO_TOO_LARGE": Code(INPUT, "the pictures of the video are larger than are decoded here"),
    "VIDEO_SCREEN": Code(INPUT, "the video is the recording of a screen, or a copy with borders around the picture"),
    "VIDEO_PIXELS": Code(INPUT, "the pixels of the video are not square, or its pictures are interlaced"),
    "VIDEO_UPSIDE_DOWN": Code(INPUT, "the people in the video are upside down"),
    "VIDEO_CHANGED": Code(INPUT, "the file's bytes are no longer those that were registered"),
    "VIDEO_DUPLICATE": Code(
        INPUT, "the same bytes are registered for another person, or, from a phone, in another visit"
    ),
    "UPLOAD_REFUSED": Code(CALL, "what was uploaded is not a recording that may be taken over"),
    "PHONE_LINK": Code(CALL, "a link for filming is unknown, ended, or belongs to another phone"),
    "TRACK_NO_PERSON": Code(INPUT, "no person was found in the video"),
    "TRACK_TOO_SHORT": Code(INPUT, "the person is in view for less than the shortest time that can be fitted"),
    "SUBJECT_NEEDS_CHOICE": Code(CALL, "several people, none clearly the subject: a person has to choose"),
    "SUBJECT_UNKNOWN_PERSON": Code(CALL, "the chosen person number is not among the tracks of the video"),
    "HEAD_NOT_FOUND": Code(INPUT, "no head was found in a video that was to be de-identified"),
    "ASSET_MISSING": Code(MACHINE, "a model or demo file is absent and could not be fetched"),
    "ASSET_CHECKSUM": Code(MACHINE, "a fetched file is not the pinned one (SHA-256 differs)"),
    "MODEL_MISSING": Code(
        MACHINE, "a keypoint model that was named is not registered here, or its files are not there"
    ),
    "MODEL_INVALID": Code(INPUT, "a keypoint model is not what its model.json says, or cannot be loaded"),
    "MODEL_CHECKSUM": Code(
        INPUT, "a keypoint model has other bytes than its model.json, its method or its publisher names"
    ),
    "DEVICE_UNAVAILABLE": Code(MACHINE, "the device that was asked for does not compute on this machine"),
    "FILE_MISSING": Code(MACHINE, "a file that was named does not exist or cannot be read"),
    "FILE_UNWRITABLE": Code(MACHINE, "a result cannot be written where it was asked for"),
    "FILE_FORMAT": Code(INPUT, "a file lacks a field, or a field has another shape, unit or type than its format says"),
    "MARKER_SET_UNKNOWN": Code(CALL, "the body has no marker set of that name, or the names differ"),
    "CAMERA_INVALID": Code(INPUT, "the camera matrix or distortion is not usable"),
    "CALIBRATION_NO_BOARD": Code(INPUT, "the board is not found in the calibration video"),
    "CALIBRATION_FEW_VIEWS": Code(INPUT, "the board is seen in too few usable pictures"),
    "CALIBRATION_POOR": Code(INPUT, "the views of the board do not determine the lens"),
    "PHONE_LOG": Code(INPUT, "the orientation log of the phone is not usable"),
    "FIT_INPUT": Code(INPUT, "the keypoints cannot be fitted: too few frames, time stamps out of order, nothing seen"),
    "VIEWS_DISAGREE": Code(INPUT, "the cameras of a trial do not see one person where the calibration says"),
    "AUGMENTER_INPUT": Code(INPUT, "the points do not suffice to predict anatomical markers"),
    "FIT_DIVERGED": Code(
        INPUT, "the optimisation ended in values that are not finite, or lengths that are not positive"
    ),
    "SOLVER_UNKNOWN": Code(CALL, "no solver or paramset has that name"),
    "GAIT_INPUT": Code(INPUT, "the trajectories cannot be searched for gait events"),
    "EVENTS_IMPLAUSIBLE": Code(CALL, "gait events that were set by hand cannot be those of walking"),
    "REFERENCE_INPUT": Code(INPUT, "fit and reference cannot be compared: no common time, joint or frames"),
    "ANGLE_UNITS": Code(INPUT, "joint angles are not in degrees"),
    "NORM_UNKNOWN": Code(CALL, "no normative set has that name"),
    "NORM_INVALID": Code(INPUT, "the normative data cannot support the index (too few cycles, wrong size)"),
    "EXPORT_INPUT": Code(INPUT, "the fit cannot be exported in that form"),
    "PYTHON_UNSUPPORTED": Code(MACHINE, "this Python is too old, or has 32 bits"),
    "PACKAGE_MISSING": Code(MACHINE, "a package that this step needs is not installed"),
    "STATS_INPUT": Code(
        INPUT, "the values do not support the statistic: too few, missing, without variation, or of another shape"
    ),
    "STUDY_INVALID": Code(INPUT, "the parts of a study contradict each other, or one lacks what it must have"),
    "SHEET_FORMAT": Code(INPUT, "a sheet has columns or cells that cannot be read"),
    "SHEET_CONFLICT": Code(INPUT, "rows of a sheet contradict each other, or what is registered"),
    "SCORE_RANGE": Code(INPUT, "a clinical score has a value that its instrument cannot have"),
    "DB_NOT_RUNNING": Code(MACHINE, "the database does not answer"),
    "DB_UNAVAILABLE": Code(MACHINE, "no database server can be obtained on this machine"),
    "DB_REFUSED": Code(MACHINE, "the database answers but refuses the login or the operation"),
    "DB_NOT_FOUND": Code(CALL, "a row that was named does not exist"),
    "DB_MIGRATION": Code(MACHINE, "the tables on the server are not as this version of the code declares them"),
    "INPUT_CHANGED": Code(MACHINE, "rows that a computation reads are gone, or changed each time it ran"),
    "STORE_UNAVAILABLE": Code(MACHINE, "the object store of the arrays cannot be reached, or refuses"),
    "STORE_FULL": Code(MACHINE, "the store of the arrays has no room left"),
    "BACKUP_INVALID": Code(INPUT, "a backup is incomplete or was changed"),
    "TIME_LIMIT": Code(MACHINE, "a job took longer than a worker gives it and was ended"),
    "WORKER_CRASH": Code(MACHINE, "a job took its worker's process down more than once"),
    "MACHINE_SHORT": Code(
        MACHINE, "this machine was short of time or memory, or a process was ended: nothing is said about the file"
    ),
    "DECIDED_MEANWHILE": Code(CALL, "another person decided, or it was computed again, since the page was loaded"),
    "WEB_NOT_MADE": Code(MACHINE, "a file that the review page was making was not finished"),
    "WEB_REFUSED": Code(
        CALL, "a request to the review page may not be answered: no session, no right, or a form of another page"
    ),
    "WEB_PORT": Code(MACHINE, "the review page cannot listen on that port"),
    "WEB_TLS": Code(MACHINE, "the review page would be reached without encryption, or its certificate cannot be used"),
    "WEB_ACCOUNT": Code(CALL, "an account of the review page is not there, or cannot be as it was asked for"),
    "USAGE": Code(CALL, "the command was called in a way that cannot work"),
    "INTERNAL": Code(MACHINE, "an unforeseen error: please report it with the whole text"),
}


class PblError(Exception):
    """A coded error.

    Parameters
    ----------
    code
        One of `CODES`.
    found
        The facts, concretely ("the file holds 0 bytes").
    expected
        The valid input ("an MP4, MOV or WebM video").
    next_step
        The reader's remedy ("copy the file from the phone again").
    key
        The object at fault: a path (kept as text), a table key, a frame.

    A module whose errors have parts in common makes them by `functools.partial(PblError, code, next_step=...)`.
    """

    def __init__(self, code: str, found: str, expected: str, next_step: str, key: object = None) -> None:
        if code not in CODES:
            raise ValueError(f"unknown error code {code!r}: add it to pbl_pipeline.errors.CODES")
        self.code, self.found, self.expected, self.next_step = code, found, expected, next_step
        self.key = str(key) if isinstance(key, PurePath) else key
        super().__init__(self.text())

    @property
    def final(self) -> bool:
        """True if the input itself is at fault, so that the same bytes are refused again."""
        return CODES[self.code].cause == INPUT

    def text(self) -> str:
        """One line per part; the form stored in error rows and printed on stderr."""
        lines = [f"{self.code}: {CODES[self.code].meaning}"]
        if self.key is not None:
            lines.append(f"  about:    {harmless(str(self.key), lines=False)}")
        lines.append(f"  found:    {harmless(self.found)}")
        lines += [f"  expected: {self.expected}", f"  next:     {self.next_step}"]
        return "\n".join(lines)

    def short(self) -> str:
        """Return code and `found` on one line, as the reason that a result is missing."""
        return f"{self.code}: {harmless(self.found, lines=False)}"

    def about(self, key: object) -> PblError:
        """Return this error, about `key` unless it already has a key: a reader of several files names the one."""
        return self if self.key is not None else self.with_key(key)

    def with_key(self, key: object) -> PblError:
        """Return the same error about something else, such as the name of a file before it was copied."""
        return PblError(self.code, self.found, self.expected, self.next_step, key)

    def __reduce__(self):
        return PblError, (self.code, self.found, self.expected, self.next_step, self.key)


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the errors that it came from, each once: their chain may be a circle."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


#: Functions that return the coded error for an exception of a package that the library does not know, else None; rooms
#: above the library add theirs.
CODERS: list[Callable[[BaseException], PblError | None]] = []
#: Called where a person interrupts a command.
INTERRUPTS: list[Callable[[], None]] = []


@contextlib.contextmanager
def os_errors_as(code: str, expected: str, next_step: str, key: object = None) -> Iterator[None]:
    """Raise an OSError of the block as a `PblError`; `found` is the system's message."""
    try:
        yield
    except OSError as error:
        raise PblError(code, error.strerror or str(error), expected, next_step, key) from error


def unread_file(error: Exception, expected: str, next_step: str, key: object) -> PblError:
    """The error for a file that could not be read: FILE_MISSING where it is absent or barred, else FILE_FORMAT."""
    absent = isinstance(error, FileNotFoundError | IsADirectoryError | NotADirectoryError | PermissionError)
    return PblError(
        "FILE_MISSING" if absent else "FILE_FORMAT",
        found=f"{type(error).__name__}: {error}",
        expected=expected,
        next_step="check the path" if absent else next_step,
        key=str(key),
    )


def harmless(text: str, lines: bool = True) -> str:
    """Text with control characters escaped: a name from outside must not move the reader's cursor, nor (without
    `lines`) begin a line that looks like ours."""
    kept = "\n" if lines else ""
    # Control, format (direction of writing), lone surrogates (undecoded bytes), separators of lines, paragraphs.
    odd = ("Cc", "Cf", "Cs", "Zl", "Zp")
    return "".join(c.encode("unicode_escape").decode() if category(c) in odd and c not in kept else c for c in text)
