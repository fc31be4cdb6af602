"""CSV files of the Movella DOT (Xsens DOT) app, one for each sensor.

Lines such as `OutputRate:,60Hz` come before the table. Accelerations are in m/s2, rates in deg/s, `Euler_X`, `Euler_Y`
and `Euler_Z` are roll, pitch and yaw in deg, quaternions take vectors of the sensor to a world with z up. `FreeAcc` is
without gravity and is not used. SampleTimeFine counts microseconds in 32 bits, on one clock of synchronised sensors.
"""

from __future__ import annotations

import datetime
import re

import numpy as np

from .samples import Format, LogFile, Samples, counted_on, numbers, quaternions, table

_MOMENT = re.compile(r"(\d{4}-\d\d-\d\d)[ _](\d\d:\d\d:\d\d)[._](\d{3}) (?:GMT|UTC)?(?:([+-]\d\d?):?(\d\d)?)?$")
_LINE = re.compile(r"^(\w[\w ]*):\s*,?\s*([^,\n]*)", re.MULTILINE)


def _header(file: LogFile) -> tuple[int, str]:
    lines = file.text[:8000].splitlines()
    return next(((i, line) for i, line in enumerate(lines) if "SampleTimeFine" in line), (0, ""))


def _knows(file: LogFile) -> bool:
    line, names = _header(file)
    return bool(names) and (line > 0 or re.search("Quat_W|Euler_X|dq_W|FreeAcc_X", names) is not None)


def _reads(file: LogFile) -> list[Samples]:
    line, _ = _header(file)
    about = dict(_LINE.findall("\n".join(file.text[:8000].splitlines()[:line])))
    found = table(file, line)
    fine = numbers(file, found, "SampleTimeFine")
    if fine is None:
        raise file.refuse("no times in SampleTimeFine", "microseconds of the sensor's clock in each row")
    stamp = counted_on(fine, 2**32) / 1e6
    rate = numbers(file, found, ["Gyr_X", "Gyr_Y", "Gyr_Z"])
    turns = numbers(file, found, [f"Quat_{k}" for k in "WXYZ"])
    if turns is None:
        turns = quaternions(euler_deg=numbers(file, found, ["Euler_X", "Euler_Y", "Euler_Z"]))
    counter = numbers(file, found, "PacketCounter")
    hz = re.match(r"[\d.]+", about.get("OutputRate", ""))
    name = about.get("DeviceTag") or file.stem
    start = _start(about.get("StartTime", ""))
    return [
        Samples(
            name,
            f"Movella DOT {name}" if about.get("SyncStatus") == "Un-synced" else "Movella DOT",
            stamp,
            None if rate is None else np.radians(rate),
            numbers(file, found, ["Acc_X", "Acc_Y", "Acc_Z"]),
            turns,
            None if start is None else start - float(stamp[0]),
            None if counter is None else counted_on(counter, 2**16),
            float(hz[0]) if hz else None,
            2**32 / 1e6,
        )
    ]


def _start(text: str) -> float | None:
    """Seconds since 1970 of a start such as `2021-08-20_20:21:13_804 GMT+8`; None where letters name the zone."""
    found = _MOMENT.match(text.strip())
    if found is None:
        return None
    day, time, thousandths, hours, minutes = found.groups("0")
    away = 60 * int(hours) + (-1 if hours.startswith("-") else 1) * int(minutes)
    moment = datetime.datetime.fromisoformat(f"{day}T{time}.{thousandths}+00:00")
    return moment.timestamp() - 60 * away


FORMAT = Format("Movella DOT", _knows, _reads)
