"""Recordings of a gait laboratory (C3D): the angles of its marker model, its event labels, its markers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.assumptions import Origin
from pbl_pipeline.bounded import MIB, read_bytes
from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import EMPTY, PASS
from pbl_pipeline.results.events import GaitEvent, GaitEvents

from ._angles import AngleSeries, check_ranges
from .c3d_file import C3dFile
from .events import METHODS, check_preconditions, detect_events, load_events, no_events
from .motion import FootTrajectories, check_feet, feet_from_markers
from .normative import PLUG_IN_GAIT, check_degrees

#: Of a recording, unpacked (bytes).
_LARGEST = 96 * MIB
#: Our angle -> the marker model's point after L or R, and its component. Both count the same directions as positive.
PLUG_IN_GAIT_POINTS: dict[str, tuple[str, int]] = {
    "pelvis_tilt": ("PelvisAngles", 0),
    "pelvis_obliquity": ("PelvisAngles", 1),
    "pelvis_rotation": ("PelvisAngles", 2),
    "hip_flexion": ("HipAngles", 0),
    "hip_adduction": ("HipAngles", 1),
    "hip_rotation": ("HipAngles", 2),
    "knee_flexion": ("KneeAngles", 0),
    "ankle_dorsiflexion": ("AnkleAngles", 0),
    "foot_progression": ("FootProgressAngles", 2),
}
#: Markers that events are found from where the recording has no labels, and that tell lengths.
_FOOT_MARKERS = ("LASI", "RASI", "LHEE", "RHEE", "LTOE", "RTOE")
#: Markers that the event model knows the legs by as well, where they are there.
_LEG_MARKERS = ("LPSI", "RPSI", "SACR", "LKNE", "RKNE", "LANK", "RANK")
_format_error = functools.partial(
    PblError,
    "FILE_FORMAT",
    next_step="export the recording with the angles of the laboratory's model, see docs/files.md",
)
_damaged = functools.partial(PblError, "FILE_FORMAT", next_step="export the recording again, see docs/files.md")


@dataclasses.dataclass(frozen=True)
class LabTrial:
    """One recording: `series` of angles per side (degrees), `events`, and `feet` where markers or coordinates place
    them on the floor (metres). `no_width`: why they do not tell the step width."""

    name: str
    series: AngleSeries
    events: GaitEvents
    feet: FootTrajectories | None
    no_width: str = ""


def read_lab_trial(
    path: str | Path, events_csv: str | Path | None = None, method: Any = None, person: str | None = None
) -> LabTrial:
    """Angles, events and feet of a C3D file (also gzipped) with the outputs of Plug-in Gait or a model of its kind.

    The angles are the points LHipAngles and so on (`PLUG_IN_GAIT_POINTS`). Events: those of `events_csv`
    (`pbl events`), else the recording's labels (`C3dFile.events`), else found from the markers of the legs by
    `method` (`detect_events`). Whatever their source, there are none if the markers show a person who lies or walks
    backwards, or a world whose vertical is not z. A missing sample is NaN (`C3dFile.points`). `person`: whose points
    (their prefix) and events (their subject) are read, where the file has several persons. The check
    `input_assumptions` lists what was assumed and left out.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (not a C3D, a point is missing or there twice), ANGLE_UNITS (not
    degrees), GAIT_INPUT (neither labels nor foot markers; markers upside down or mirrored; several persons).
    """
    path = Path(path)
    angle_points = [s + p for p, _ in PLUG_IN_GAIT_POINTS.values() for s in "LR"]
    points, labels, time, table = _read(path, [*angle_points, *_FOOT_MARKERS, *_LEG_MARKERS], person)
    column = {name: i for i, name in enumerate(labels)}
    missing = [p for p in angle_points if p not in column]
    if missing:
        raise _format_error(f"no points {', '.join(dict.fromkeys(missing))}", "the angles of Plug-in Gait", key=path)
    angles = {
        letter: {name: points[:, column[letter + p], k] for name, (p, k) in PLUG_IN_GAIT_POINTS.items()}
        for letter in "LR"
    }
    for letter, by_name in angles.items():
        check_degrees(np.concatenate(list(by_name.values())), f"{path.name}, side {letter}")
    feet = _feet(path, points, labels, time, table) if all(m in column for m in _FOOT_MARKERS) else None
    series = AngleSeries(time, angles["L"], angles["R"], PLUG_IN_GAIT)
    check_ranges(series, path.name)
    name = path.name.removesuffix(".gz").removesuffix(".c3d")
    missing = PblError(
        "GAIT_INPUT",
        found="neither event labels nor the markers " + ", ".join(_FOOT_MARKERS),
        expected="labels Foot Strike and Foot Off with their sides, or foot markers",
        next_step="pass events with --events",
        key=str(path),
    )
    labelled = functools.partial(_labelled, path, table)
    return LabTrial(name, series, trial_events(path, feet, events_csv, method, missing, table.origin, labelled), feet)


def read_lab_feet(path: str | Path, person: str | None = None) -> FootTrajectories:
    """Feet and legs from the markers of a C3D file (also gzipped), metres; needs neither angles nor labels.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (not a C3D), GAIT_INPUT (a foot marker is missing, several persons).
    """
    path = Path(path)
    points, labels, time, table = _read(path, [*_FOOT_MARKERS, *_LEG_MARKERS], person)
    if missing := [m for m in _FOOT_MARKERS if m not in labels]:
        raise PblError(
            "GAIT_INPUT",
            found=f"no markers {', '.join(missing)}",
            expected="the markers " + ", ".join(_FOOT_MARKERS),
            next_step="name the markers as Plug-in Gait does",
            key=str(path),
        )
    return _feet(path, points, labels, time, table)


def _feet(path: Path, points: np.ndarray, labels: list[str], time: np.ndarray, table: C3dFile) -> FootTrajectories:
    there = [*_FOOT_MARKERS, *(m for m in _LEG_MARKERS if m in labels)]
    xyz = points[:, [labels.index(m) for m in there]] * _metres(table, path)
    feet = feet_from_markers(time, there, "plug_in_gait", xyz)
    check_feet(feet, str(path))
    return feet


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Make any error of a damaged or ambiguous file one of this path."""
    try:
        yield
    except PblError:
        raise
    except Exception as error:  # packages raise anything for a damaged file
        found = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
        raise _damaged(found, "a C3D file whose parts agree", key=path) from error


