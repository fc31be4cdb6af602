"""A phone's sensor log in whichever form it was written, checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import bounded
from pbl_pipeline.names import is_plain

from .attitude import DEVICE, log_error
from .phone_log import PhoneLog, read_own_form
from .sensor_logger import is_sensor_logger, read_sensor_logger

#: Latest time in a log (s), on whichever clock.
_LATEST_S = 1e10
#: An accelerometer shows gravity where its typical length (m/s^2) lies in this range; it then must agree with the log's
#: way up within this angle.
_GRAVITY, _MOST_TILT_DEG = (8.8, 10.8), 25.0


def read_phone_log(path: str | Path) -> PhoneLog:
    """Read a log in one of the forms of docs/phone_capture.md; what it is follows from its content.

    Raises `PblError` FILE_MISSING: no such file. PHONE_LOG: none of the forms, a field missing, what `check_attitude`
    refuses, an unknown frame, sensors whose gravity contradicts the orientation.
    """
    path = Path(path)
    log = read_sensor_logger(path) if is_sensor_logger(path) else read_own_form(path)
    if not is_plain(log.device):
        raise log_error(f"a phone called {ascii(log.device)[:80]}", "a name without control characters", path)
    if np.abs(log.time_s).max() > _LATEST_S or bounded.span_s(log.time_s) > bounded.MAX_SECONDS:
        found = f"times from {log.time_s[0]:.6g} to {log.time_s[-1]:.6g} s"
        raise log_error(found, f"seconds, {bounded.MAX_SECONDS:g} at most", path)
    _check_gravity(path, log)
    return log


def _check_gravity(path: Path, log: PhoneLog) -> None:
    """Compare the way up of the orientation with that of the accelerometer. Android counts it upwards, iOS downwards,
    so the line counts. It tells a wrong frame from a right one; heading it does not see."""
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
            f"an orientation whose vertical lies {off:.0f} deg from the accelerometer's",
            f"at most {_MOST_TILT_DEG:.0f} deg: quaternions that turn the phone's axes into a world with z up",
            path,
        )
