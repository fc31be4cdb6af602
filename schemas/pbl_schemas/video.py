"""Recordings and the properties of their files."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.files import sha256_of
from pbl_pipeline.records import definition, from_row, number, to_row
from pbl_pipeline.results.video_facts import OF_FILE
from pbl_pipeline.results.video_facts import VideoInfo as Info
from pbl_pipeline.words import UNUSABLE

from . import lab, session  # noqa: F401  the definitions refer to them
from .datajoint_setup import dj
from .origin import Origin, computes, origin_columns
from .rows import Rows, one, row_of, stored_rows
from .stored_files import file_ref, read_stored

if TYPE_CHECKING:
    from pbl_pipeline.gait import Condition

schema = dj.Schema()

ONE_OF_SEVERAL = "one of several"
CAMERA_MOTIONS = ("static", "handheld", ONE_OF_SEVERAL)
#: Of a recording without a camera: laboratory markers.
NO_CAMERA = "none"


@schema
class Video(dj.Manual):
    definition = f"""
    # a video file of one trial, or a file of laboratory markers (MarkerRecording)
    video_id        : int32
    ---
    -> session.Session
    -> [nullable] lab.CameraCalibration
    {definition(Info, only=("path",))}
    video_name      : varchar(255)             # name of the file
    {definition(Info, only=("sha256", "size_bytes"))}
    activity        : varchar(32)              # what the subject does, such as walking
    camera_motion   : enum('static', 'handheld', 'one of several', 'none')  # none: laboratory markers
    video_created   : datetime                 # when registered, UTC
    unique index (video_sha256)
    """


@schema
class Pace(dj.Manual):
    definition = """
    # how fast a video is walked; one without a row counts as the pace that the person chose
    -> Video
    ---
    pace            : varchar(32)              # self_selected, fast, slow, dual_task, or the study's own word
    """


@schema
class MarkerRecording(dj.Manual):
    definition = """
    # a recording that is no video but laboratory markers: it goes straight to the fit, with the others of its session
    -> Video
    ---
    recording_marker_set     : varchar(64)     # where on the body the markers sit: a shipped set, or the stem of marker_table_file
    marker_table_sha256=''   : varchar(64)     # of the bytes of marker_table_file, empty where the set ships
    vertical_axis            : enum('y', 'z')  # as stated for the file, z for .npz; fits turn a trial whose body stands along another axis
    recording_n_frames       : int32           # frames
    recording_n_markers      : int16           # markers of the set that the file has
    recording_duration       : float64         # (s) from the first to the last frame
    recording_in_view_share  : float64         # (0..1) share of frames with enough markers to be fitted
    markers_file             : <object@arrays> # npz: time_s (T) s, xyz_world_m (T,J,3) m, z up, confidence (T,J) 0..1; docs/files.md
    marker_table_file=null   : <object@arrays> # CSV of a marker set of the laboratory's own; null where the set ships
    """  # noqa: E501


@schema
class Rig(dj.Manual):
    definition = """
    # several calibrated cameras that stand still around one place
    rig_id        : int32
    ---
    rig_sha256    : char(64)                   # of the bytes of rig_file: the same calibration has one number
    rig_cameras   : json                       # names of its cameras, in the order of the file
    rig_created   : datetime                   # when registered, UTC
    rig_file      : <object@arrays>            # TOML of Pose2Sim: lens and pose of each camera; docs/files.md
    unique index (rig_sha256)
    """


@schema
class RigView(dj.Manual):
    definition = """
    # a camera of a trial that several film at once; rig_trial: video_id of the one whose number the trial has
    -> Video
    ---
    -> Rig
    -> Video.proj(rig_trial='video_id')
    rig_camera    : varchar(64)                # the camera of the rig that filmed it
    """


@schema
class NotUsable(dj.Manual):
    definition = f"""
    # recordings that a person marked as not usable: nothing further is computed of them, and no set of a fit takes them
    -> Video
    ---
    unusable_reason  : enum({", ".join(f"'{r}'" for r in UNUSABLE)})
    unusable_note='' : varchar(500)            # more of why, in the person's words; no names
    unusable_by      : varchar(64)             # name of who decided
    unusable_created : datetime                # when, UTC
    """


@schema
class PhoneAttitude(dj.Manual):
    definition = """
    # sensor log of the phone that filmed a video; the keypoints take the camera's orientation from it
    -> Video
    ---
    attitude_name           : varchar(255)     # name of the file or folder
    attitude_sha256         : char(64)         # of the copy's bytes
    attitude_size           : int64            # (byte) length of the copy
    attitude_form           : varchar(32)      # format; docs/phone_capture.md
    attitude_device=''      : varchar(128)     # phone, as the log names it
    attitude_n              : int32            # orientations
    attitude_rate           : float64          # (1/s) orientations per second, by the sampling interval
    attitude_duration       : float64          # (s) from the first to the last
    attitude_start_utc=null : varchar(40)      # moment of the first, null where the log does not count in UTC
    attitude_sensors        : json             # other sensors in it: name to number of samples
    attitude_notes          : json             # what was left out in reading
    attitude_created        : datetime         # when registered, UTC
    attitude_file           : <object@arrays> # the log; a folder as zip
    """


@schema
class WearableImu(dj.Manual):
    definition = """
    # log of inertial sensors that the person wore at the visit of a video; the fit of the visit reads it
    -> Video
    imu               : int16                  # number of the file, from 1
    ---
    imu_name          : varchar(255)           # name of the file
    imu_segments=null : json                   # segment of the body, such as shank_r, to the name of its sensor in the file; null: kept, not read
    imu_rate=null     : float64                # (1/s) samples a second, as a person stated; null: the file says it
    imu_mounts=null   : json                   # segment to where two axes of its sensor point, such as x up, z back, as a person stated; null: none
    imu_sha256        : char(64)               # of its bytes
    imu_size          : int64                  # (byte) length
    imu_created       : datetime               # when registered, UTC
    imu_file          : <object@arrays>       # the file
    """  # noqa: E501


@schema
class DepthVideo(dj.Manual):
    definition = """
    # depth recording beside a video of one camera; the fit of the visit reads it
    -> Video
    ---
    depth_name       : varchar(255)            # name of the file or folder
    depth_read=null  : bool                    # false, and null of older rows: kept, not read
    depth_scale=null : float64                 # (m) one step of its 16-bit pictures, as a person stated; null: the recording says it
    depth_sha256     : char(64)                # of the copy's bytes
    depth_size       : int64                   # (byte) length of the copy
    depth_created    : datetime                # when registered, UTC
    depth_file       : <object@arrays>        # the recording; a folder as zip
    """  # noqa: E501


@schema
class VideoInfo(dj.Computed):
    definition = f"""
    # what the file holds; sizes after the rotation flag is applied
    -> Video
    ---
    {definition(Info, without=OF_FILE)}
    frame_time           : <npy@arrays>       # (s) float64 (T): the container's own time stamps, first frame 0
    {origin_columns("video_info")}
    """

    @property
    def key_source(self) -> Any:
        """Files with pictures, but those that a person marked as not usable before they were read."""
        return Video.proj() - MarkerRecording.proj() - NotUsable.proj()

    def make_fetch(self, key: dict) -> tuple:
        return one(Video & key, "video_path", "video_sha256")

    @computes
    def make_compute(self, key: dict, path: str, sha256: str) -> tuple[Info]:
        from pbl_pipeline.video import probe

        return (probe(registered_file(path, sha256, key)),)

    def make_insert(self, key: dict, info: Info, origin: Origin) -> None:
        row = {**to_row(info, without=OF_FILE), "frame_time": info.time_s}
        self.insert1({**key, **row, **origin.row("video_info")})


def probed(key: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the joined row of Video and VideoInfo, and the file of its time stamps: what `make_fetch` hands on."""
    row = one(Video * VideoInfo & key)
    return row, file_ref(row.pop("frame_time"))


