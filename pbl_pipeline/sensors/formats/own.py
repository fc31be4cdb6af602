"""The project's own CSV, one file for each sensor: a header and a row for each sample.

`time_s` (one clock in all files of a visit), `gyr_x`, `gyr_y`, `gyr_z` (rad/s), `acc_x`, `acc_y`, `acc_z` (m/s2; 9.81
upwards at rest), `quat_w`, `quat_x`, `quat_y`, `quat_z` (sensor to a world with z up), `start_utc` (the moment of time
0 with its zone), `mount_w`, `mount_x`, `mount_y`, `mount_z` (sensor to the axes of its segment: x forward, y up, z to
the right; in the first row). The rates and accelerations, or the quaternion, may be left out.
"""

from __future__ import annotations

import datetime

import numpy as np

from .samples import Format, LogFile, Samples, numbers, table


def _line(file: LogFile) -> tuple[int, str]:
    lines = file.text[:8000].splitlines()
    return next(((i, line.strip()) for i, line in enumerate(lines) if line.strip() and line[0] != "#"), (0, ""))


def _reads(file: LogFile) -> list[Samples]:
    line, names = _line(file)
    found = table(file, line, ";" if ";" in names else ",")
    stamp = numbers(file, found, "time_s")
    if stamp is None:
        raise file.refuse("no times in time_s", "seconds in each row")
    rate, acceleration = (numbers(file, found, [f"{what}_{axis}" for axis in "xyz"]) for what in ("gyr", "acc"))
    turns = numbers(file, found, [f"quat_{axis}" for axis in "wxyz"])
    mounting = numbers(file, found, [f"mount_{axis}" for axis in "wxyz"])
    if mounting is not None:
        mounting = mounting[np.isfinite(mounting).all(axis=1)][:1].sum(axis=0)
        if abs(np.linalg.norm(mounting) - 1) > 0.02:
            raise file.refuse(f"a mounting of length {np.linalg.norm(mounting):.3g}", "a unit quaternion in a row")
        mounting = mounting / np.linalg.norm(mounting)
    start = None
    if "start_utc" in found.columns and len(text := found["start_utc"].dropna()):
        try:
            moment = datetime.datetime.fromisoformat(str(text.iloc[0]).strip())
        except ValueError:
            moment = datetime.datetime.min
        if moment.tzinfo is None:
            raise file.refuse(f"start_utc {str(text.iloc[0])[:40]}", "a moment with its zone: 2026-03-01T09:15:30Z")
        start = moment.timestamp()
    if start is None:
        return [Samples(file.stem, "time_s", stamp, rate, acceleration, turns, mounting=mounting)]
    return [Samples(file.stem, "UTC", start + stamp, rate, acceleration, turns, start_utc=0.0, mounting=mounting)]


FORMAT = Format("CSV of this project", lambda file: _line(file)[1].lower().startswith("time_s"), _reads)
