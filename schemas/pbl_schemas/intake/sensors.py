"""Files that belong to a video, copied to the store: the phone's log, depth recording, logs of wearable sensors."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pbl_pipeline.errors import PblError, joined, said
from pbl_pipeline.files import sha256_of, zipped
from pbl_pipeline.names import check_label
from pbl_pipeline.records import number
from pbl_pipeline.temporary import TemporaryFolder, new_folder

from .. import fit, keypoints, session, video
from ..queues import forget_errors
from ..rows import counted, delete_below, utc_now
from ..store import unkept
from ..transactions import keep_files
from .records import usage

if TYPE_CHECKING:
    from pbl_pipeline.depth import DepthFile
    from pbl_pipeline.sensors import Given, Read
    from pbl_pipeline.video import PhoneLog

#: As a path of `--attitude`, `--depth` or `--imu`: none for this video or at its visit, or no longer.
NONE = "none"
_KINDS = {"attitude": "phone's log", "depth": "depth recording", "imu": "wearable sensor's log"}
_NOT_READ = ", kept and not read: not a folder, .r3d or zip (docs/depth.md)"


class Kept(NamedTuple):
    """A file, or the zip of a folder, as it goes to the store, with its SHA-256."""

    file: Path
    sha256: str


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Sensor files of one video; None and () change nothing. attitude: a log, or `NONE`; depth: a recording, or
    `NONE`; imu: sensors that the person wore at its visit; samples: reads a log of them once, None: `read` makes it;
    kept: what goes to the store of each kind and path, once they were read; room: the folder of their copies, until
    `remove_copies`; together: the logs of the visit that were read together (`at_visit`); notes: on these."""

    attitude: Path | None = None
    depth: DepthFile | None = None
    imu: Sequence[Given] = ()
    samples: Read | None = None
    kept: Mapping[tuple[str, Path], Kept] = dataclasses.field(default_factory=dict)
    room: TemporaryFolder | None = None
    together: Sequence[str] = ()
    notes: Sequence[str] = ()

    def __bool__(self) -> bool:
        return self.attitude is not None or self.depth is not None or bool(self.imu)

    @property
    def has_log(self) -> bool:
        """True if a log comes with it."""
        return self.attitude is not None and str(self.attitude) != NONE

    def read(self) -> tuple[Sensors, PhoneLog | None]:
        """Read the logs, if there are any, and check that the other files exist; returns these files with the names of
        the sensors in them and what is kept of them, and the phone's log. Raises `PblError` FILE_MISSING, PHONE_LOG;
        FILE_FORMAT for a file without bytes; DEPTH_FILE, PACKAGE_MISSING as `check_recording` and `pack`; SENSOR_LOG,
        USAGE as `sensors_in`, `once`; USAGE for a name that cannot be kept; STORE_FULL: no room to zip a folder.
        """
        from pbl_pipeline.sensors import once, read_samples, sensors_in
        from pbl_pipeline.video import read_phone_log

        for prefix, path in self._there():
            check_label(f"name of the {_KINDS[prefix]}", path.name, 255)
            if prefix != "attitude" and not path.is_dir():
                _check_there(path)
        samples = self.samples or functools.cache(read_samples)
        found = iter(once(sensors_in([given for given in self.imu if given.segment is not None], samples)))
        imu = [g if g.segment is None else dataclasses.replace(g, sensor=next(found)[1].name) for g in self.imu]
        log = read_phone_log(self.attitude) if self.has_log and self.attitude is not None else None
        return dataclasses.replace(self, imu=imu, kept={}, samples=samples).packed(), log

    def at_visit(self, logs: Sequence[dict[str, Any]], recorded: Mapping[str, str | None]) -> Sensors:
        """These files, which `read` read, after their logs of wearable sensors were read with those that stay at their
        visit (`fit.worn_logs`), as its fit does: outside of a transaction. Raises `PblError` as `fit.read_worn`."""
        after, _, changed = _with(logs, self.imu, self.kept)
        notes = fit.read_worn(after, recorded, self.samples)[1] if changed else ()
        return dataclasses.replace(self, together=_state(after), notes=notes, samples=None)

    def _there(self) -> list[tuple[str, Path]]:
        files = [("attitude", self.attitude), ("depth", self.depth and self.depth.file)]
        files += [("imu", given.file) for given in self.imu]
        return list(dict.fromkeys((prefix, path) for prefix, path in files if path and str(path) != NONE))

    def packed(self) -> Sensors:
        """These files, which were read, with what is kept of them; themselves while their copies are there. Raises
        `PblError` as `read`."""
        from pbl_pipeline.depth import check_recording, pack

        kept: dict[tuple[str, Path], Kept] = {}
        there, room = self._there(), None
        if len(self.kept) == len(there) and (self.room is None or self.room.path.exists()):
            return self
        try:
            room = new_folder() if any(path.is_dir() for _, path in there) else None
            if self.depth is not None and ("depth", self.depth.file) in there:
                check_recording(self.depth)
            for prefix, path in there:
                zip_of = pack if prefix == "depth" else _zipped
                copy = zip_of(path, room.path / f"{prefix}{len(kept)}.zip") if room and path.is_dir() else path
                kept[prefix, path] = Kept(copy, sha256_of(copy))
        except OSError as error:
            raise unkept(error) from error
        finally:
            if room and len(kept) < len(there):
                room.cleanup()
        return dataclasses.replace(self, kept=kept, room=room)

    def remove_copies(self) -> None:
        """Remove the zips of folders."""
        if self.room is not None:
            self.room.cleanup()


