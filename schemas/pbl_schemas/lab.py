"""Projects, subjects, populations, devices, camera calibrations."""

from __future__ import annotations

from typing import Any

from pbl_pipeline.records import definition
from pbl_pipeline.results.video_facts import Intrinsics

from .datajoint_setup import dj

schema = dj.Schema()


@schema
class Numbered(dj.Manual):
    definition = """
    # highest number ever given, which outlives the row that had it: no number is given twice
    numbered        : varchar(32)              # column, such as video_id
    ---
    numbered_last   : int32
    """


@schema
class Project(dj.Manual):
    definition = """
    # a study or clinic
    project            : varchar(32)           # short name
    ---
    project_title=''   : varchar(200)          # full title
    """


@schema
class Population(dj.Lookup):
    definition = """
    # group that a subject belongs to
    population              : varchar(32)      # short name
    ---
    population_description  : varchar(200)
    """
    contents = (
        {"population": "unknown", "population_description": "not stated"},
        {"population": "healthy", "population_description": "no known disorder that affects walking"},
        {"population": "patient", "population_description": "a disorder that affects walking"},
    )


@schema
class Subject(dj.Manual):
    definition = """
    # a person, by pseudonymous code only: never a name, initials or a birth date
    subject               : varchar(32)        # code of the person
    ---
    -> [nullable] Project
    -> Population
    subject_height=null   : float64            # (m) measured body height
    subject_created       : datetime           # when registered, UTC
    """


@schema
class Device(dj.Manual):
    definition = """
    # model of a recording device
    device           : varchar(64)             # short name, such as pixel-8-rear
    ---
    device_make=''   : varchar(64)
    device_model=''  : varchar(64)
    device_lens=''   : varchar(128)            # lens as the phone names it, empty where its files name none
    """


@schema
class CameraCalibration(dj.Manual):
    definition = f"""
    # intrinsics of an upright frame
    camera_id                : int32
    ---
    -> [nullable] Device
    {definition(Intrinsics)}
    camera_sha256            : char(64)        # over all of the above, so that one calibration is stored once
    unique index (camera_sha256)
    """


@schema
class DeviceCalibration(dj.Manual):
    definition = """
    # calibration of all videos of a device at one size and rate that have none of their own
    -> Device
    stored_width      : int32                  # (px) of the picture as stored, before the rotation flag is applied
    stored_height     : int32                  # (px) likewise
    capture_rate      : int16                  # (1/s) the nearest of 30, 60, 120, 240
    ---
    -> CameraCalibration
    stored_rotation   : int16                  # (deg) rotation flag of the calibration video, whose upright picture was measured
    device_focal_35mm=null : float64           # (mm) on 35 mm film, as that video states it: a video of another one is not of this lens
    device_calibrated : datetime               # when registered, UTC
    """  # noqa: E501


def device_columns(lens: Any) -> dict[str, str]:
    """The library's `PhoneLens` as columns of Device."""
    return {"device_make": lens.make[:64], "device_model": lens.model[:64], "device_lens": lens.lens[:128]}


def mode_columns(lens: Any) -> dict[str, int]:
    """Size and rate of the library's `PhoneLens` as columns of DeviceCalibration."""
    return {"stored_width": lens.stored_px[0], "stored_height": lens.stored_px[1], "capture_rate": lens.rate}
