"""Recordings of a gait laboratory (C3D): the angles of its marker model, its event labels, its markers."""

from __future__ import annotations

import dataclasses
import functools
import io
import itertools
import math
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.bounded import MIB, count_rows, read_bytes
from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import EMPTY, PASS

from ._angles import AngleSeries
from .events import (
    FOOT_DOWN,
    FOOT_UP,
    SIDES,
    GaitEvent,
    GaitEvents,
    check_preconditions,
    detect_events,
    load_events,
    no_events,
)
from .motion import FootTrajectories, feet_from_markers
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
_LABELS = {"Foot Strike": FOOT_DOWN, "Foot Off": FOOT_UP}
_format_error = functools.partial(
    PblError,
    "FILE_FORMAT",
    next_step="export the recording with the angles of the laboratory's model, see docs/files.md",
)


@dataclasses.dataclass(frozen=True)
class LabTrial:
    """One recording: `series` of nine angles per side (Plug-in Gait's, degrees), `events`, and `feet` where the markers
    are there (metres)."""

    name: str
    series: AngleSeries
    events: GaitEvents
    feet: FootTrajectories | None


def read_lab_trial(path: str | Path, events_csv: str | Path | None = None, method: Any = None) -> LabTrial:
    """Angles, events and feet of a C3D file (also gzipped) with the outputs of Plug-in Gait or a model of its kind.

    The angles are the points LHipAngles and so on (`PLUG_IN_GAIT_POINTS`). Events: those of `events_csv`
    (`pbl events`), else the recording's labels Foot Strike and Foot Off, else found from the markers of the legs by
    `method` (`detect_events`). Whatever their source, there are none if the markers show a person who lies or walks
    backwards, or a world whose vertical is not z. A sample that the file marks as invalid is NaN.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (not a C3D, a point is missing), ANGLE_UNITS (not degrees), GAIT_INPUT
    (neither labels nor foot markers; markers upside down or mirrored).
    """
    path = Path(path)
    angle_points = [s + p for p, _ in PLUG_IN_GAIT_POINTS.values() for s in "LR"]
    points, labels, time, table = _read(path, [*angle_points, *_FOOT_MARKERS, *_LEG_MARKERS])
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
    name = path.name.removesuffix(".gz").removesuffix(".c3d")
    return LabTrial(name, series, _events(path, table, feet, events_csv, method), feet)


def read_lab_feet(path: str | Path) -> FootTrajectories:
    """Feet and legs from the markers of a C3D file (also gzipped), metres; needs neither angles nor labels.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (not a C3D), GAIT_INPUT (a foot marker is missing).
    """
    path = Path(path)
    points, labels, time, table = _read(path, [*_FOOT_MARKERS, *_LEG_MARKERS])
    if missing := [m for m in _FOOT_MARKERS if m not in labels]:
        raise PblError(
            "GAIT_INPUT",
            found=f"no markers {', '.join(missing)}",
            expected="the markers " + ", ".join(_FOOT_MARKERS),
            next_step="name the markers as Plug-in Gait does",
            key=str(path),
        )
    return _feet(path, points, labels, time, table)


def _feet(path: Path, points: np.ndarray, labels: list[str], time: np.ndarray, table: Any) -> FootTrajectories:
    there = [*_FOOT_MARKERS, *(m for m in _LEG_MARKERS if m in labels)]
    xyz = points[:, [labels.index(m) for m in there]] * _metres(table, path)
    return feet_from_markers(time, there, "plug_in_gait", xyz)


