"""CSV files of Shimmer's Consensys, one for each sensor, calibrated (`..._CAL`).

A line `sep=`, the names, the units, then the samples; times are milliseconds since 1970, which the base sets in all of
its sensors. Of two accelerometers the one with the wide range (`Accel_WR`) is taken: the other ends at 2 g.
"""

from __future__ import annotations

import numpy as np

from .samples import Format, LogFile, Samples, numbers, table

_STAMP = "_Timestamp_Unix_CAL"
_FACTORS = {"deg/s": np.pi / 180, "rad/s": 1.0, "m/(s^2)": 1.0, "m/(sec^2)": 1.0}


def _knows(file: LogFile) -> bool:
    return any(_STAMP in line for line in file.text[:8000].split("\n", 2)[:2])


def _reads(file: LogFile) -> list[Samples]:
    line = next(i for i, text in enumerate(file.text[:8000].splitlines()) if _STAMP in text)
    found = table(file, line, max("\t,;", key=file.text[:8000].splitlines()[line].count))
    units, found = found.iloc[0], found.iloc[1:]
    name = next(str(c) for c in found.columns if str(c).endswith(_STAMP)).removesuffix(_STAMP)
    stamp = numbers(file, found, name + _STAMP)
    if stamp is None or str(units[name + _STAMP]).strip() != "ms":
        raise file.refuse(f"times in {units[name + _STAMP]}", "times in ms since 1970")

    def values(what: str) -> np.ndarray | None:
        names = [f"{name}_{what}_{axis}_CAL" for axis in "XYZ"]
        read = numbers(file, found, names)
        if read is not None and (unit := str(units[names[0]]).strip()) not in _FACTORS:
            raise file.refuse(f"{what} in {unit}", ", ".join(_FACTORS))
        return None if read is None else read * _FACTORS[str(units[names[0]]).strip()]

    wide = values("Accel_WR")
    acceleration = values("Accel_LN") if wide is None else wide
    return [Samples(name, "UTC", stamp / 1e3, values("Gyro"), acceleration, start_utc=0.0)]


FORMAT = Format("Shimmer Consensys", _knows, _reads)
