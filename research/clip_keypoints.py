"""Keypoints of the subject of a clip, by the stages of the chain."""

from __future__ import annotations

from pathlib import Path

from pbl_pipeline.keypoints import KeypointParams, Keypoints, detect_keypoints
from pbl_pipeline.methods import Method
from pbl_pipeline.tracking import choose_subject, require_subject, track_people
from pbl_pipeline.video import find_camera, frames_kept, probe


@frames_kept()
def clip_keypoints(video: Path, sheet: Path, keypoints: Method[KeypointParams] | None = None) -> Keypoints:
    """Return the keypoints of a clip's subject; `keypoints`: the method, None the default.

    `sheet` is the picture of the people that is written where one must be chosen. Raises what the stages raise.
    """
    info = probe(video)
    tracking = track_people(video, info=info)
    subject = require_subject(choose_subject(tracking), tracking, video, sheet)
    return detect_keypoints(video, tracking, subject, find_camera(info), params=keypoints)
