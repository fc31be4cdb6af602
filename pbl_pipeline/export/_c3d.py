"""`.c3d`: markers, segment poses, events and the phone's sensors, as gait laboratories' programs read them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.extras import needed
from pbl_pipeline.video import SENSORS

from ._trial import EvenTrial, ExportTrial

#: Labels and icon numbers of the events, as Vicon and Mokka write them.
_EVENTS = {"foot_down": ("Foot Strike", 1), "foot_up": ("Foot Off", 2)}
#: The frame numbers of a C3D have 16 bits.
_LAST_FRAME = 65535
#: Analog samples per frame at most: what a phone's sensors do not exceed at 25 frames a second.
_MOST_PER_FRAME = 20
#: A gap between samples of a sensor that is not filled (s).
_SENSOR_GAP_S = 0.1


def write_c3d(trial: ExportTrial, path: Path, origin: Mapping[str, str], name: str = "") -> None:
    """Write points (mm), 4x4 poses of the bodies, events, and the phone's sensors where the trial has its log.

    The axes are those of our world: z up. A C3D has one rate: frames at uneven times are interpolated to their median
    rate, and the parameter PBL:TIMES says so. Points and poses that are not known have residual -1 and NaN.

    Raises
    ------
    PblError
        PACKAGE_MISSING without ezc3d; EXPORT_INPUT for a trial with more than 65,535 frames.
    """
    ezc3d: Any = needed("ezc3d", "export", "writing C3D files")
    check_frames(trial)
    even = trial.even
    file = ezc3d.c3d()
    file["header"]["points"]["first_frame"] = even.first
    _points(file, trial, even)
    _poses(file, trial, even)
    _sensors(file, trial, even)
    _events(file, trial, name)
    for key, value in (("COMPANY", "pbl-pipeline"), ("SOFTWARE", origin["software"])):
        file.add_parameter("MANUFACTURER", key, [value])
    file.add_parameter("SUBJECTS", "USED", [1 if name else 0])
    if name:
        file.add_parameter("SUBJECTS", "NAMES", [name])
    for key, value in origin.items():
        file.add_parameter("PBL", key.upper(), [value[:250]])
    file.add_parameter("PBL", "TIMES", ["interpolated to an even rate" if even.resampled else "as filmed"])
    file.write(str(path))


def check_frames(trial: ExportTrial) -> None:
    """Raise `PblError` EXPORT_INPUT unless a C3D can number the trial's frames."""
    even = trial.even
    n, first = len(even.markers_m), even.first
    if first < 0 or first + n > _LAST_FRAME:
        raise PblError(
            "EXPORT_INPUT",
            found=f"frames {first + 1} to {first + n} at {even.rate_hz:.3g} Hz",
            expected=f"frames 1 to {_LAST_FRAME}: a C3D counts them in 16 bits",
            next_step="cut the recording, or export the other formats",
            key=trial.name,
        )


def _points(file: Any, trial: ExportTrial, even: EvenTrial) -> None:
    xyz = 1e3 * even.markers_m.transpose(2, 1, 0)
    file["data"]["points"] = np.concatenate([xyz, np.ones((1, *xyz.shape[1:]))])
    missing = np.isnan(xyz[0])
    residuals = np.where(missing, -1.0, 0.0)[None]
    file["data"]["meta_points"] = {"residuals": residuals, "camera_masks": np.zeros((7, *missing.shape), bool)}
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = np.array([even.rate_hz])
    point["UNITS"]["value"] = ["mm"]
    # Those that exceed 255 go to LABELS2: a parameter's dimension has 8 bits.
    point["LABELS"]["value"] = list(trial.fit.marker_names[:255])
    point["DESCRIPTIONS"]["value"] = ["fitted marker"] * min(255, len(trial.fit.marker_names))
    if len(trial.fit.marker_names) > 255:
        file.add_parameter("POINT", "LABELS2", list(trial.fit.marker_names[255:]))
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Z"])