def read_probed(row: Mapping[str, Any], times: Mapping[str, Any], key: dict) -> tuple[Path, Info]:
    """Return the file and the facts of a video from what `probed` returned. Raises as `registered_file`."""
    path = registered_file(row["video_path"], row["video_sha256"], key)
    return path, from_row(Info, row, time_s=read_stored(times, functools.partial(np.load, allow_pickle=False)))


def conditions(videos: Any) -> dict[int, Condition]:
    """The library's `Condition` of each video of a query or restriction, by its number."""
    from pbl_pipeline.gait import Condition

    found = (Video & videos).proj("activity")
    paces = {int(r["video_id"]): r["pace"] for r in (Pace & found.proj()).to_dicts()}
    rows = found.to_dicts(order_by="video_id")
    return {(v := int(r["video_id"])): Condition(r["activity"], paces.get(v, "")) for r in rows}


def condition(video_id: int, rows: Rows = stored_rows) -> Condition:
    """The library's `Condition` of one video."""
    from pbl_pipeline.gait import Condition

    key = {"video_id": video_id}
    paces = [r["pace"] for r in rows(Pace, key)]
    return Condition(row_of(Video, key, rows)["activity"], paces[0] if paces else "")


def camera_of(row: Mapping[str, Any]) -> dict[str, Any] | None:
    """The calibration that counts for a video, by its joined row of Video and VideoInfo: its own, else that of the
    phone which recorded it; None if there is neither.

    A row of CameraCalibration, and `turn_deg`: how far its picture has to be turned clockwise to be this video's.
    """
    from pbl_pipeline.video import phone_lens

    if row["camera_id"] is not None:
        return {**one(lab.CameraCalibration & {"camera_id": row["camera_id"]}), "turn_deg": 0}
    lens = phone_lens(from_row(Info, row, time_s=np.zeros(0)))
    if lens is None:
        return None
    of_device = (lab.DeviceCalibration & (lab.Device & lab.device_columns(lens)) & lab.mode_columns(lens)).to_dicts()
    if not of_device or not lens.same_focal(number(of_device[0]["device_focal_35mm"])):
        return None
    found = one(lab.CameraCalibration & {"camera_id": of_device[0]["camera_id"]})
    found["camera_note"] += f", of {of_device[0]['device']}"
    return {**found, "turn_deg": int(row["rotation"]) - int(of_device[0]["stored_rotation"])}