def attach(video_id: int, given: Sensors, log: PhoneLog | None) -> list[str]:
    """Insert what the video does not have yet, of files that were read (`Sensors.read`, `Sensors.at_visit`); returns it
    in words. Call it in a transaction. Raises `PblError` DECIDED_MEANWHILE for other logs at the visit than were read.

    Another log or recording (or none) takes the older one's place, and what was computed with that is deleted: with a
    phone's log keypoints and after, with depths the fit and after.
    """
    key = {"video_id": video_id}
    done = []
    if given.attitude is not None:
        done += _attach_log(key, given.attitude, given.kept, log)
    if given.depth is not None:
        done += _attach_depth(key, given.depth, given.kept)
    return done + _attach_sensors(key, given)


def attach_worn(session_id: int, worn: Sensors) -> list[str]:
    """Attach logs of wearable sensors, which were read, to a visit that has a video; returns it in words. Raises
    `PblError` USAGE without a video, what `keep_files` and `attach` raise."""
    videos = (video.Video & {"session_id": session_id}).to_arrays("video_id")
    if not len(videos):
        raise usage("sensors of a visit without a recording", "at least one recording", next_step="film first")
    return attach_now(int(min(videos)), worn)


def attach_now(video_id: int, worn: Sensors) -> list[str]:
    """Attach sensors that a person wore, which were read, in a transaction; returns it in words."""
    done = keep_files(lambda: attach(video_id, worn, None))
    if done:
        forget_errors(video_id)  # fits of the visit may have failed by its older sensors
    return done


def _attach_log(
    key: dict[str, Any], path: Path, kept: Mapping[tuple[str, Path], Kept], log: PhoneLog | None
) -> list[str]:
    table = video.PhoneAttitude & key
    if log is None:
        if not table:
            return []
        table.delete(prompt=False)
        return ["the phone's log was removed" + delete_keypoints(key["video_id"])]
    about = {
        "attitude_form": log.form[:32],
        "attitude_device": log.device[:128],
        "attitude_n": len(log.time_s),
        "attitude_rate": log.rate_hz,
        "attitude_duration": float(log.time_s[-1] - log.time_s[0]),
        "attitude_start_utc": _utc(log),
        "attitude_sensors": {name: len(s.time_s) for name, s in log.sensors.items()},
        "attitude_notes": list(log.notes),
    }
    how = _keep(video.PhoneAttitude, "attitude", key, path, kept, about)
    if not how:
        return []
    return [
        f"the phone's log of {len(log.time_s)} orientations ({log.form}) was {how}" + delete_keypoints(key["video_id"])
    ]


def _attach_depth(key: dict[str, Any], given: DepthFile, kept: Mapping[tuple[str, Path], Kept]) -> list[str]:
    """Attach a depth recording to a video, or remove its older one, and delete the fits that were made otherwise."""
    table, removed = video.DepthVideo & key, str(given.file) == NONE
    before = [(r["depth_sha256"], bool(r["depth_read"]), number(r["depth_scale"])) for r in table.to_dicts()]
    now = [] if removed else [(kept["depth", given.file].sha256, given.known, given.scale_m)]
    if before == now:
        return []
    session.lock(int((video.Video & key).fetch1("session_id")))  # no fit is inserted from here on
    table.delete(prompt=False)
    done = ["the depth recording was removed"]
    if not removed:
        about = {"depth_read": given.known, "depth_scale": given.scale_m}
        _keep(video.DepthVideo, "depth", key, given.file, kept, about)
        how = "replaced" if before else "attached"
        done = [f"depth recording {given.file.name} was {how}" + ("" if given.known else _NOT_READ)]
    was_read = any(read for _, read, _ in before + now)
    if was_read and (rows := counted(fit.delete_depth_fits(key["video_id"]))):
        done.append(f"what was fitted before was deleted: {rows}")
    return done


