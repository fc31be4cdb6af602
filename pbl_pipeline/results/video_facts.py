"""Facts of a video file and of a camera."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.records import column, record

#: Fields of `VideoInfo` that stand in the row of the file, not in that of its facts.
OF_FILE = ("path", "sha256", "size_bytes")
#: Kinds of sources of intrinsics, the most accurate first; `other` if a source names none of them.
CAMERA_KINDS = ("file", "measured", "metadata", "preset", "guess", "other")


@record
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

    path: str = column("video_path", "where the file lies, absolute", "varchar(1000)")
    width_px: int = column("width", "(px) of the upright frame", "int32", before="fps")
    height_px: int = column("height", "(px) of the upright frame", "int32", before="fps")
    rotation_deg: int = column("rotation", "(deg) rotation flag of the file", "int16", before="fps")
    make: str | None = column("phone_make", type="varchar(64)", cut="tag", before="capture_fps")
    model: str | None = column("phone_model", type="varchar(64)", cut="tag", before="capture_fps")
    lens: str | None = column(
        "phone_lens", "lens as the phone names it", "varchar(128)", cut="tag", before="capture_fps", default=None
    )
    focal_35mm: float | None = column(
        "focal_35mm",
        "(mm) focal length of the same view on 35 mm film, as the file states it",
        before="capture_fps",
        default=None,
    )


@record(kw_only=True)
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

    sha256: str = column("video_sha256", "of its bytes: the same file is never registered twice", "char(64)")
    size_bytes: int = column("video_size", "(byte) length of the file", "int64")
    container: str = column("container", type="varchar(64)", cut="tag")
    codec: str = column("codec", type="varchar(32)", cut="tag")
    pixel_format: str = column("pixel_format", type="varchar(32)", cut="tag")
    time_s: np.ndarray
    fps: float = column("fps", "(1/s) 1 / sampling interval, a description only", null=True)
    duration_s: float = column("duration", "(s) from the first frame to the end of the last", null=True)
    n_frames: int = column("n_frames", "frames that decode", "int32")
    n_frames_announced: int = column("n_frames_announced", "frames the header claims, 0 when it says nothing", "int32")
    variable_frame_rate: bool = column("variable_frame_rate", "whether frame intervals differ", "bool")
    recorded_utc: str | None = column("recorded_utc", "recording time as the file states it", "varchar(40)", cut="tag")
    notes: tuple[str, ...] = column(
        "video_notes", "remarks on the file, such as a mirrored picture", "json", before="(end)", default=()
    )
    capture_fps: float | None = column("capture_fps", "(1/s) rate at which the phone says it recorded", default=None)


@record
class Intrinsics:
    """Figures of a calibrated camera, for upright pictures."""

    origin: str = column("camera_origin", "how the figures were had", "enum('measured', 'exif', 'preset', 'estimated')")
    width_px: int = column("camera_width", "(px) width of the upright frame they hold for", "int32")
    height_px: int = column("camera_height", "(px) height of the upright frame they hold for", "int32")
    fx_px: float = column("camera_fx", "(px) focal length, horizontal")
    fy_px: float = column("camera_fy", "(px) focal length, vertical")
    cx_px: float = column("camera_cx", "(px) principal point from the left edge")
    cy_px: float = column("camera_cy", "(px) principal point from the upper edge")
    distortion: np.ndarray = column("camera_distortion", "k1 k2 p1 p2 k3 (-), OpenCV's order", "json")
    focal_sd_px: float | None = column(
        "camera_focal_sd", "(px) standard deviation of the focal length, null when unknown"
    )
    # The hash of a calibration holds it: cut as in stored rows.
    note: str = column("camera_note", "file or rule they come from", "varchar(255)", cut="tag")
