"""A phone's log brought to its video: the camera's orientation on the video's clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .attitude import DEVICE, Attitude, camera_in_device, check_roll, held_deg, log_error
from .clock import align_clock
from .phone_log import PhoneLog
from .phone_log_reader import read_phone_log
from .types import VideoInfo


def load_attitude(path: str | Path, video: VideoInfo | None = None) -> Attitude:
    """Read a phone's sensor log (docs/phone_capture.md): R_nc of the camera on the video's clock.

    With the probed `video`, how the phone was held is taken from it where the log does not say, and a log on another
    clock is brought to the video's (`align_clock`, which may read the pictures). Without it, the phone was held in
    portrait, and time 0 of the log is the first frame.

    Raises `PblError` FILE_MISSING, PHONE_LOG: see `read_phone_log`; a log by which the upright picture would lie on its
    side or stand on its head (a wrong `frame` or `rotation_deg`, or quaternions that turn the other way); a log of
    another time than the video's; a video of the front camera.
    """
    path = Path(path)
    return attitude_of(read_phone_log(path), path, video)


def attitude_of(log: PhoneLog, path: Path, video: VideoInfo | None = None) -> Attitude:
    """The camera's orientation from a log that was read; see `load_attitude`."""
    quat = log.quat_wxyz
    if log.frame == DEVICE:
        if video is not None and "front" in (video.lens or "").lower():
            raise log_error(f"a video of the {video.lens}", "the camera on the phone's back", path)
        turned = log.rotation_deg
        if turned is None:
            turned = held_deg(video, quat) if video is not None else 0.0
        turns = Rotation.from_quat(quat, scalar_first=True) * camera_in_device(turned)
        quat = turns.as_quat(scalar_first=True)
    check_roll(path, quat, log.frame)
    shift_s, how = (0.0, "") if video is None else align_clock(log, np.asarray(quat), video, path)
    return Attitude(log.time_s + shift_s, quat, f"{path.name} ({log.form})" + (f": {how}" if how else ""))
