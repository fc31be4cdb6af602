"""Facts of a video file."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import numpy as np

from pbl_pipeline.records import Column

#: Fields of `VideoInfo` that stand in the row of the file, not in that of its facts.
OF_FILE = ("path", "sha256", "size_bytes")


@dataclasses.dataclass(frozen=True)
class FirstPicture:
    """Facts of a video that are known from its first picture. Sizes are as it plays, after the rotation flag.

    Attributes
    ----------
    rotation_deg
        Clockwise rotation of the stored picture to stand upright: 0, 90, 180 or 270.
    make, model, lens
        As the phone wrote them, or None: "Apple", "iPhone 13", "iPhone 13 back dual wide camera 5.1mm f/1.6".
    focal_35mm
        Focal length (mm) of the same view on 35 mm film, or None.
    """

    path: Annotated[str, Column("video_path", "varchar(1000)")]
    width_px: Annotated[int, Column("width", "int32", "(px) of the upright frame", before="fps")]
    height_px: Annotated[int, Column("height", "int32", "(px) of the upright frame", before="fps")]
    rotation_deg: Annotated[int, Column("rotation", "int16", "(deg) rotation flag of the file", before="fps")]
    make: Annotated[str | None, Column("phone_make", "varchar(64)", null=True, before="capture_fps")]
    model: Annotated[str | None, Column("phone_model", "varchar(64)", null=True, before="capture_fps")]
    lens: Annotated[
        str | None, Column("phone_lens", "varchar(128)", "lens as the phone names it", null=True, before="capture_fps")
    ] = None
    focal_35mm: Annotated[
        float | None,
        Column(
            "focal_35mm",
            "float64",
            "(mm) focal length of the same view on 35 mm film, as the file states it",
            null=True,
            before="capture_fps",
        ),
    ] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoInfo(FirstPicture):
    """A probed video.

    Attributes
    ----------
    time_s : (T,) float64
        Presentation time of each frame that decodes, from the container's own stamps, first frame at 0.
    fps
        1 / frame interval (`sampling.interval_of`); for display only: computations use `time_s`.
    n_frames_announced
        Number of frames in the container's header (0 if not stated). Only decoded frames count.
    duration_s
        From the first frame to the end of the last (its length taken as that interval); NaN for a single frame
        whose container announces no rate, as is `fps`.
    variable_frame_rate
        True if an interval differs from the median by more than a tenth and more than the rounding of the stamps.
    recorded_utc
        "2026-01-31T09:15:00Z", or None if not stated.
    capture_fps
        Frames per second at which the phone recorded, or None if not stated. Above `fps` for slow motion, whose stamps
        are slower than the movement.
    notes
        Remarks for the reader: frames hidden by an edit list, repeated stamps, a mirrored picture.
    """

    sha256: Annotated[str, Column("video_sha256", "char(64)")]
    size_bytes: Annotated[int, Column("video_size", "int64")]
    container: Annotated[str, Column("container", "varchar(64)")]
    codec: Annotated[str, Column("codec", "varchar(32)")]
    pixel_format: Annotated[str, Column("pixel_format", "varchar(32)")]
    time_s: np.ndarray
    fps: Annotated[float, Column("fps", "float64", "(1/s) 1 / sampling interval, a description only", null=True)]
    duration_s: Annotated[
        float, Column("duration", "float64", "(s) from the first frame to the end of the last", null=True)
    ]
    n_frames: Annotated[int, Column("n_frames", "int32", "frames that decode")]
    n_frames_announced: Annotated[
        int, Column("n_frames_announced", "int32", "frames the header claims, 0 when it says nothing")
    ]
    variable_frame_rate: Annotated[bool, Column("variable_frame_rate", "bool", "whether frame intervals differ")]
    recorded_utc: Annotated[
        str | None, Column("recorded_utc", "varchar(40)", "recording time as the file states it", null=True)
    ]
    notes: Annotated[
        tuple[str, ...],
        Column("video_notes", "json", "remarks on the file, such as a mirrored picture", before="(end)"),
    ] = ()
    capture_fps: Annotated[
        float | None, Column("capture_fps", "float64", "(1/s) rate at which the phone says it recorded", null=True)
    ] = None
