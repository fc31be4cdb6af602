"""Calibrations of cameras as rows, and those that serve every video of a phone's lens (`pbl camera`).

Which one counts for a video is `video.camera_of`, asked when its keypoints are computed. A calibration that is
registered, corrected or removed deletes exactly the keypoints that were made with another one than counts now, and
dependent results; the next populate recomputes them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label
from pbl_pipeline.paramset import canonical_json
from pbl_pipeline.records import from_row, number, to_row
from pbl_pipeline.results import VideoInfo

from .. import keypoints, lab, video
from ..queues import forget_errors
from ..rows import delete_below, utc_now
from ..transactions import in_transaction, next_id

if TYPE_CHECKING:
    from pbl_pipeline.video import Camera, PhoneLens


def camera_row(camera: Camera, size_px: tuple[int, int]) -> dict[str, Any]:
    """Return the library's `Camera` of upright pictures (width, height) as a row of CameraCalibration, without its
    number. Raises `PblError` USAGE for the name of a file or camera with control characters."""
    check_label("name of the calibration", camera.source, 1000)
    # Only what is known: calibrations that were stored without `camera_focal_sd` keep their hash.
    row = {name: value for name, value in to_row(camera.measured(size_px)).items() if value is not None}
    return {**row, "camera_sha256": hashlib.sha256(canonical_json(row).encode()).hexdigest()}


def known_camera(camera: Mapping[str, Any]) -> int | None:
    """Number of the calibration of this `camera_row`; None if it is not registered."""
    known = (lab.CameraCalibration & {"camera_sha256": camera["camera_sha256"]}).keys()
    return int(known[0]["camera_id"]) if known else None


def camera_id_of(camera: Mapping[str, Any]) -> int:
    """Number of the calibration of this `camera_row`, which is inserted where it is new."""
    known = known_camera(camera)
    if known is not None:
        return known
    camera_id = next_id(lab.CameraCalibration, "camera_id")
    lab.CameraCalibration.insert1({**camera, "camera_id": camera_id})
    return camera_id


@dataclasses.dataclass(frozen=True)
class CalibrationChange:
    """A change of a device's calibration."""

    device: str
    camera_id: int | None  # its number now, None: removed
    before: int | None  # its number before, None: there was none
    deleted: dict[str, int]  # deleted rows by table
    videos: frozenset[int]  # whose keypoints were deleted


def add_calibration(file: str | Path, like: str | Path | None = None) -> CalibrationChange:
    """Register the calibration in `file` for all videos of its phone's lens, size and rate without another calibration.
    It takes the place of an older one. `like`: a recording of the phone, where the file does not name it.

    Raises what `pbl_pipeline.video.load_lens_calibration` raises.
    """
    from pbl_pipeline.video import load_lens_calibration

    found = load_lens_calibration(file, like)

    def insert() -> list[CalibrationChange]:
        key = {"device": _device(found.lens), **lab.mode_columns(found.lens)}
        row = {
            **key,
            "camera_id": camera_id_of(camera_row(found.camera, found.size_px)),
            "stored_rotation": found.rotation_deg,
            "device_focal_35mm": found.lens.focal_35mm,
            "device_calibrated": utc_now(),
        }
        return [_replace(key, row)]

    (change,) = _retried(in_transaction(insert))
    return change


def remove_calibration(camera_id: int) -> list[CalibrationChange]:
    """Withdraw a calibration from the devices that it is registered for. Videos that have it as their own keep it.
    Raises `PblError` DB_NOT_FOUND: no device has this calibration."""
    rows = (lab.DeviceCalibration & {"camera_id": camera_id}).to_dicts()
    if not rows:
        there = sorted({int(n) for n in lab.DeviceCalibration.to_arrays("camera_id")})
        found = f"no device with calibration {camera_id}"
        expected = f"one of {', '.join(map(str, there))}" if there else "a device with a calibration"
        raise PblError("DB_NOT_FOUND", found, expected, "`pbl camera list` shows the numbers")
    keys = [{k: row[k] for k in lab.DeviceCalibration.primary_key} for row in rows]
    return _retried(in_transaction(lambda: [_replace(key, None) for key in keys]))


