"""Which way the phone looked while it filmed: the orientation log of `--attitude`.

Frames. World: z up, heading free. Camera: OpenCV's (x right, y down, z forward) of the upright picture. Device: what
Android and iOS call the device's axes, x to the right and y to the top of the screen in portrait, z out of the screen.

The back camera looks along -z of the device. Held in portrait its picture has the screen's right as its right (+x)
and the screen's bottom as its down (-y), so the camera's axes in the device's frame are the columns of diag(1, -1, -1),
half a turn about x. Turn the phone clockwise by the angle a, as the person filming sees it: in the device's frame the
upright picture turns by a the other way about the screen's normal, so R_dc(a) = Rz(a) diag(1, -1, -1). At 90 degrees
the picture's right is +y and its down is +x. With the device to world rotation R_nd of the log, R_nc = R_nd R_dc(a).
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.errors import PblError

CAMERA, DEVICE = "camera", "device"
_COLUMNS = ("time_s", "qw", "qx", "qy", "qz")
_SETTINGS = ("frame", "rotation_deg")
#: Shorter than this, four numbers tell no direction.
_SHORTEST_NORM = 1e-3
#: Phones turn the recording upright, so a picture that lies by more is a wrong log; a person's hand does not tilt so.
_MOST_ROLL_DEG = 60.0
#: Closer to the vertical than this, a viewing direction has no roll to judge.
_VERTICAL_DEG = 30.0


@dataclasses.dataclass(frozen=True)
class Attitude:
    """The phone's orientation over one recording. Validated and brought to unit length when made.

    Attributes
    ----------
    time_s : (P,) float64
        Seconds, 0 at about the video's first frame (the fit finds the small offset left); strictly increasing.
    quat_wxyz : (P, 4) float64
        R_nc, camera to world, as unit quaternions (w, x, y, z); neighbours have the same sign.
    source
        Where it comes from.
    """

    time_s: np.ndarray
    quat_wxyz: np.ndarray
    source: str = ""

    def __post_init__(self) -> None:
        time_s, quat_wxyz = check_attitude(self.time_s, self.quat_wxyz, self.source or None)
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "quat_wxyz", quat_wxyz)


def check_attitude(time_s: object, quat_wxyz: object, key: object = None) -> tuple[np.ndarray, np.ndarray]:
    """(P,) times and (P, 4) unit quaternions without a jump from q to -q, or an error.

    Raises
    ------
    PblError
        PHONE_LOG: other shapes, fewer than two samples, values that are not finite, stamps that repeat or run
        backwards, a quaternion of length (nearly) zero.
    """
    try:
        time, quat = np.asarray(time_s, np.float64), np.asarray(quat_wxyz, np.float64)
    except (TypeError, ValueError) as error:
        raise _log_error(f"values that are no numbers ({error})", "numbers", key) from error
    if time.ndim != 1 or quat.shape != (len(time), 4):
        raise _log_error(f"times of shape {time.shape}, quaternions of shape {quat.shape}", "(P,) and (P, 4)", key)
    if len(time) < 2:
        raise _log_error(f"{len(time)} samples", "at least two", key)
    for name, array in (("times", time), ("quaternions", quat)):
        bad = int(np.sum(~np.isfinite(array.reshape(len(time), -1)).all(axis=1)))
        if bad:
            raise _log_error(f"{bad} of {len(time)} {name} not finite", "finite numbers; leave such samples out", key)
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        i = int(back[0])
        found = (
            f"{len(back)} stamps that repeat or run backwards, the first at {time[i + 1]:.6g} s after {time[i]:.6g} s"
        )
        raise _log_error(found, "strictly increasing times; sort them and leave out repeats", key)
    norm = np.linalg.norm(quat, axis=1, keepdims=True)
    if not np.all((norm > _SHORTEST_NORM) & np.isfinite(norm)):
        found = f"{int(np.sum(~(norm > _SHORTEST_NORM)))} quaternions of length near zero"
        raise _log_error(found, "quaternions of length 1; leave such samples out", key)
    quat = quat / norm
    # q and -q are one rotation, but what lies half way between them is none.
    turned = np.cumsum(np.sum(quat[1:] * quat[:-1], axis=1) < 0) % 2 == 1
    quat[1:][turned] *= -1
    return time, quat


def camera_in_device(rotation_deg: float = 0.0) -> Rotation:
    """R_dc, back camera to device, for a phone turned clockwise by `rotation_deg` from portrait (module docstring)."""
    return Rotation.from_euler("z", rotation_deg, degrees=True) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def load_attitude(path: str | Path) -> Attitude:
    """Read an orientation log: CSV or JSON with time_s, qw, qx, qy, qz (docs/files.md, section attitude log).

    The optional `frame` ("camera", the default, or "device") says what the quaternions turn into the world, the
    optional `rotation_deg` (0, 90, 180, 270; only with "device") how the phone was held. Both hold for the whole file.

    Raises
    ------
    PblError
        FILE_MISSING: no such file. PHONE_LOG: neither CSV nor JSON, a field missing, what `check_attitude` refuses,
        an unknown frame, or a log by which the upright picture would lie on its side or stand on its head (a wrong
        `frame` or `rotation_deg`, or quaternions that turn the other way).
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise PblError(
            "FILE_MISSING",
            found=error.strerror or str(error),
            expected="an orientation log, CSV or JSON",
            next_step="check the path, and that you may read the file",
            key=str(path),
        ) from error
    except UnicodeDecodeError as error:
        raise _log_error("no text", "CSV or JSON with " + ", ".join(_COLUMNS), path) from error
    fields, settings = _read_json(path, text) if text.lstrip()[:1] in ("{", "[") else _read_csv(path, text)
    time, quat = check_attitude(fields[0], np.stack(fields[1:], axis=1), path)
    frame, rotation_deg = _settings(path, settings)
    if frame == DEVICE:
        turns = Rotation.from_quat(quat, scalar_first=True) * camera_in_device(rotation_deg)
        quat = turns.as_quat(scalar_first=True)
    _check_roll(path, quat, frame)
    return Attitude(time, quat, path.name)


