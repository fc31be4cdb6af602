"""Errors a person can act on: a code, what was expected and found, and the next step.

`CODES` are the library's; packages above it and laboratories `register` theirs. `docs/errors.md` lists each of ours,
and a test fails when the two differ.
"""

from __future__ import annotations

import contextlib
import string
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import PurePath
from typing import Any, NamedTuple
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
    "SENSOR_LOG": Code(INPUT, "the log of a wearable sensor is not usable"),
    "DEPTH_FILE": Code(INPUT, "the depth recording is not usable"),
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
    "MACHINE_SHORT": Code(
        MACHINE, "this machine was short of time or memory, or a process was ended: nothing is said about the file"
    ),
    "USAGE": Code(CALL, "the command was called in a way that cannot work"),
    "INTERNAL": Code(MACHINE, "an unforeseen error: please report it with the whole text"),
}


def register(codes: Mapping[str, Code]) -> None:
    """Add the codes of another package, such as `{"PLATE_SATURATED": Code(INPUT, "a force plate was overloaded")}`.

    Raises ValueError for a code that has another meaning already.
    """
    if taken := [name for name, code in codes.items() if CODES.get(name, code) != code]:
        raise ValueError(f"error codes with another meaning: {', '.join(taken)}")
    CODES.update(codes)


class Said(str):
    """An English text made by `said`, with its template and the values in it, by which it is said in a language."""

    template: str
    values: dict[str, Any]

    def __reduce__(self) -> tuple[Any, ...]:
        return _said, (self.template, self.values)

    def data(self) -> dict[str, Any]:
        """Return template and values for JSON, which `said_of` reads."""
        return {"says": self.template, "of": {k: _data(v) for k, v in self.values.items()}}


def said(template: str, /, **values: Any) -> Said:
    """Fill the places of a text, such as "{seconds:.1f} s", with numbers, names, and words that are texts of `said`
    themselves: names stay as they are in every language."""
    plain = {k: v.item() if hasattr(v, "item") else v for k, v in values.items()}
    number = int, float, Said
    return _said(template, {k: v if isinstance(v, number) else harmless(str(v), lines=False) for k, v in plain.items()})


def _said(template: str, values: dict[str, Any], text: str | None = None) -> Said:
    made = Said(template.format(**values) if text is None else text)
    made.template, made.values = template, values
    return made


def as_said(text: str) -> Said:
    """Return a text of the library, which a page finds in its catalogue, for a place of another; not for a name."""
    return text if isinstance(text, Said) else said(text.replace("{", "{{").replace("}", "}}"))


def joined(texts: Iterable[str], between: str = ", ") -> Said:
    """Join texts of the library; empty ones are left out."""
    parts = {f"part{i}": as_said(text) for i, text in enumerate(filter(None, texts))}
    return said(between.join(f"{{{name}}}" for name in parts), **parts)


def said_of(data: Any) -> str:
    """Return the text that `Said.data` or a text became in JSON; of anything else its text."""
    with contextlib.suppress(AttributeError, IndexError, KeyError, TypeError, ValueError):
        places = [name for _, name, _, _ in string.Formatter().parse(data["says"]) if name is not None]
        if all(map(str.isidentifier, places)):
            return _said(data["says"], {k: said_of(v) if isinstance(v, dict) else v for k, v in data["of"].items()})
    return str(data)


def _data(value: Any) -> Any:
    return value.data() if isinstance(value, Said) else value


class PblError(Exception):
    """A coded error.

    Parameters
    ----------
    code
        One of `CODES`.
    found
        The facts, concretely ("the file holds 0 bytes"); with values in it a text of `said`, for pages in any language.
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
            raise ValueError(f"unknown error code {code!r}: `pbl_pipeline.errors.register` adds it")
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
        """Return code and `found` on one line, as the reason that a result is missing; a page leaves the code out."""
        text = f"{self.code}: {harmless(self.found, lines=False)}"
        return _said(self.found.template, self.found.values, text) if isinstance(self.found, Said) else text

    def data(self) -> dict[str, Any]:
        """Return the parts for JSON, each a text or `Said.data`; `said_of` reads one."""
        parts = {"found": self.found, "expected": self.expected, "next_step": self.next_step}
        data = {name: _data(text if isinstance(text, Said) else harmless(text)) for name, text in parts.items()}
        return data if self.key is None else data | {"key": harmless(str(self.key), lines=False)}

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


@contextlib.contextmanager
def suppress_codes(*codes: str) -> Iterator[None]:
    """End the block where it raises a `PblError` of one of these codes, as `contextlib.suppress` does."""
    try:
        yield
    except PblError as error:
        if error.code not in codes:
            raise


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