def _replace(key: dict[str, Any], row: dict[str, Any] | None) -> CalibrationChange:
    """Put a row of DeviceCalibration, or none, in the place of that with this key; delete the outdated keypoints."""
    before = (lab.DeviceCalibration & key).to_dicts()
    (lab.DeviceCalibration & key).delete_quick()
    if row is not None:
        lab.DeviceCalibration.insert1(row)
    outdated = _outdated(key)
    now, old = (None if r is None else int(r["camera_id"]) for r in (row, before[0] if before else None))
    deleted = delete_below(keypoints.Keypoints, outdated)
    return CalibrationChange(key["device"], now, old, deleted, frozenset(key["video_id"] for key in outdated))


def _retried(changes: list[CalibrationChange]) -> list[CalibrationChange]:
    """Forget errors of the other calibration. Not in a transaction: it may declare job tables."""
    for video_id in sorted(frozenset().union(*(change.videos for change in changes))):
        forget_errors(video_id)
    return changes


def calibrations() -> list[dict[str, Any]]:
    """The calibrations of devices: rows of DeviceCalibration, Device and CameraCalibration, `lens` (the library's
    `PhoneLens`) and `n_keypoints`, the keypoints that were made with each."""
    from pbl_pipeline.video import PhoneLens

    used = [int(n) for n in (keypoints.Keypoints & "keypoints_camera_id IS NOT NULL").to_arrays("keypoints_camera_id")]
    query = lab.DeviceCalibration * lab.Device * lab.CameraCalibration.proj(..., "-device")
    rows = query.to_dicts(order_by=list(lab.DeviceCalibration.primary_key))
    for row in rows:
        make, model, lens = (row[f"device_{part}"] for part in ("make", "model", "lens"))
        size = (int(row["stored_width"]), int(row["stored_height"]))
        row["lens"] = PhoneLens(make, model, lens, size, int(row["capture_rate"]))
        row["n_keypoints"] = used.count(int(row["camera_id"]))
    return rows


def _device(lens: PhoneLens) -> str:
    columns = lab.device_columns(lens)
    known = (lab.Device & columns).keys()
    if known:
        return str(known[0]["device"])
    plain = re.sub(r"[^a-z0-9.]+", "-", lens.name.lower()).strip("-") or "phone"
    taken = set(lab.Device.to_arrays("device"))
    names = [plain[:64], *(f"{plain[:60]}-{n}" for n in range(2, 1000))]
    name = next(n for n in names if n not in taken)
    lab.Device.insert1({"device": name, **columns})
    return name


def _outdated(key: dict[str, Any]) -> list[dict[str, Any]]:
    """Keys of the keypoints of this device, size and rate (`key` of DeviceCalibration) for whose video another
    calibration counts than they were made with."""
    from pbl_pipeline.video import phone_lens

    device = (lab.Device & {"device": key["device"]}).fetch1()
    names = {f"phone_{name}": device[f"device_{name}"] or None for name in ("make", "model", "lens")}
    recorded = (video.Video & "camera_id IS NULL") * (video.VideoInfo & names)
    made = (keypoints.Keypoints & recorded.proj()).proj("keypoints_camera_id").to_dicts()
    registered = (lab.DeviceCalibration & key).to_dicts()
    counts: dict[int, int | None] = {}
    for row in recorded.proj(..., "-frame_time").to_dicts() if made else ():
        lens = phone_lens(from_row(VideoInfo, row, time_s=np.zeros(0)))
        if lens is None or any(key[name] != value for name, value in lab.mode_columns(lens).items()):
            continue
        fits = bool(registered) and lens.same_focal(number(registered[0]["device_focal_35mm"]))
        counts[row["video_id"]] = int(registered[0]["camera_id"]) if fits else None
    return [
        {name: row[name] for name in keypoints.Keypoints.primary_key}
        for row in made
        if row["video_id"] in counts and row["keypoints_camera_id"] != counts[row["video_id"]]
    ]
