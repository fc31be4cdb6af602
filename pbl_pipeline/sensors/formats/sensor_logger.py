"""Wrist motion of a watch in an export of the app Sensor Logger: its folder, its zip, or `WristMotion.csv`.

By its documents (github.com/tszheichoi/awesome-sensor-logger: UNITS, COORDINATES, CROSSPLATFORM) `time` is UTC in
nanoseconds since 1970 and rates are in rad/s. Gravity and the acceleration without it are in g unless units were
standardised, and point the other way on iOS. The quaternion, from the watch to a world with z up, tells which.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.video.sensor_logger import member_text

from .samples import Format, LogFile, Samples, numbers, table

_NAME, _G = "WristMotion", 9.80665


def _text(file: LogFile) -> str:
    return file.text or member_text(file.path, _NAME) or ""


def _knows(file: LogFile) -> bool:
    first = _text(file)[:8000].split("\n", 1)[0]
    return "rotationRateX" in first and "seconds_elapsed" in first


def _reads(file: LogFile) -> list[Samples]:
    file = dataclasses.replace(file, text=_text(file))
    found = table(file, 0)
    time = numbers(file, found, "time")
    turns = numbers(file, found, [f"quaternion{k}" for k in "WXYZ"])
    rate, gravity, free = (
        numbers(file, found, [f"{what}{axis}" for axis in "XYZ"])
        for what in ("rotationRate", "gravity", "acceleration")
    )
    if time is None or turns is None or gravity is None or free is None:
        raise file.refuse("no time, quaternion, gravity or acceleration", "WristMotion as Sensor Logger writes it")
    order = np.argsort(time, kind="stable")  # the watch sends its rows in batches
    known = np.isfinite(turns).all(axis=1) & (np.linalg.norm(turns, axis=1) > 0)
    up = np.full_like(gravity, np.nan)
    up[known] = Rotation.from_quat(turns[known], scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    sign = np.sign(np.nanmedian(np.sum(up * gravity, axis=1)))
    scale = _G if np.nanmedian(np.linalg.norm(gravity, axis=1)) < 2 else 1.0
    rows = (None if x is None else x[order] for x in (rate, sign * scale * (gravity + free), turns))
    return [Samples(file.stem, "UTC", time[order] / 1e9, *rows, start_utc=0.0)]


FORMAT = Format("Sensor Logger of a watch", _knows, _reads)
