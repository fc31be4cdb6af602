"""CSV files of APDM's Mobility Lab and Motion Studio with all sensors, in two layouts.

The older has names such as `Right Ankle/Angular Velocity/X` in its third line, units in its fourth, and times in s. In
the other (`Format=7`) the first line names the sensors, the second their instruments, and times are microseconds since
1970. Accelerations are in m/s2, rates in rad/s; quaternions, scalar first, take vectors of the sensor to a world with
z up (seen in the real files; the documents call the world North, West, Up).
"""

from __future__ import annotations

from .samples import Format, LogFile, Samples, numbers, table

_UNITS = {"Acceleration": "m/s^2", "Angular Velocity": "rad/s"}


def _reads_new(file: LogFile) -> list[Samples]:
    sensors, instruments = (line.split(",") for line in file.text[:40_000].split("\n", 2)[:2])
    found = table(file, 0, skip=(1, 2))
    found.columns = [str(i) for i in range(found.shape[1])]
    stamp = numbers(file, found, "0")
    starts = [i for i in range(1, len(sensors) - 3) if sensors[i].strip() and sensors[i + 3].strip()]
    if stamp is None or not starts:
        raise file.refuse("no times, or no sensor in its first line", "Format=7 as Mobility Lab writes it")
    out = []
    for start, end in zip(starts, [*starts[1:], len(instruments)], strict=True):
        places = {instruments[i].strip(): i for i in range(start, end)}
        columns = {
            what: [str(places[what] + k) for k in range(n)]
            for what, n in (("Gyroscope", 3), ("Accelerometer", 3), ("Orientation", 4))
            if what in places
        }
        values = (numbers(file, found, columns.get(w, [""])) for w in ("Gyroscope", "Accelerometer", "Orientation"))
        out.append(Samples(sensors[start + 3].strip(), "UTC", stamp / 1e6, *values, start_utc=0.0))
    return out


def _reads_old(file: LogFile) -> list[Samples]:
    found = table(file, 2)
    units, found = found.iloc[0], found.iloc[1:]
    stamp = numbers(file, found, "Time")
    names = dict.fromkeys(str(c).rpartition("/")[0].rpartition("/")[0] for c in found.columns if "/" in str(c))
    if stamp is None or not names:
        raise file.refuse("no column Time, or no sensor", "columns such as Lumbar/Acceleration/X")
    out = []
    for name in names:
        for what, unit in _UNITS.items():
            if (given := str(units.get(f"{name}/{what}/X", unit)).strip()) != unit:
                raise file.refuse(f"{name}/{what} in {given}", f"in {unit}")
        axes = ["Scalar", "X", "Y", "Z"]
        rate, acceleration, turns = (
            numbers(file, found, [f"{name}/{what}/{k}" for k in which])
            for what, which in (("Angular Velocity", axes[1:]), ("Acceleration", axes[1:]), ("Orientation", axes))
        )
        out.append(Samples(name, str(file.path), stamp, rate, acceleration, turns))
    return out


NEW = Format("APDM (Format=7)", lambda file: file.text.startswith("Format=7,"), _reads_new)
OLD = Format("APDM", lambda file: file.text.startswith("Test Name:"), _reads_old)
