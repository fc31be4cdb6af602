"""People in a video: the track of each, in figures too, and the choice of who is measured."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.records import column, record

from .video_facts import CAMERA_KINDS

_KIND_TYPE = f"enum({', '.join(map(repr, CAMERA_KINDS))})"


@record
class TrackFigures:
    """One person's track in figures."""

    person_id: int = column("person_id", type="int16", key=True)
    first_frame: int = column("first_frame", "first frame in view", "int32")
    last_frame: int = column("last_frame", "last frame in view", "int32")
    first_time_s: float = column("first_time", "(s) time of the first frame in view")
    last_time_s: float = column("last_time", "(s) time of the last frame in view")
    n_observed: int = column("n_observed", "frames in which the detector saw the person itself", "int32")
    score: float = column("detection_score", "(0..1) median score of those frames")
    height_px: float = column("box_height", "(px) median height of the box")


@record
class PersonTrack:
    """One person over the video. Rows of frames without the person are NaN (score 0)."""

    person_id: int
    box_px: np.ndarray  # (T, 4) x0, y0, x1, y1
    roi_px: np.ndarray  # (T, 4) centre x, centre y, side, rotation (rad)
    score: np.ndarray  # (T,)
    observed: np.ndarray  # (T,) bool: detected in this frame; False where the box is interpolated over a short gap

    def figures(self, time_s: np.ndarray) -> TrackFigures:
        """Return the track in figures. time_s: (T,)."""
        frames, seen = np.flatnonzero(np.isfinite(self.box_px).all(axis=1)), np.asarray(self.observed, bool)
        height = np.median(self.box_px[frames, 3] - self.box_px[frames, 1])
        score = np.median(self.score[seen]) if seen.any() else 0.0
        first, last = frames[0], frames[-1]
        times = float(time_s[first]), float(time_s[last])
        return TrackFigures(self.person_id, first, last, *times, seen.sum(), score, height)


@record
class KeypointFigures:
    """Keypoints of the measured person in figures."""

    marker_set: str = column("marker_set", "names and places of the points", "varchar(32)")
    n_points: int = column("n_points", "points of the marker set", "int16")
    root_relative: bool = column("root_relative", "whether 3D points are relative to the root of the body", "bool")
    n_seen: int = column("n_seen", "frames with at least one point", "int32")
    median_confidence: float = column(
        "median_confidence", "(0..1) median over the points that were seen, null when none was", null=True
    )
    camera_kind: str = column("camera_kind", "where the intrinsics come from", _KIND_TYPE)
    camera_source: str = column("camera_source", "the same in words", "varchar(1000)", cut=True)
    focal_px: float = column("focal_length", "(px) mean of fx and fy")
    focal_rel_sd: float = column(
        "focal_rel_sd", "(1) standard deviation of the focal length as a share of it, null when unknown", null=True
    )


@record
class HiddenHeads:
    """A video with hidden heads in figures."""

    how: str = column(
        "{}_how", "how heads are hidden; skeleton: keypoints on black", "enum('blur', 'pixelate', 'skeleton')"
    )
    status: str = column(
        "{}_status",
        "REVIEW: some frames are to be looked at; NO_HEAD: nothing was covered",
        "enum('CERTAIN', 'REVIEW', 'NO_HEAD')",
    )
    reason: str = column("{}_reason", "the status in words", "varchar(1000)", cut=True)
    n_heads: int = column("{}_heads", "heads that were found, false ones included", "int32")
    n_uncertain: int = column("{}_uncertain", "frames that are not certain", "int32")
    ranges: tuple[dict, ...] = column("{}_ranges", "runs of these: first and last frame (from 0), and why", "json")


@record
class SubjectChoice:
    """Choice of the person to measure."""

    status: str = column("choice_status", type="enum('CHOSEN', 'MANUAL', 'NEEDS_CHOICE', 'NO_PERSON')")
    person_id: int | None = column("chosen_person_id", "null unless CHOSEN or MANUAL", "int16")
    score: float = column("choice_score", "(0..1) score of the chosen person", null=True)
    runner_up_id: int | None = column("runner_up_id", "next best person", "int16")
    runner_up_score: float = column("runner_up_score", "(0..1) score of the next best person", null=True)
    scores: dict[int, float] = column("choice_scores", "person number to score (0..1)", "json")
    reason: str = column("choice_reason", "why, in a sentence", "varchar(2000)", cut=True)  # for clinicians