def _poses(file: Any, trial: ExportTrial, even: EvenTrial) -> None:
    """The bodies' frames (x forward, y up, z right) as 4x4 matrices, body to world, translation in mm."""
    names = trial.poses.body.body_names
    pose = np.full((4, 4, len(names), len(even.rotation)), np.nan)
    pose[:3, :3] = even.rotation.transpose(2, 3, 1, 0)
    pose[:3, 3] = 1e3 * even.position_m.transpose(2, 1, 0)
    pose[3] = np.array([0.0, 0.0, 0.0, 1.0])[:, None, None]
    pose[:, :, np.isnan(pose[0, 0])] = np.nan
    file.add_parameter("ROTATION", "LABELS", [f"{n}_4X4" for n in names])
    file.add_parameter("ROTATION", "DESCRIPTIONS", ["body to laboratory; x forward, y up, z right"] * len(names))
    file["data"]["rotations"] = pose


def _events(file: Any, trial: ExportTrial, name: str) -> None:
    found = () if trial.measured is None else trial.measured.events.events
    found = sorted(found, key=lambda e: e.time_s)
    if not found:
        file.add_parameter("EVENT", "USED", [0])
        return
    icons = [_EVENTS[e.event][1] for e in found]
    # Minutes and seconds, from frame 1.
    times = np.array(np.divmod([e.time_s for e in found], 60.0))
    for key, values in (
        ("USED", [len(found)]),
        ("CONTEXTS", [e.side.capitalize() for e in found]),
        ("LABELS", [_EVENTS[e.event][0] for e in found]),
        ("DESCRIPTIONS", ["initial contact" if e.event == "foot_down" else "toe-off" for e in found]),
        ("SUBJECTS", [name] * len(found)),
        ("TIMES", times),
        ("ICON_IDS", icons),
        ("GENERIC_FLAGS", [0] * len(found)),
    ):
        file.add_parameter("EVENT", key, values)
    file.add_parameter("EVENT_CONTEXT", "USED", [2])
    file.add_parameter("EVENT_CONTEXT", "LABELS", ["Left", "Right"])
    file.add_parameter("EVENT_CONTEXT", "ICON_IDS", [0, 0])


def _sensors(file: Any, trial: ExportTrial, even: EvenTrial) -> None:
    """The phone's sensors as analog channels, interpolated to a multiple of the frames' rate; NaN outside the log."""
    log = trial.log
    if log is None or not log.sensors:
        return
    wanted = max(len(s.time_s) / max(float(np.ptp(s.time_s)), 1e-9) for s in log.sensors.values() if len(s.time_s) > 1)
    ratio = min(max(1, math.ceil(wanted / even.rate_hz - 0.05)), _MOST_PER_FRAME)
    at = (even.first + np.arange(len(even.markers_m) * ratio) / ratio) / even.rate_hz
    labels, units, channels = [], [], []
    for sensor, samples in log.sensors.items():
        time = samples.time_s + trial.log_shift_s
        for k, axis in enumerate("xyz"):
            labels.append(f"phone_{sensor}_{axis}")
            units.append(SENSORS[sensor][1] if sensor in SENSORS else "m/s^2")
            channels.append(_at(time, samples.xyz[:, k], at))
    analog = file["parameters"]["ANALOG"]
    analog["RATE"]["value"] = np.array([even.rate_hz * ratio])
    analog["LABELS"]["value"], analog["UNITS"]["value"] = labels, units
    analog["DESCRIPTIONS"]["value"] = ["axes of the phone (docs/phone_capture.md)"] * len(labels)
    analog["SCALE"]["value"] = np.ones(len(labels))
    analog["OFFSET"]["value"] = np.zeros(len(labels), int)
    file["data"]["analogs"] = np.array(channels)[None]


def _at(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Linear interpolation; NaN beyond the samples and in gaps longer than `_SENSOR_GAP_S`."""
    out = np.interp(at, time, values, left=np.nan, right=np.nan)
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    return np.where(time[after] - time[after - 1] > _SENSOR_GAP_S, np.nan, out)
