"""`.c3d`: markers, segment poses, events and the phone's sensors, for gait laboratories' programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.extras import needed
from pbl_pipeline.names import shortened
from pbl_pipeline.video import SENSORS

from . import plug_in_gait
from .trial import EvenTrial, ExportTrial

#: Labels and icon numbers of the events, as Vicon and Mokka write them.
_EVENTS = {"foot_down": ("Foot Strike", 1), "foot_up": ("Foot Off", 2)}
#: The frame numbers of a C3D have 16 bits, and c3d reads no frame of a file whose last one is 65535.
_LAST_FRAME = 65534
#: Most values of a parameter, whose sizes have 8 bits: further ones go into LABELS2 and so on, as Vicon writes them.
_MOST_VALUES = 255
#: Longest name of a marker: 255 of them fill a parameter, whose length has 15 bits.
_LONGEST_NAME = 127
#: Bytes for events and names of markers: all parameters have 255 blocks of 512 bytes.
_MOST_BYTES = 120_000
#: Bytes of an event without its subject.
_EVENT_BYTES = 43
#: Most analog samples per frame: enough for a phone's sensors at 25 frames a second.
_MOST_PER_FRAME = 20
#: Longest gap between samples of a sensor that is interpolated (s).
_SENSOR_GAP_S = 0.1


def write_c3d(trial: ExportTrial, path: Path, origin: Mapping[str, str], name: str = "", names: str = "") -> None:
    """Write points (mm), 4x4 poses of the bodies, events, and the phone's sensors if the trial has its log.

    The points are the fitted markers, or with `names` `plug_in_gait.NAMES` that model's markers and angles (deg).

    The axes are those of our world: z up. A C3D has one rate: frames at uneven times are interpolated to their median
    rate, as stated by the parameter PBL:TIMES. Unknown points and poses have residual -1 and NaN. `check_c3d` is
    called before.

    Raises `PblError` PACKAGE_MISSING without ezc3d.
    """
    ezc3d: Any = needed("ezc3d.ezc3d", "writing C3D files")
    even = trial.even
    file = _Parameters(ezc3d)
    # In this order: ezc3d accepts no further channel once it knows the rate of the points.
    for point in _point_names(trial, names):
        file.low.point(point)
    analogs = _sensors(file, trial, even)
    points, residuals = _points(file, trial, names)
    poses = _poses(file, trial, even)
    _events(file, trial, name)
    file.add("MANUFACTURER", "COMPANY", ["pbl-pipeline"])
    file.add("MANUFACTURER", "SOFTWARE", [origin["software"]])
    file.add("SUBJECTS", "USED", [1 if name else 0])
    if name:
        file.add("SUBJECTS", "NAMES", [name])
    for key, value in origin.items():
        file.add("PBL", key.upper(), [shortened(value, 250)])
    file.add("PBL", "TIMES", ["interpolated to an even rate" if even.resampled else "as filmed"])
    file.low.header().firstFrame(even.first)
    # ezc3d's `write` expects the masks as bool and leaks the memory of their conversion, 0.4 MB for 8 s of 33 points.
    masks = np.zeros((7, *points.shape[1:]))
    file.low.import_numpy_data(points, residuals, masks, analogs, poses)
    file.low.write(str(path), ezc3d.WriteOptions())


class _Parameters:
    """A new file of ezc3d, whose parameters are set from plain values."""

    def __init__(self, ezc3d: Any) -> None:
        self.ezc3d, self.low = ezc3d, ezc3d.c3d()

    def add(self, group: str, name: str, values: Sequence[str] | Sequence[int] | np.ndarray) -> None:
        """Set texts, whole numbers, or an array of floats, whose first dimension runs fastest in the file."""
        made = self.ezc3d.Parameter(name)
        if isinstance(values, np.ndarray):
            made.set(self.ezc3d.VecDouble(values.T.ravel().astype(float).tolist()), values.shape)
        elif values and isinstance(values[0], str):
            made.set(self.ezc3d.VecString(list(values)), [len(values)])
        else:
            made.set(self.ezc3d.VecInt([int(v) for v in values]), [len(values)])
        if not self.low.parameters().isGroup(group):
            self.low.parameters().group(self.ezc3d.Group(group))
        self.low.parameter(group, made)


def _point_names(trial: ExportTrial, names: str) -> tuple[str, ...]:
    return (*plug_in_gait.MARKERS, *plug_in_gait.ANGLES) if names else trial.fit.marker_names


def check_c3d(trial: ExportTrial, name: str = "", names: str = "") -> None:
    """Raise `PblError` EXPORT_INPUT if frames, events or names of markers do not fit into the fields of a C3D."""
    even, markers = trial.even, _point_names(trial, names)
    n, first, longest = len(even.time_s), even.first, max(map(len, markers))
    events = 0 if trial.measured is None else len(trial.measured.events.events)
    most = max(0, _MOST_BYTES - len(markers) * longest) // (_EVENT_BYTES + len(name))
    for wrong, found, expected, next_step in (
        (
            first < 0 or first + n > _LAST_FRAME,
            f"frames {first + 1} to {first + n} at {even.rate_hz:.3g} Hz",
            f"frames 1 to {_LAST_FRAME}: a C3D counts them in 16 bits",
            "cut the recording, or export the other formats",
        ),
        (
            longest > _LONGEST_NAME or len(markers) * longest > _MOST_BYTES,
            f"{len(markers)} markers with names of up to {longest} characters",
            f"at most {_LONGEST_NAME} characters each, {_MOST_BYTES} in all: the limit of a C3D's parameters",
            "shorten the names in the table and fit again, or export the other formats",
        ),
        (
            events > most,
            f"{events} events",
            f"at most {most}: the limit of a C3D's parameters",
            "cut the recording, or export its events with --to csv",
        ),
    ):
        if wrong:
            raise PblError("EXPORT_INPUT", found=found, expected=expected, next_step=next_step, key=trial.name)


def _points(file: _Parameters, trial: ExportTrial, names: str) -> tuple[np.ndarray, np.ndarray]:
    """(4, J, N) points in mm (angles: deg) and (1, J, N) residuals."""
    xyz = 1e3 * (plug_in_gait.markers_m(trial) if names else trial.even.markers_m)
    file.add("POINT", "RATE", np.array([trial.even.rate_hz]))
    file.add("POINT", "UNITS", ["mm"])
    if names:
        xyz = np.concatenate([xyz, plug_in_gait.angles_deg(trial)], axis=1)
        file.add("POINT", "ANGLES", list(plug_in_gait.ANGLES))
        file.add("POINT", "ANGLE_UNITS", ["deg"])
    xyz = xyz.transpose(2, 1, 0)
    file.add("POINT", "X_SCREEN", ["+X"])
    file.add("POINT", "Y_SCREEN", ["+Z"])
    points = np.concatenate([xyz, np.ones((1, *xyz.shape[1:]))])
    return points, np.where(np.isnan(xyz[:1]), -1.0, 0.0)


def _poses(file: _Parameters, trial: ExportTrial, even: EvenTrial) -> np.ndarray:
    """Frames of the bodies (x forward, y up, z right) as (4, 4, B, N) matrices, body to world, translation in mm."""
    names = trial.poses.body.body_names
    pose = np.full((4, 4, len(names), len(even.rotation)), np.nan)
    pose[:3, :3] = even.rotation.transpose(2, 3, 1, 0)
    pose[:3, 3] = 1e3 * even.position_m.transpose(2, 1, 0)
    pose[3] = np.array([0.0, 0.0, 0.0, 1.0])[:, None, None]
    pose[:, :, np.isnan(pose[0, 0])] = np.nan
    file.add("ROTATION", "LABELS", [f"{n}_4X4" for n in names])
    file.add("ROTATION", "DESCRIPTIONS", ["body to laboratory; x forward, y up, z right"] * len(names))
    file.add("ROTATION", "RATIO", [1])
    return pose


def _events(file: _Parameters, trial: ExportTrial, name: str) -> None:
    found = () if trial.measured is None else trial.measured.events.events
    found = sorted(found, key=lambda e: e.time_s)
    if not found:
        file.add("EVENT", "USED", [0])
        return
    file.add("EVENT", "USED", [len(found)])
    for part, start in enumerate(range(0, len(found), _MOST_VALUES), 1):
        some, ending = found[start : start + _MOST_VALUES], str(part) if part > 1 else ""
        # Minutes and seconds, from frame 1.
        times = np.array(np.divmod([e.time_s for e in some], 60.0))
        for key, values in (
            ("CONTEXTS", [e.side.capitalize() for e in some]),
            ("LABELS", [_EVENTS[e.event][0] for e in some]),
            ("DESCRIPTIONS", ["initial contact" if e.event == "foot_down" else "toe-off" for e in some]),
            ("SUBJECTS", [name] * len(some)),
            ("TIMES", times),
            ("ICON_IDS", [_EVENTS[e.event][1] for e in some]),
            ("GENERIC_FLAGS", [0] * len(some)),
        ):
            file.add("EVENT", f"{key}{ending}", values)
    file.add("EVENT_CONTEXT", "USED", [2])
    file.add("EVENT_CONTEXT", "LABELS", ["Left", "Right"])
    file.add("EVENT_CONTEXT", "ICON_IDS", [0, 0])


def _sensors(file: _Parameters, trial: ExportTrial, even: EvenTrial) -> np.ndarray:
    """The phone's sensors as analog channels, interpolated to a multiple of the frames' rate; NaN outside the log."""
    log = trial.log
    if log is None or not log.sensors:
        # Programs that cut a recording by events want a rate and a unit, also of no channel.
        file.add("ANALOG", "RATE", np.array([even.rate_hz]))
        file.add("ANALOG", "UNITS", ["V"])
        return np.zeros((1, 0, 0))
    wanted = max(len(s.time_s) / max(float(np.ptp(s.time_s)), 1e-9) for s in log.sensors.values() if len(s.time_s) > 1)
    ratio = min(max(1, math.ceil(wanted / even.rate_hz - 0.05)), _MOST_PER_FRAME)
    at = (even.first + np.arange(len(even.time_s) * ratio) / ratio) / even.rate_hz
    labels, units, channels = [], [], []
    for sensor, samples in log.sensors.items():
        time = samples.time_s + trial.log_shift_s
        for k, axis in enumerate("xyz"):
            labels.append(f"phone_{sensor}_{axis}")
            units.append(SENSORS[sensor][1] if sensor in SENSORS else "m/s^2")
            channels.append(_at(time, samples.xyz[:, k], at))
    for label in labels:
        file.low.analog(label)
    file.add("ANALOG", "RATE", np.array([even.rate_hz * ratio]))
    file.add("ANALOG", "UNITS", units)
    file.add("ANALOG", "SCALE", np.ones(len(labels)))
    return np.array(channels)[None]


def _at(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Linear interpolation; NaN beyond the samples and in gaps longer than `_SENSOR_GAP_S`."""
    out = np.interp(at, time, values, left=np.nan, right=np.nan)
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    return np.where(time[after] - time[after - 1] > _SENSOR_GAP_S, np.nan, out)
