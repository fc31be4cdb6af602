"""Exports of the app Sensor Logger (Kelvin Choi; iOS and Android): `Orientation.csv`, its folder or zip, or JSON.

By its documentation (github.com/tszheichoi/awesome-sensor-logger: README, UNITS, COORDINATES) `time` is UTC in
nanoseconds since 1970, `seconds_elapsed` counts from the tap on Record, values are in m/s^2, rad/s and uT, and rows may
be repeated. The quaternion is the system's (Android's rotation vector, iOS' CMAttitude), both from the device's axes to
a world with z up. Each file is checked for it: the last row of the rotation matrix holds the sine of `pitch`, which
Android counts the other way. Otherwise the file is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import bounded
from pbl_pipeline.errors import os_errors_as, said
from pbl_pipeline.names import is_plain

from .attitude import DEVICE, MAX_HOLE_S, check_attitude, log_error
from .phone_log import OWN_CLOCK, QUATERNION, UTC_CLOCK, PhoneLog, Sensor, numbers, read_own_form, read_table, read_text

_ORIENTATION = "Orientation"
#: Names of its sensors -> ours. Its "Accelerometer" is without gravity, ours with it.
_SENSORS = {
    "TotalAcceleration": "accelerometer",
    "Gravity": "gravity",
    "Gyroscope": "gyroscope",
    "Magnetometer": "magnetometer",
}
#: Repeated rows are omitted; with more than this fraction the stamps cannot be trusted.
_MOST_REPEATS = 0.1
#: Largest difference between the sines of the stated pitch and of the quaternion's.
_PITCH_TOL = 0.05
#: Stamps before this (s since 1970; 2015) are of a clock that was not set.
_EARLIEST_UTC_S = 1.42e9

#: The columns that are read of any sensor.
_COLUMNS = {"time", *QUATERNION, "pitch", "x", "y", "z", "device name", "platform"}

_Rows = Sequence[Mapping[str, Any]]


def is_sensor_logger(path: Path) -> bool:
    """True for a folder, an archive, and a file that begins with the names of such an export."""
    if path.is_dir() or path.suffix.lower() == ".zip":
        return True
    try:
        head = bounded.read_start(path, 4096).decode("utf-8-sig", "replace")
    except OSError:
        return False
    first = head.lstrip().split("\n", 1)[0]
    if head.lstrip()[:1] == "[":
        return '"sensor"' in head
    return "seconds_elapsed" in first


def read_sensor_logger(path: Path) -> PhoneLog:
    """Read an export. Raises `PblError` FILE_MISSING, PHONE_LOG."""
    tables, form = _tables(path)
    rows = tables(_ORIENTATION)
    if not rows:
        raise log_error("no orientation", "Orientation.csv, or rows of the sensor Orientation in the JSON", key=path)
    first_ns, time, rows, notes = _time(path, rows)
    quat = np.stack([numbers(path, rows, name) for name in QUATERNION], axis=1)
    time, quat = check_attitude(time, quat, path)
    _check_pitch(path, rows, quat)
    sensors = {}
    for name, ours in _SENSORS.items():
        found = tables(name)
        if found:
            start_ns, at, found, more = _time(path, found)
            xyz = np.stack([numbers(path, found, axis) for axis in "xyz"], axis=1)
            sensors[ours] = Sensor(at + (start_ns - first_ns) / 1e9, xyz)
            notes += [f"{name}: {n}" for n in more]
    about = next(iter(tables("Metadata")), {})
    device = " ".join(str(about[k]) for k in ("device name", "platform") if about.get(k))
    start = first_ns / 1e9
    clock, start = (UTC_CLOCK, start) if start > _EARLIEST_UTC_S else (OWN_CLOCK, None)
    return PhoneLog(time, quat, DEVICE, None, clock, start, sensors, f"Sensor Logger {form}", device, tuple(notes))


def _tables(path: Path) -> tuple[Callable[[str], _Rows], str]:
    """Return a function from a sensor's name to its rows (empty if there are none), and the name of the format."""
    if path.is_dir() or path.suffix.lower() == ".zip":
        return lambda name: _csv(path, member_text(path, name)), "folder" if path.is_dir() else "zip"
    text = read_text(path)
    if text.lstrip()[:1] == "[":
        try:
            content = bounded.parse_json(text)
        except ValueError as error:
            raise log_error(f"not JSON ({error})", "a list of rows, as Sensor Logger exports it", key=path) from error
        rows = [r for r in content if isinstance(r, dict)]
        return lambda name: [r for r in rows if r.get("sensor") == name], "JSON"
    return lambda name: _csv(path, text) if name == _ORIENTATION else [], "CSV"


def _csv(path: Path, text: str | None) -> _Rows:
    return [] if text is None else read_table(path, text, _COLUMNS)[1]