def _with(
    logs: Sequence[dict[str, Any]], given: Sequence[Given], kept: Mapping[tuple[str, Path], Kept]
) -> tuple[list[dict[str, Any]], list[str], bool]:
    """Return the logs of wearable sensors of a visit (`fit.worn_logs`) after others came, of which one of a segment
    takes the place of the older one; new ones have no key yet. Also what was done, in words, and whether the fit of the
    visit reads others than before."""
    files: dict[tuple[Path, float | None], tuple[dict[str, str], dict[str, str]]] = {}
    for one in given:
        own, mounts = files.setdefault((one.file, one.rate_hz), ({}, {}))
        own |= {} if one.segment is None else {one.segment: one.sensor or ""}
        mounts |= {one.segment: one.mount} if one.segment and one.mount else {}
    rows, done, changed = list(logs), [], False
    for (file, rate), (own, mounts) in files.items():
        sha256 = None if str(file) == NONE else kept["imu", file].sha256
        if same := next((r for r in rows if r["imu_sha256"] == sha256), None):  # further sensors of a file
            before, rate = same["imu_segments"] or {}, rate if own else same["imu_rate"]
            others = {s: name for s, name in before.items() if s not in own and name not in own.values()}
            own, mounts = others | own, {s: m for s, m in (same["imu_mounts"] or {}).items() if s in others} | mounts
            if (before, same["imu_rate"], same["imu_mounts"] or {}) == (own, rate, mounts):
                continue
        rows, older, replaced = [], rows, []
        for row in older:
            segments = row["imu_segments"] or {}
            left = {s: name for s, name in segments.items() if s not in own}
            changed |= left != segments or (sha256 is None and bool(segments))
            replaced += [row["imu_name"]] if left != segments and row["imu_sha256"] != sha256 else []
            if sha256 not in (None, row["imu_sha256"]) and (left or not segments):
                still = {s: m for s, m in (row["imu_mounts"] or {}).items() if s in left}
                rows.append(row if left == segments else row | {"imu_segments": left, "imu_mounts": still or None})
        if sha256 is None:
            done += ["the wearable sensors were removed"] if older else []
            continue
        about = {"imu_segments": own or None, "imu_rate": rate, "imu_mounts": mounts or None}
        rows.append({"imu_name": file.name, "imu_sha256": sha256, "imu_file": file, **about})
        where = "kept and not read: no segment of the body is known"
        where = said("sensors on {segments}", segments=joined(sorted(own))) if own else where
        instead = said(" instead of {names}", names=", ".join(replaced)) if replaced else ""
        name = file.name
        text = said("wearable IMU file {name} was attached{instead}, {where}", name=name, instead=instead, where=where)
        done.append(text)
        changed |= bool(own)
    return rows, done, changed


def _attach_sensors(key: dict[str, Any], given: Sensors) -> list[str]:
    """Attach logs of wearable sensors to a video, and delete the fits of its visit that were made without them."""
    if not given.imu:
        return []
    visit = int((video.Video & key).fetch1("session_id"))
    session.lock(visit)  # no fit is inserted from here on
    before = fit.worn_logs({"session_id": visit})[0]
    logs, done, changed = _with(before, given.imu, given.kept)
    if changed:
        _check_read(logs, given.together)
    stay = {(row["video_id"], row["imu"]): row for row in logs if "imu" in row}
    for row in before:
        of_row, now = {k: row[k] for k in video.WearableImu.primary_key}, stay.get((row["video_id"], row["imu"]))
        if now is None:
            (video.WearableImu & of_row).delete(prompt=False)
        elif now is not row:
            video.WearableImu.update1(of_row | {k: now[k] for k in ("imu_segments", "imu_mounts")})
    for row in (row for row in logs if "imu" not in row):
        number = max((int(n) for n in (video.WearableImu & key).to_arrays("imu")), default=0) + 1
        about = {k: row[k] for k in ("imu_segments", "imu_rate", "imu_mounts")}
        _keep(video.WearableImu, "imu", {**key, "imu": number}, row["imu_file"], given.kept, about)
    if changed:
        done += given.notes
        if rows := counted(fit.delete_sensor_fits(visit)):
            done.append(said("what was fitted without them was deleted: {rows}", rows=rows))
    return done