def present_file(video_id: int) -> Path:
    """Return the file of a video if it is there; its bytes are not compared with those that were registered. Raises
    `PblError` DB_NOT_FOUND, VIDEO_MISSING."""
    path = Path(registered_video(video_id)["video_path"])
    if not path.is_file():
        raise _missing(path, {"video_id": video_id})
    return path


def registered_video(video_id: int) -> dict[str, Any]:
    """Return the row of Video of a number. Raises `PblError` DB_NOT_FOUND for a number that no video has."""
    rows = (Video & {"video_id": video_id}).to_dicts()
    if not rows:
        raise unknown_video(video_id)
    return rows[0]


def unknown_video(video_id: int) -> PblError:
    return PblError(
        "DB_NOT_FOUND",
        found=f"no video_id {video_id}",
        expected="a registered video",
        next_step="`pbl list videos` prints the numbers, and `pbl status` those that wait for a choice",
    )


def registered_file(path: str, sha256: str, key: dict) -> Path:
    """The video file, after checking that it is still the one that was registered. Raises `PblError` VIDEO_MISSING,
    VIDEO_CHANGED."""
    from pbl_pipeline.video import check_file

    if not Path(path).is_file():
        raise _missing(path, key)
    found = sha256_of(check_file(path))
    if found != sha256:
        raise PblError(
            "VIDEO_CHANGED",
            found=said("{path} has SHA-256 {sum}", path=path, sum=found),
            expected=f"SHA-256 {sha256}, as registered",
            next_step="restore the original file, then `pbl populate --retry-errors`; "
            "or `pbl ingest` the changed file as a separate video",
            key=f"video_id={key['video_id']}",
        )
    return Path(path)


def _missing(path: str | Path, key: Mapping[str, Any]) -> PblError:
    return PblError(
        "VIDEO_MISSING",
        found=said("no file at {path}", path=path),
        expected="the file that was registered",
        next_step="bring the file or its disk back, then `pbl populate --retry-errors`; "
        "if it lies elsewhere now, `pbl ingest` the new path and the row takes it over",
        key=f"video_id={key['video_id']}",
    )
