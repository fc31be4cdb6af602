"""Orientations of sensors in a `.sto` file of OpenSense: quaternions (w, x, y, z) in a column for each sensor.

They take vectors of the sensor to a world with z up, as OpenSense's readers of Xsens and APDM write them; one that was
turned to OpenSim's world (y up) must not be given. The file has no accelerations by which this could be checked.
"""

from __future__ import annotations

import numpy as np

from .samples import Format, LogFile, Samples, numbers, table


def _reads(file: LogFile) -> list[Samples]:
    lines = file.text[:8000].splitlines()
    end = next((i for i, line in enumerate(lines) if line.strip().lower() == "endheader"), 0)
    found = table(file, end + 1, "\t")
    stamp = numbers(file, found, "time")
    if stamp is None:
        raise file.refuse("no column time", "times in s and a column of quaternions for each sensor")
    out = []
    for name in [str(c) for c in found.columns if c not in ("", "time")]:
        cells = found[name].str.split(",", expand=True)
        if cells.shape[1] != 4:
            raise file.refuse(f"column {name} with {cells.shape[1]} numbers in a cell", "quaternions w,x,y,z")
        cells.columns = list("wxyz")
        turns = numbers(file, cells, list("wxyz"))
        if turns is not None:
            out.append(Samples(name, str(file.path), np.asarray(stamp), orientation=turns))
    return out


FORMAT = Format("OpenSense .sto", lambda file: "DataType=Quaternion" in file.text[:8000], _reads)