def member_text(path: Path, name: str) -> str | None:
    """Text of a sensor's file in an export, a folder or an archive; None without it. Raises `PblError` PHONE_LOG."""
    if path.is_dir():
        file = next((f for f in sorted(path.glob("*.csv")) if f.stem.lower() == name.lower()), None)
        return None if file is None else read_text(file)
    with os_errors_as("FILE_MISSING", "the zip that Sensor Logger exports", "check the path", path):
        try:
            with bounded.opened_zip(path) as archive:
                wanted = f"{name}.csv".lower()
                members = [m for m in archive.infolist() if PurePosixPath(m.filename).name.lower() == wanted]
                if len(members) > 1:
                    found = ", ".join(m.filename for m in members[:4])
                    raise log_error(
                        f"{len(members)} recordings in one archive: {found}"[:300],
                        "the zip of one recording",
                        next_step="pass the log of this video alone: its zip, or its Orientation.csv",
                        key=path,
                    )
                if not members:
                    return None
                return bounded.read_member(archive, members[0], bounded.MAX_TEXT).decode("utf-8-sig")
        except ValueError as error:
            found = f"no readable archive ({error})"
            raise log_error(found, "the zip that Sensor Logger exports", key=path) from error


def _time(path: Path, rows: _Rows) -> tuple[int, np.ndarray, _Rows, list[str]]:
    """First stamp (ns), times (s) after it, and their rows, without repeats."""
    try:
        ns = np.array([int(str(row["time"]).split(".")[0]) for row in rows], np.int64)
    except (KeyError, ValueError, OverflowError) as error:
        raise log_error(f"column time: {error}", "nanoseconds since 1970 in each row", key=path) from error
    kept = np.concatenate([[True], np.diff(ns) != 0])
    n = int((~kept).sum())
    if n > _MOST_REPEATS * len(ns):
        raise log_error(
            said("{n} of {all} stamps repeat the one before", n=n, all=len(ns)),
            "a different stamp for each sample",
            key=path,
        )
    notes = [f"{n} repeated rows were omitted"] if n else []
    rows = [row for row, keep in zip(rows, kept, strict=True) if keep]
    return int(ns[0]), (ns[kept] - ns[0]) / 1e9, rows, notes


def _check_pitch(path: Path, rows: _Rows, quat_wxyz: np.ndarray) -> None:
    if "pitch" not in rows[0]:
        return
    stated = np.abs(np.sin(numbers(path, rows, "pitch")))
    matrix = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()
    off = float(np.median(np.abs(np.abs(matrix[:, 2, 1]) - stated)))
    if off > _PITCH_TOL:
        raise log_error(
            said("quaternions whose pitch differs from the column pitch (sines by {off:.2f})", off=off),
            "quaternions that turn the phone's axes into a world with z up",
            key=path,
        )


#: Latest time in a log (s), on whichever clock.
_LATEST_S = 1e10
#: An accelerometer shows gravity if its median length (m/s^2) is in this range; its direction must then agree with the
#: log's vertical within this angle.
_GRAVITY, _MOST_TILT_DEG = (8.8, 10.8), 25.0


def read_phone_log(path: str | Path) -> PhoneLog:
    """Read a log in one of the formats of docs/phone_capture.md, which is found by its content.

    Raises `PblError` FILE_MISSING: no such file. PHONE_LOG: none of the formats, a field missing, as `check_attitude`,
    an unknown frame, sensors whose gravity contradicts the orientation.
    """
    path = Path(path)
    log = read_sensor_logger(path) if is_sensor_logger(path) else read_own_form(path)
    if not is_plain(log.device):
        raise log_error(f"a phone called {ascii(log.device)[:80]}", "a name without control characters", key=path)
    if np.abs(log.time_s).max() > _LATEST_S or bounded.span_s(log.time_s) > bounded.MAX_SECONDS:
        found = said("times from {start:.6g} to {end:.6g} s", start=log.time_s[0], end=log.time_s[-1])
        raise log_error(found, f"seconds, {bounded.MAX_SECONDS:g} at most", key=path)
    if log.rate_hz < 1 / MAX_HOLE_S:
        found = said("{n:.3g} orientations a second", n=log.rate_hz)
        raise log_error(found, f"{1 / MAX_HOLE_S:.2g} at least, and 50 for a phone in the hand", key=path)
    _check_gravity(path, log)
    return log


def _check_gravity(path: Path, log: PhoneLog) -> None:
    """Compare the vertical of the orientation with that of the accelerometer, up to sign (Android counts it upwards,
    iOS downwards). This detects a wrong frame, not a wrong heading."""
    sensor = log.sensors.get("gravity") or log.sensors.get("accelerometer")
    if sensor is None or log.frame != DEVICE or len(sensor.time_s) < 2:
        return
    length = np.linalg.norm(sensor.xyz, axis=1)
    if not _GRAVITY[0] <= np.median(length) <= _GRAVITY[1]:
        return
    near = np.clip(np.searchsorted(log.time_s, sensor.time_s), 0, len(log.time_s) - 1)
    up = Rotation.from_quat(log.quat_wxyz[near], scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    cos = np.abs(np.sum(up * sensor.xyz, axis=1)) / np.maximum(length, 1e-9)
    off = float(np.degrees(np.median(np.arccos(np.clip(cos, 0, 1)))))
    if off > _MOST_TILT_DEG:
        raise log_error(
            said("an orientation whose vertical lies {off:.0f} deg from the accelerometer's", off=off),
            f"at most {_MOST_TILT_DEG:.0f} deg: quaternions that turn the phone's axes into a world with z up",
            key=path,
        )
