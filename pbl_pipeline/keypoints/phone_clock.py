"""The clock of a phone's sensor log against that of the video from which keypoints were made."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.video import VIDEO_CLOCK, PhoneLog

from .types import Keypoints


def log_shift_s(log: PhoneLog, keypoints: Keypoints | None, path: str) -> float:
    """Return what added to the log's times gives the video's (s): known where the keypoints hold the log, which was
    brought to the video's clock when they were made, or where the log uses that clock.

    Raises `PblError` PHONE_LOG.
    """
    stamps = None if keypoints is None else keypoints.phone_time_s
    if stamps is not None and len(stamps) == len(log.time_s):
        shift = stamps - log.time_s
        if np.ptp(shift) < 1e-3:
            return float(np.median(shift))
    if log.clock == VIDEO_CLOCK and stamps is None:
        return 0.0
    raise PblError(
        "PHONE_LOG",
        found="a log whose clock against the video's is not known",
        expected="the log that the keypoints beside the fit were made with (--attitude of `pbl detect`), or one on the "
        "video's clock",
        next_step="pass that log, or leave --attitude out",
        key=path,
    )