def _state(logs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what a fit reads of the logs of wearable sensors of a visit, to be compared."""
    read = ("imu_sha256", "imu_segments", "imu_rate", "imu_mounts")
    return sorted(json.dumps([log[c] or None for c in read], sort_keys=True) for log in logs if log["imu_segments"])


def _check_read(logs: Sequence[Mapping[str, Any]], together: Sequence[str]) -> None:
    if _state(logs) != together:
        found = "other logs of wearable sensors came to this visit meanwhile"
        expected = "those that were read together with these; nothing was written"
        raise PblError("DECIDED_MEANWHILE", found, expected, "do it again")


def read_carried(numbers: Sequence[int], subject: str, session_label: str) -> list[str]:
    """Read the logs of wearable sensors that these videos take along to a visit with those that it has, outside of a
    transaction. Returns what `hand_on` compares. Raises `PblError` as `fit.read_worn`."""
    visit = session.Session & {"subject": subject, "session_label": session_label}
    logs, recorded = fit.worn_logs([visit, *({"video_id": n} for n in numbers)])
    fit.read_worn(logs, recorded)
    return _state(logs)


def hand_on(numbers: Sequence[int], old: int, new: int, read: Sequence[str]) -> None:
    """Give the logs of wearable sensors of videos that were moved to another video of their old visit; without one they
    stay, and the fits of the new visit are deleted. Call it in a transaction. Raises `PblError` DECIDED_MEANWHILE
    unless the new visit has the logs that were `read` (`read_carried`).
    """
    if not (carried := carriers(numbers)):
        return
    session.lock(new)
    heirs = (video.Video & {"session_id": old}).to_arrays("video_id")
    if not len(heirs):
        _check_read(fit.worn_logs({"session_id": new})[0], read)
        fit.delete_sensor_fits(new)
        return
    heir, table = int(min(heirs)), video.WearableImu.full_table_name
    last = max((int(n) for n in (video.WearableImu & {"video_id": heir}).to_arrays("imu")), default=0)
    for i, row in enumerate(carried, last + 1):  # DataJoint does not change a key
        video.WearableImu.connection.query(
            f"UPDATE {table} SET video_id = %s, imu = %s WHERE video_id = %s AND imu = %s",  # noqa: S608
            args=(heir, i, int(row["video_id"]), int(row["imu"])),
        )


def carriers(numbers: Sequence[int]) -> list[dict[str, Any]]:
    """Keys of the logs of wearable sensors that are attached to these videos and belong to their visit."""
    rows = (video.WearableImu & [{"video_id": v} for v in numbers]).proj("imu_segments").to_dicts()
    return [row for row in rows if row["imu_segments"]]


def _keep(
    table: Any,
    prefix: str,
    key: dict[str, Any],
    path: Path,
    kept: Mapping[tuple[str, Path], Kept],
    about: dict[str, Any] | None = None,
) -> str:
    """Insert a file, or the zip of a folder, as the row with this key; return "attached", "replaced" for an older one,
    or "" for the same bytes."""
    file, sha256 = kept[prefix, path]
    before = (table & key).to_dicts()
    if before and before[0][f"{prefix}_sha256"] == sha256:
        return ""
    (table & key).delete(prompt=False)
    table.insert1(
        {
            **key,
            f"{prefix}_name": path.name[-255:],
            f"{prefix}_sha256": sha256,
            f"{prefix}_size": file.stat().st_size,
            f"{prefix}_created": utc_now(),
            f"{prefix}_file": file,
            **(about or {}),
        }
    )
    return "replaced" if before else "attached"


def delete_keypoints(video_id: int) -> str:
    """Delete the keypoints of a video with their dependent results; returns it in words, "" for none."""
    key = {"video_id": video_id}
    rows = counted(delete_below(keypoints.Keypoints, (keypoints.Keypoints & key).keys()))
    return f", and what depends on it was deleted: {rows}" if rows else ""


def _zipped(path: Path, copy: Path) -> Path:
    """Write the tables of a phone's log as a zip."""
    names = [f.name for f in path.iterdir() if f.suffix.lower() in (".csv", ".json") and f.is_file()]
    return zipped(path, copy, names, zipfile.ZIP_DEFLATED)


def _check_there(path: Path) -> None:
    try:
        size = path.stat().st_size if path.is_file() else -1
    except OSError:
        size = -1
    if size < 0:
        about = "no such file, or it cannot be read", "a file to keep with the video", "check the path"
        raise PblError("FILE_MISSING", *about, key=str(path))
    if size == 0:
        about = "0 bytes", "a file as the app or the instrument wrote it", "copy it again"
        raise PblError("FILE_FORMAT", *about, key=str(path))


def _utc(log: PhoneLog) -> str | None:
    """Moment of the first orientation, where the log counts in UTC."""
    if log.start_utc_s is None:
        return None
    when = datetime.datetime.fromtimestamp(log.start_utc_s + float(log.time_s[0]), datetime.UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
