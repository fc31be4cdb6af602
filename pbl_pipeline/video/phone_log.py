"""Sensor log of a phone that filmed: orientation and other sensors, as a recording app wrote them.

This module reads our two formats (CSV, JSON; docs/phone_capture.md). Nothing is turned or shifted: `load_attitude`
brings a log to a video.
"""

from __future__ import annotations

import csv
import dataclasses
import datetime
import io
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline import bounded
from pbl_pipeline.errors import os_errors_as, said
from pbl_pipeline.sampling import interval_of

from .attitude import CAMERA, DEVICE, check_attitude, log_error

#: Clocks of a log: the video's; nearly the video's, so that the pictures decide; UTC (`start_utc_s` is known); another,
#: begun some time before the video.
VIDEO_CLOCK, PICTURES_CLOCK, UTC_CLOCK, OWN_CLOCK = "video", "pictures", "utc", "own"
QUATERNION = ("qw", "qx", "qy", "qz")
_COLUMNS = ("time_s", *QUATERNION)
_SETTINGS = ("frame", "rotation_deg", "start_utc", "clock")
#: Further sensors: their columns in a CSV, and the unit of their values.
SENSORS = {
    "accelerometer": (("ax", "ay", "az"), "m/s^2"),
    "gyroscope": (("gx", "gy", "gz"), "rad/s"),
    "magnetometer": (("mx", "my", "mz"), "uT"),
}
#: Years in which a log may begin.
_YEARS = range(1990, 2200)


@dataclasses.dataclass(frozen=True)
class Sensor:
    """`time_s` (K,) on the log's clock, increasing; `xyz` (K, 3) along the device's axes, in the unit of `SENSORS`."""

    time_s: np.ndarray
    xyz: np.ndarray


@dataclasses.dataclass(frozen=True)
class PhoneLog:
    """A log as written, checked by `check_attitude`."""

    time_s: np.ndarray  # (P,) seconds of `clock`
    quat_wxyz: np.ndarray  # (P, 4) from `frame` to a world with z up
    frame: str  # "camera" or "device"
    rotation_deg: float | None  # clockwise turn of the phone from portrait, None if not stated
    clock: str
    start_utc_s: float | None  # seconds from 1970 to time 0, None if not known
    sensors: Mapping[str, Sensor]  # those of `SENSORS` that the log has, and "gravity"
    form: str  # name of the format
    device: str = ""
    notes: tuple[str, ...] = ()  # on omitted rows

    @property
    def rate_hz(self) -> float:
        """Samples of the orientation per second (`sampling.interval_of`)."""
        return 1.0 / interval_of(self.time_s)


def read_own_form(path: Path) -> PhoneLog:
    """Read a log in one of our formats, known by its first character. Raises `PblError` FILE_MISSING, PHONE_LOG."""
    text = read_text(path)
    is_json = text[:1000].lstrip()[:1] in ("{", "[")
    return _read_json(path, text) if is_json else _read_csv(path, text)


def read_text(path: Path) -> str:
    """Text of a file. Raises `PblError` FILE_MISSING, PHONE_LOG (no text, or too long)."""
    with os_errors_as(
        "FILE_MISSING", "a sensor log, CSV or JSON", "check the path, and that you may read the file", path
    ):
        try:
            return bounded.read_text(path)
        except ValueError as error:
            raise log_error(
                f"no text to read ({error})", "CSV or JSON with " + ", ".join(_COLUMNS), key=path
            ) from error


def read_table(path: Path, text: str, wanted: Collection[str]) -> tuple[list[str], list[dict[str, str | None]]]:
    """Column names of a CSV text and the `wanted` columns of its rows, without empty lines and lines that start with #.
    Cells that `;` separates may have decimal commas. Raises `PblError` PHONE_LOG."""
    full = (t for t in io.StringIO(text, newline=None) if t.strip() and t[0] != "#")
    first = next(full, "")
    if ";" in first and "," not in first:
        full = (t.replace(",", ".").replace(";", ",") for t in full)
        first = first.replace(";", ",")
    rows = csv.reader(itertools.chain([first], full), skipinitialspace=True)
    try:
        bounded.count_rows(max(text.count("\n"), text.count("\r")))
        names = [n.strip() for n in next(rows, ())]
        kept = [(i, n) for i, n in enumerate(names) if n in wanted]
        table = [{n: row[i] if i < len(row) else None for i, n in kept} for row in rows if row]
    except (csv.Error, ValueError) as error:
        raise log_error(f"not CSV ({error})", "CSV with the columns " + ", ".join(_COLUMNS), key=path) from error
    return names, table