def _read(
    path: Path, wanted: Collection[str], person: str | None = None
) -> tuple[np.ndarray, list[str], np.ndarray, C3dFile]:
    """Those of the `wanted` points of `person` that are there (T, P, 3), their names without prefix, time stamps (T,)
    in s from frame 1, and the file."""
    if not path.is_file():
        raise PblError(
            "FILE_MISSING", found="no such file", expected="a C3D file", next_step="check the path", key=str(path)
        )
    with _reading(path):
        file = C3dFile(read_bytes(path, _LARGEST))
        parts = [(i, *label.rpartition(":")) for i, label in enumerate(file.labels)]
        there = [(prefix, name, i) for i, prefix, _, name in parts if name in wanted]
        prefixes = _distinct(prefix for prefix, _, _ in there)
        known = prefixes or _distinct([*file.texts("SUBJECTS:NAMES"), *file.texts("EVENT:SUBJECTS")])
        if (len(prefixes) > 1) if person is None else (_key(person) not in known):
            raise _several_persons(known, "points" if prefixes else "events", path)
        kept = [p for p in there if not p[0] or person is None or _key(p[0]) == _key(person)]
        names = [name for _, name, _ in kept]
        if twice := [n for n in dict.fromkeys(names) if names.count(n) > 1]:
            found = f"more than one point named {', '.join(twice)}"
            advice = "rename or remove all but one, and export again"
            raise PblError("FILE_FORMAT", found, "each point once", advice, key=path)
        xyz = file.points([i for _, _, i in kept])
    if not len(xyz):
        raise _damaged("no frames", "points over time", key=path)
    file.person = person or next(iter(prefixes.values()), "")
    return xyz, names, (file.first_frame - 1 + np.arange(len(xyz))) / file.rate_hz, file