def _read_csv(path: Path, text: str) -> tuple[list[np.ndarray], dict[str, object]]:
    rows = csv.DictReader((t for t in text.splitlines() if t.strip() and t[0] != "#"), skipinitialspace=True)
    try:
        table = list(rows)
        names = [(n or "").strip() for n in rows.fieldnames or ()]
    except csv.Error as error:
        raise _log_error(f"no CSV ({error})", "CSV with the columns " + ", ".join(_COLUMNS), path) from error
    _check_names(path, names)
    table = [{(k or "").strip(): v for k, v in row.items()} for row in table]
    columns = []
    for name in _COLUMNS:
        try:
            columns.append(np.array([float(row[name]) for row in table], np.float64))
        except (TypeError, ValueError) as error:
            raise _log_error(f"column {name}: {error}", "a number in each row", path) from error
    settings: dict[str, object] = {}
    for name in _SETTINGS:
        values = {str(row.get(name) or "").strip() for row in table} - {""}
        if len(values) > 1:
            raise _log_error(f"column {name} holds {', '.join(sorted(values))}", "one value in the whole file", path)
        if values:
            settings[name] = values.pop()
    return columns, settings


def _read_json(path: Path, text: str) -> tuple[list[np.ndarray], dict[str, object]]:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise _log_error(f"no JSON ({error})", "an object with " + ", ".join(_COLUMNS), path) from error
    if not isinstance(content, dict):
        raise _log_error("JSON that is no object", "an object with " + ", ".join(_COLUMNS), path)
    _check_names(path, list(content))
    columns = []
    for name in _COLUMNS:
        try:
            columns.append(np.asarray(content[name], np.float64))
        except (TypeError, ValueError) as error:
            raise _log_error(f"field {name}: {error}", "a list of numbers", path) from error
    if len({c.shape for c in columns}) > 1 or columns[0].ndim != 1:
        shapes = ", ".join(f"{n} {c.shape}" for n, c in zip(_COLUMNS, columns, strict=True))
        raise _log_error(shapes, "five lists of the same length", path)
    return columns, {name: content[name] for name in _SETTINGS if name in content}


def _check_names(path: Path, names: list[str]) -> None:
    missing = [n for n in _COLUMNS if n not in names]
    if missing:
        raise _log_error(f"no {', '.join(missing)}", "the fields " + ", ".join(_COLUMNS), path)


def _settings(path: Path, settings: dict[str, object]) -> tuple[str, float]:
    frame, turned = settings.get("frame", CAMERA), settings.get("rotation_deg", 0)
    if frame not in (CAMERA, DEVICE):
        raise _log_error(f"frame {frame!r}", f"{CAMERA} or {DEVICE}", path)
    try:
        rotation_deg = float(turned)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        rotation_deg = math.nan
    if rotation_deg not in (0.0, 90.0, 180.0, 270.0):
        raise _log_error(f"rotation_deg {turned!r}", "0, 90, 180 or 270", path)
    if rotation_deg and frame == CAMERA:
        found = f"rotation_deg {rotation_deg:g} with frame {CAMERA}"
        raise _log_error(
            found, f"rotation_deg only with frame {DEVICE}: the camera's frame is the upright picture's", path
        )
    return str(frame), rotation_deg


def _check_roll(path: Path, quat_wxyz: np.ndarray, frame: str) -> None:
    """Refuse a log by which the picture lies on its side for most of the time (median)."""
    up_cam = Rotation.from_quat(quat_wxyz, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    clear = np.hypot(up_cam[:, 0], up_cam[:, 1]) > math.sin(math.radians(_VERTICAL_DEG))
    if not clear.any():
        return
    # Up in the picture is -y; a roll to the right of the picture counts positive.
    roll = np.degrees(np.arctan2(up_cam[clear, 0], -up_cam[clear, 1]))
    if np.median(np.abs(roll)) <= _MOST_ROLL_DEG:
        return
    typical = float(roll[np.argsort(np.abs(roll))[len(roll) // 2]])
    raise PblError(
        "PHONE_LOG",
        found=f"by this log (frame {frame}) the upright picture is turned by {typical:.0f} deg against gravity",
        expected="a picture that stands upright, within what a hand tilts",
        next_step="check `frame` (device: the phone's own axes) and `rotation_deg` (0 portrait, 90 top to the right, "
        "270 top to the left), and that the quaternions turn the phone's vectors into the world and not back",
        key=str(path),
    )


def _log_error(found: str, expected: str, key: object) -> PblError:
    return PblError(
        "PHONE_LOG",
        found=found,
        expected=expected,
        next_step="see docs/files.md, section attitude log; without --attitude the camera is taken as still",
        key=None if key is None else str(key),
    )
