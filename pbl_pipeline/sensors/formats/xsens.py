"""Text files of Xsens' MT Manager, one for each sensor (`MT_<recording>_<device>.txt`).

Lines that start with `//` describe the sensor. The columns, and what separates them (tab, comma, semicolon, space), are
chosen at the export. Accelerations are in m/s2, rates in rad/s; a matrix is listed by columns and takes vectors of the
sensor to a world with x to magnetic north or east and z up (ENU), or down where the header says NED. PacketCounter has
16 bits and is common to all sensors of a recording; SampleTimeFine counts 0.1 ms in 32 bits.
"""

from __future__ import annotations

import re

import numpy as np

from .samples import Format, LogFile, Samples, counted_on, numbers, quaternions, table

_MATRIX = [f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3)]
_RATE = re.compile(r"^//\s*Update Rate:\s*([\d.]+)\s*Hz", re.MULTILINE)
_DEVICE = re.compile(r"(.*?)_?([0-9A-F]{8})$")


def _knows(file: LogFile) -> bool:
    names = _header(file)[1]
    return file.text.startswith("//") and any(n in names for n in ("PacketCounter", "Acc_X", "Quat_q0", _MATRIX[0]))


def _header(file: LogFile) -> tuple[int, str]:
    """Number and text of the first line that is not a comment."""
    lines = file.text[:8000].splitlines()
    return next(((i, line) for i, line in enumerate(lines) if not line.startswith("//")), (0, ""))


def _reads(file: LogFile) -> list[Samples]:
    line, names = _header(file)
    found = table(file, line, max("\t,; ", key=names.count))
    stated = _RATE.search(file.text[:8000])
    hz = float(stated[1]) if stated else file.rate_hz
    counter, fine = (numbers(file, found, name) for name in ("PacketCounter", "SampleTimeFine"))
    counter = np.arange(len(found)) if counter is None else counted_on(counter, 2**16)
    if fine is not None:
        stamp, wraps_s = counted_on(fine, 2**32) / 1e4, 2**32 / 1e4
    elif hz:
        stamp, wraps_s = counter / hz, 2**16 / hz
    else:
        raise file.refuse(
            "neither Update Rate in its header nor SampleTimeFine", "the rate: rate_hz in a file of sensors"
        )
    turns = numbers(file, found, [f"Quat_q{i}" for i in range(4)])
    if turns is None:
        turns = quaternions(numbers(file, found, _MATRIX), numbers(file, found, ["Roll", "Pitch", "Yaw"]))
    if turns is not None and "Coordinate system: NED" in file.text[:8000]:
        turns = turns[:, [1, 0, 3, 2]] * [-1, 1, -1, 1]  # half a turn about the world's x
    recording, device = m.groups() if (m := _DEVICE.fullmatch(file.stem)) else ("", file.stem)
    rate, acceleration = (numbers(file, found, [f"{what}_{axis}" for axis in "XYZ"]) for what in ("Gyr", "Acc"))
    return [Samples(device, f"Xsens {recording}", stamp, rate, acceleration, turns, None, counter, hz, wraps_s)]


FORMAT = Format("Xsens MT Manager", _knows, _reads)