def _read(path: Path, wanted: Collection[str]) -> tuple[np.ndarray, list[str], np.ndarray, Any]:
    """Those of the `wanted` points that are there (T, P, 3), their names, time stamps (T,) in s from frame 1, and the
    reader with the parameters."""
    import c3d

    if not path.is_file():
        raise PblError(
            "FILE_MISSING", found="no such file", expected="a C3D file", next_step="check the path", key=str(path)
        )
    try:
        data = read_bytes(path, _LARGEST)
        reader = c3d.Reader(io.BytesIO(data))
        names: list[str] = []
        # A parameter holds 255 names at most.
        for key in ("POINT:LABELS", "POINT:LABELS2", "POINT:LABELS3"):
            if (values := reader.get(key)) is not None:
                names += [str(s).strip() for s in np.ravel(values.string_array)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without analog channels
            column = {name: i for i, name in enumerate(names[: reader.point_used]) if name in wanted}
            frames = _frames(reader, len(data))
            rows = np.full((frames, len(column), 4), np.nan, np.float32)
            kept = list(column.values())
            read = reader.read_frames(copy=False)
            got = 0
            for got, (_, points, _) in enumerate(itertools.islice(read, frames), 1):
                rows[got - 1] = points[kept, :4]
            rows = rows[:got].astype(float)
        rate = float(reader.point_rate)
    except Exception as error:  # the package raises anything for a damaged file
        raise _format_error(f"{type(error).__name__}: {error}", "a C3D file", key=path) from error
    if not len(rows) or not 0 < rate < math.inf:
        raise _format_error("no frames", "points over time", key=path)
    xyz = np.where(rows[..., 3:4] < 0, np.nan, rows[..., :3])
    return xyz, list(column), (reader.first_frame - 1 + np.arange(len(xyz))) / rate, reader


def _frames(reader: Any, n_bytes: int) -> int:
    """Number of frames to read: those that the header counts, as far as the file has them."""
    words = 4 * int(reader.point_used) + int(reader.analog_used) * reader.analog_per_frame
    if reader.point_used < 1 or reader.analog_per_frame < 0:
        raise ValueError("no points")
    frames = min(reader.frame_count, n_bytes // (words * (4 if reader.point_scale < 0 else 2)))
    count_rows(frames)
    return max(frames, 0)


def _metres(reader: Any, path: Path) -> float:
    unit = reader.get("POINT:UNITS")
    text = str(np.ravel(unit.string_array)[0]).strip().lower() if unit is not None else "mm"
    factors = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
    if text not in factors:
        raise _format_error(f"points in {text!r}", "mm, cm or m", key=path)
    return factors[text]


def _events(
    path: Path, reader: Any, feet: FootTrajectories | None, events_csv: str | Path | None, method: Any
) -> GaitEvents:
    if feet is not None:
        try:
            grid, reason, advice = check_preconditions(feet, 0.0)
        except PblError as error:
            raise error.about(str(path)) from error.__cause__
        if grid is not None and reason:
            return no_events("none", "", feet.source, reason, advice)
    if events_csv is not None:
        return _given(load_events(events_csv), "given", Path(events_csv).name)
    table = reader.get("EVENT")
    if table is not None and table.get("LABELS") is not None and table.get("TIMES") is not None:
        found = []
        words = (np.ravel(table.get(k).string_array) for k in ("CONTEXTS", "LABELS"))
        for context, label, time in zip(*words, table.get("TIMES").float_array, strict=False):
            side, event = str(context).strip().lower(), _LABELS.get(str(label).strip())
            if side in SIDES and event:
                # Minutes and seconds.
                found.append(GaitEvent(float(time[0] * 60 + time[1]), side, event, 1.0))
        if found:
            return _given(tuple(sorted(found, key=lambda e: e.time_s)), "labels", "labels of the recording")
    if feet is None:
        raise PblError(
            "GAIT_INPUT",
            found="neither event labels nor the markers " + ", ".join(_FOOT_MARKERS),
            expected="labels Foot Strike and Foot Off, or foot markers",
            next_step="pass events with --events",
            key=str(path),
        )
    return detect_events(feet, method)


def _given(events: tuple[GaitEvent, ...], method: str, source: str) -> GaitEvents:
    span = ((events[0].time_s, events[-1].time_s),) if events else ()
    reason = "" if events else "no event in the file"
    return GaitEvents(PASS if events else EMPTY, events, reason, method, "", source, span, len(events))
