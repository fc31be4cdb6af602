"""Files that belong to a video, copied to the store: the phone's sensor log, depth video, wearable IMUs."""

from __future__ import annotations

import dataclasses
import datetime
import shutil
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError

from . import keypoints, video
from .rows import delete_below, utc_now
from .stored_files import new_folder

if TYPE_CHECKING:
    from pbl_pipeline.video import PhoneLog

#: As a path of `--attitude`: no log for this video, or no longer.
NONE = "none"


@dataclasses.dataclass(frozen=True)
class Sensors:
    """What is registered with one video; None and () leave things as they are. attitude: a log, or `NONE`."""

    attitude: Path | None = None
    depth: Path | None = None
    imu: Sequence[Path] = ()

    def __bool__(self) -> bool:
        return self.attitude is not None or self.depth is not None or bool(self.imu)

    @property
    def has_log(self) -> bool:
        """Whether a log comes with it."""
        return self.attitude is not None and str(self.attitude) != NONE


@dataclasses.dataclass(frozen=True)
class Read:
    """Files that were found good, before anything is inserted."""

    given: Sensors
    log: PhoneLog | None = None


def read(given: Sensors) -> Read:
    """Read the log and see that the other files are there.

    Raises
    ------
    PblError
        FILE_MISSING, PHONE_LOG; FILE_FORMAT for a file without bytes.
    """
    from pbl_pipeline.video import read_phone_log

    for path in (given.depth, *given.imu):
        if path is not None:
            _check_there(path)
    log = given.attitude if given.has_log else None
    return Read(given, None if log is None else read_phone_log(log))


def register(video_id: int, found: Read) -> list[str]:
    """Insert what the video does not have yet, in words. Call it in a transaction.

    Another log (or none) takes the older one's place, and what was computed with that is deleted: keypoints and after.
    """
    key = {"video_id": video_id}
    done = []
    if found.given.attitude is not None:
        done += _register_log(key, found)
    if found.given.depth is not None:
        done += _register_depth(key, found.given.depth)
    for path in found.given.imu:
        done += _register_imu(key, path)
    return done


def _register_log(key: dict[str, Any], found: Read) -> list[str]:
    from pbl_pipeline.video import sha256_of

    table, path = video.PhoneAttitude, found.given.attitude
    assert path is not None
    before = (table & key).to_dicts()
    if found.log is None:
        if not before:
            return []
        (table & key).delete(prompt=False)
        return ["the phone's log was removed" + _outdated(key)]
    with new_folder() as folder:
        copy = folder / f"attitude{path.suffix if path.is_file() else '.zip'}"
        _copy(path, copy)
        sha256 = sha256_of(copy)
        if before and before[0]["attitude_sha256"] == sha256:
            return []
        (table & key).delete(prompt=False)
        log = found.log
        table.insert1(
            {
                **key,
                "attitude_name": path.name[-255:],
                "attitude_sha256": sha256,
                "attitude_size": copy.stat().st_size,
                "attitude_form": log.form[:32],
                "attitude_device": log.device[:128],
                "attitude_n": len(log.time_s),
                "attitude_rate": log.rate_hz,
                "attitude_duration": float(log.time_s[-1] - log.time_s[0]),
                "attitude_start_utc": _utc(log),
                "attitude_sensors": {name: len(s.time_s) for name, s in log.sensors.items()},
                "attitude_notes": list(log.notes),
                "attitude_created": utc_now(),
                "attitude_file": copy,
            }
        )
    what = f"log of {len(log.time_s)} orientations ({log.form})"
    return [f"the phone's {what} was {'replaced' if before else 'attached'}" + _outdated(key)]


def _outdated(key: dict[str, Any]) -> str:
    deleted = delete_below(keypoints.Keypoints, (keypoints.Keypoints & key).keys())
    rows = ", ".join(f"{n} of {name}" for name, n in deleted.items())
    return f", and what depends on it was deleted: {rows}" if rows else ""


def _register_depth(key: dict[str, Any], path: Path) -> list[str]:
    from pbl_pipeline.video import sha256_of

    table = video.DepthVideo
    sha256 = sha256_of(path)
    before = (table & key).to_dicts()
    if before and before[0]["depth_sha256"] == sha256:
        return []
    (table & key).delete(prompt=False)
    with new_folder() as folder:
        copy = folder / f"depth{path.suffix}"
        _copy(path, copy)
        row = {"depth_name": path.name[-255:], "depth_sha256": sha256, "depth_size": copy.stat().st_size}
        table.insert1({**key, **row, "depth_created": utc_now(), "depth_file": copy})
    return [f"depth video {path.name} was {'replaced' if before else 'attached'}"]


def _register_imu(key: dict[str, Any], path: Path) -> list[str]:
    from pbl_pipeline.video import sha256_of

    table = video.WearableImu
    sha256 = sha256_of(path)
    if table & key & {"imu_sha256": sha256}:
        return []
    numbers = [int(n) for n in (table & key).to_arrays("imu")]
    with new_folder() as folder:
        copy = folder / f"imu{path.suffix}"
        _copy(path, copy)
        row = {"imu_name": path.name[-255:], "imu_sha256": sha256, "imu_size": copy.stat().st_size}
        number = {"imu": max(numbers, default=0) + 1}
        table.insert1({**key, **number, **row, "imu_created": utc_now(), "imu_file": copy})
    return [f"wearable IMU file {path.name} was attached"]


def _copy(path: Path, copy: Path) -> None:
    """A file as it is; a folder as a zip whose bytes depend on its files' names and contents only."""
    if path.is_file():
        shutil.copyfile(path, copy)
        return
    with zipfile.ZipFile(copy, "w") as archive:
        for file in sorted(f for f in path.iterdir() if f.suffix.lower() in (".csv", ".json") and f.is_file()):
            member = zipfile.ZipInfo(file.name)
            member.compress_type = zipfile.ZIP_DEFLATED
            with file.open("rb") as source, archive.open(member, "w") as target:
                shutil.copyfileobj(source, target)


def _check_there(path: Path) -> None:
    try:
        size = path.stat().st_size if path.is_file() else -1
    except OSError:
        size = -1
    if size < 0:
        raise PblError(
            "FILE_MISSING",
            found="no such file, or it cannot be read",
            expected="a file to keep with the video",
            next_step="check the path",
            key=str(path),
        )
    if size == 0:
        raise PblError(
            "FILE_FORMAT",
            found="0 bytes",
            expected="a file as the app or the instrument wrote it",
            next_step="copy it again",
            key=str(path),
        )


def _utc(log: PhoneLog) -> str | None:
    """Moment of the first orientation, where the log counts in UTC."""
    if log.start_utc_s is None:
        return None
    when = datetime.datetime.fromtimestamp(log.start_utc_s + float(log.time_s[0]), datetime.UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