def _metres(file: C3dFile, path: Path) -> float:
    with _reading(path):
        text = next(iter(file.texts("POINT:UNITS")), "").lower()
    if not text:
        file.origin.assumed.append("no unit of points: mm is assumed")
    factors = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
    if (text or "mm") not in factors:
        raise _format_error(f"points in {text!r}", "mm, cm or m", key=path)
    return factors[text or "mm"]


def trial_events(
    path: Path,
    feet: FootTrajectories | None,
    events_csv: str | Path | None,
    method: Any,
    missing: PblError,
    origin: Origin,
    labelled: Callable[[], tuple[GaitEvent, ...]] = tuple,
) -> GaitEvents:
    """Events of a recording: those of `events_csv`, else its labels, else found from the feet; none if these show a
    person who lies or walks backwards. Raises `PblError` `missing` if there is none of them. With the check of `origin`
    (of the data of the file)."""
    events = _events(path, feet, events_csv, method, missing, origin, labelled)
    return dataclasses.replace(events, qc=(*events.qc, *origin.checks(path.name)))


def _events(path: Path, feet: FootTrajectories | None, events_csv, method, missing, origin, labelled) -> GaitEvents:
    if feet is not None:
        try:
            grid, reason, advice = check_preconditions(feet, 0.0)
        except PblError as error:
            raise error.about(str(path)) from error.__cause__
        if grid is not None and reason:
            return no_events("none", "", feet.source, reason, advice)
    if events_csv is not None:
        return _given(load_events(events_csv), "given", Path(events_csv).name)
    if found := labelled():
        return _given(found, "labels", "labels of the recording")
    if feet is None:
        raise missing
    origin.computed.append(f"events by {METHODS.find(method).name}")
    return detect_events(feet, method)


def _labelled(path: Path, file: C3dFile) -> tuple[GaitEvent, ...]:
    with _reading(path):
        labelled = file.events()
    found = sorted(_of_person(path, file, labelled), key=lambda e: e.time_s)
    frames = [e.time_s * file.rate_hz + 1 - file.first_frame for e in found]
    if outside := sum(not -1 <= frame <= file.n_frames for frame in frames):
        file.origin.assumed.append(
            f"{outside} of {len(found)} events are outside of the recording, whose frame 1 is at 0 s"
        )
    if not found and (labelled or file.texts("EVENT:LABELS")):
        file.origin.assumed.append("no event label is used: events are found from the markers")
    return tuple(found)


def _of_person(path: Path, file: C3dFile, events: list[tuple[str, GaitEvent]]) -> list[GaitEvent]:
    """The events of the person whose points were read. A single subject that names no one else is that person."""
    subjects = _distinct(subject for subject, _ in events)
    named = _distinct(file.texts("SUBJECTS:NAMES"))
    person = _key(file.person) or (next(iter(named)) if len(named) == 1 else "")
    persons = {person, *named, *_distinct(label.rpartition(":")[0] for label in file.labels)}
    if not person or not subjects.keys() & persons:
        if len(subjects) > 1:
            raise _several_persons(subjects, "events", path)
        return [event for _, event in events]
    if others := [name for key, name in subjects.items() if key != person]:
        file.origin.assumed.append(f"events of other persons are left out: {', '.join(others)}")
    return [event for subject, event in events if _key(subject) in (person, "")]


def _key(name: str) -> str:
    """The name of a person without case."""
    return name.strip().casefold()


def _distinct(names: Iterable[str]) -> dict[str, str]:
    """The names that differ by more than case, by their key."""
    return {_key(name): name.strip() for name in names if _key(name)}


def _several_persons(names: dict[str, str], what: str, path: Path) -> PblError:
    return PblError(
        "GAIT_INPUT",
        found=f"{what} of {', '.join(names.values()) or 'no named person'}",
        expected="one person, whose points and events can be told",
        next_step="name the person with --person",
        key=path,
    )


def _given(events: tuple[GaitEvent, ...], method: str, source: str) -> GaitEvents:
    span = ((events[0].time_s, events[-1].time_s),) if events else ()
    reason = "" if events else "no event in the file"
    return GaitEvents(PASS if events else EMPTY, events, reason, method, "", source, span, len(events))