def numbers(path: Path, table: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    """(N,) float64 of one column. Raises `PblError` PHONE_LOG."""
    try:
        return np.array([float(row[name]) for row in table], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise log_error(f"column {name}: {error}", "a number in each row", key=path) from error


def _read_csv(path: Path, text: str) -> PhoneLog:
    axes = {axis for columns, _ in SENSORS.values() for axis in columns}
    names, table = read_table(path, text, {*_COLUMNS, *_SETTINGS, *axes})
    _check_names(path, names)
    columns = [numbers(path, table, name) for name in _COLUMNS]
    settings: dict[str, object] = {}
    for name in _SETTINGS:
        values = {str(row.get(name) or "").strip() for row in table} - {""}
        if len(values) > 1:
            raise log_error(f"column {name} holds {', '.join(sorted(values))}", "one value in the whole file", key=path)
        if values:
            settings[name] = values.pop()
    sensors = {}
    for sensor, (axes, _) in SENSORS.items():
        if set(axes) <= set(names):
            # A slower sensor has no value in some rows.
            filled = [row for row in table if all((row.get(a) or "").strip() for a in axes)]
            xyz = np.stack([numbers(path, filled, a) for a in axes], axis=1)
            sensors[sensor] = _sensor(path, sensor, numbers(path, filled, "time_s"), xyz)
    return _log(path, columns, settings, sensors, "CSV")


def _read_json(path: Path, text: str) -> PhoneLog:
    expected = "an object with " + ", ".join(_COLUMNS)
    try:
        content = bounded.parse_json(text)
    except ValueError as error:
        raise log_error(f"not JSON ({error})", expected, key=path) from error
    orientation = content.get("orientation", content) if isinstance(content, dict) else None
    if not isinstance(orientation, dict):
        raise log_error("JSON or an orientation that is not an object", expected, key=path)
    _check_names(path, list(orientation))
    columns = _lists(path, orientation, _COLUMNS)
    sensors = {}
    for sensor in SENSORS:
        if isinstance(content.get(sensor), dict):
            time, *xyz = _lists(path, content[sensor], ("time_s", "x", "y", "z"), sensor)
            sensors[sensor] = _sensor(path, sensor, time, np.stack(xyz, axis=1))
    phone = content.get("phone")
    device = " ".join(str(v) for v in phone.values() if v) if isinstance(phone, dict) else ""
    settings = {name: content[name] for name in _SETTINGS if name in content}
    return _log(path, columns, settings, sensors, "JSON", device)


def _lists(path: Path, content: Mapping[str, Any], names: Sequence[str], where: str = "") -> list[np.ndarray]:
    columns = []
    for name in names:
        try:
            columns.append(np.asarray(content[name], np.float64))
        except (KeyError, TypeError, ValueError) as error:
            raise log_error(f"{where} field {name}: {error}".strip(), "a list of numbers", key=path) from error
    if len({c.shape for c in columns}) > 1 or columns[0].ndim != 1:
        shapes = ", ".join(f"{n} {c.shape}" for n, c in zip(names, columns, strict=True))
        raise log_error(f"{where} {shapes}".strip(), "lists of the same length", key=path)
    return columns


def _log(
    path: Path,
    columns: list[np.ndarray],
    settings: Mapping[str, object],
    sensors: Mapping[str, Sensor],
    form: str,
    device: str = "",
) -> PhoneLog:
    time, quat = check_attitude(columns[0], np.stack(columns[1:], axis=1), path)
    frame, rotation_deg = _frame(path, settings)
    start = _utc(path, settings.get("start_utc"))
    clock = str(settings.get("clock", VIDEO_CLOCK))
    if clock not in (VIDEO_CLOCK, PICTURES_CLOCK):
        raise log_error(f"clock {clock!r}", f"{VIDEO_CLOCK} or {PICTURES_CLOCK}", key=path)
    clock = clock if start is None else UTC_CLOCK
    return PhoneLog(time, quat, frame, rotation_deg, clock, start, sensors, form, device)


def _check_names(path: Path, names: list[str]) -> None:
    missing = [n for n in _COLUMNS if n not in names]
    if missing:
        raise log_error(said("no {fields}", fields=", ".join(missing)), "the fields " + ", ".join(_COLUMNS), key=path)


def _frame(path: Path, settings: Mapping[str, object]) -> tuple[str, float | None]:
    frame, turned = settings.get("frame", CAMERA), settings.get("rotation_deg")
    if frame not in (CAMERA, DEVICE):
        raise log_error(f"frame {frame!r}", f"{CAMERA} or {DEVICE}", key=path)
    if turned is None:
        return str(frame), None
    try:
        rotation_deg = float(turned)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        rotation_deg = math.nan
    if rotation_deg not in (0.0, 90.0, 180.0, 270.0):
        raise log_error(f"rotation_deg {turned!r}", "0, 90, 180 or 270", key=path)
    if rotation_deg and frame == CAMERA:
        found = f"rotation_deg {rotation_deg:g} with frame {CAMERA}"
        raise log_error(
            found, f"rotation_deg only with frame {DEVICE}: the camera's frame is the upright picture's", key=path
        )
    return str(frame), rotation_deg


def _utc(path: Path, value: object) -> float | None:
    """Seconds since 1970 of a time with its zone ("2026-03-01T09:15:30.250Z"); the zone is required."""
    if value is None:
        return None
    try:
        when = datetime.datetime.fromisoformat(str(value))
    except ValueError as error:
        raise log_error(f"start_utc {value!r}", "a time such as 2026-03-01T09:15:30.250Z", key=path) from error
    if when.year not in _YEARS:
        raise log_error(f"start_utc {value!r}", f"a year from {_YEARS.start} to {_YEARS.stop - 1}", key=path)
    if when.tzinfo is None:
        raise log_error(f"start_utc {value!r} without a time zone", "a time such as 2026-03-01T09:15:30.250Z", key=path)
    return when.timestamp()


def _sensor(path: Path, name: str, time: np.ndarray, xyz: np.ndarray) -> Sensor:
    if not np.isfinite(time).all() or not np.isfinite(xyz).all():
        raise log_error(
            said("{name}: values that are not finite", name=name), "finite numbers; leave such samples out", key=path
        )
    if np.any(np.diff(time) < 0):
        raise log_error(said("{name}: stamps that run backwards", name=name), "increasing times", key=path)
    return Sensor(time, xyz)
