"""Keypoints of one tracked person over a video.

Two passes, because the crop decides the quality: the first cuts along the person's track, and its keypoints say where
the body circle really is; the second cuts there, smoothed over time in both directions (nothing is live here). The
crop never feeds on itself from frame to frame, so it cannot wander off to somebody else: where the first pass
contradicts the track, the track wins.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline import assets, progress
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.tracking import Tracking, time_in_view_s
from pbl_pipeline.video import Camera, read_frames

from ._blazepose import MODEL_SHA256, BlazePoseLandmarks
from ._protocol import KeypointDetector, PersonKeypoints
from ._types import Keypoints


@dataclasses.dataclass(frozen=True)
class KeypointParams:
    """Parameters of `detect_keypoints`.

    passes: 1 cuts along the track only, 2 cuts again where the first pass saw the body.
    smooth_s: standard deviation of the Gaussian that smooths the crops over time.
    min_presence: below it a frame has no person and its keypoints are missing.
    max_drift, max_growth: the first pass is believed where its body circle lies within this share of the side from
    the track's, and differs from it in size by at most this factor.
    agree_mm, agree_width_mm: how far the answers for the picture and its mirror image may lie apart, see
    `BlazePoseLandmarks`.
    min_time_s: a person in view for less cannot be measured.
    box_margin: added to the keypoints' box on each side, as a share of its size.
    """

    detector: str = "blazepose"
    model_sha256: str = MODEL_SHA256
    passes: int = 2
    smooth_s: float = 0.1
    min_presence: float = 0.5
    max_drift: float = 0.3
    max_growth: float = 1.5
    agree_mm: float = 100.0
    agree_width_mm: float = 20.0
    min_time_s: float = 1.0
    box_margin: float = 0.1


DEFAULT = "blazepose-33"
PARAMSETS: dict[str, Paramset] = {DEFAULT: Paramset.of("keypoints", DEFAULT, 1, KeypointParams())}


def _blazepose(params: KeypointParams) -> KeypointDetector:
    return BlazePoseLandmarks(assets.fetch("blazepose_landmarks"), params.agree_mm, params.agree_width_mm)


#: Detectors by the name that `KeypointParams.detector` uses. Another detector joins here.
DETECTORS: dict[str, Callable[[KeypointParams], KeypointDetector]] = {"blazepose": _blazepose}


def detect_keypoints(
    video_path: str | Path,
    tracking: Tracking,
    person_id: int,
    camera: Camera,
    params: KeypointParams | None = None,
    detector: KeypointDetector | None = None,
) -> Keypoints:
    """Keypoints of person `person_id` in every frame; NaN with confidence 0 where she or the point is not in view.

    `detector` replaces the one that `params.detector` names. Frames stream.

    Raises `PblError`: SUBJECT_UNKNOWN_PERSON; TRACK_TOO_SHORT when she is in view for less than `min_time_s`;
    VIDEO_CHANGED when the video has other frames than the tracking; SOLVER_UNKNOWN for an unknown detector name;
    those of `video.read_frames` and `assets.fetch`.
    """
    params = params or KeypointParams()
    track = next((p for p in tracking.persons if p.person_id == person_id), None)
    if track is None:
        raise PblError(
            "SUBJECT_UNKNOWN_PERSON",
            found=f"person {person_id}",
            expected=f"one of {', '.join(str(p.person_id) for p in tracking.persons) or 'nobody: no person was found'}",
            next_step="choose one of the numbers that tracking gave",
            key=str(video_path),
        )
    in_view = time_in_view_s(track, tracking.time_s)
    if in_view < params.min_time_s:
        raise PblError(
            "TRACK_TOO_SHORT",
            found=f"person {person_id} is in view for {in_view:.2f} s",
            expected=f"{params.min_time_s:g} s or more; a gait cycle takes about 1.1 s and three or more are wanted",
            next_step="film again so that the whole body stays in the picture for several steps, or choose another "
            "person",
            key=str(video_path),
        )
    if detector is None:
        if params.detector not in DETECTORS:
            raise PblError(
                "SOLVER_UNKNOWN",
                found=f"keypoint detector {params.detector!r}",
                expected=f"one of {', '.join(DETECTORS)}",
                next_step="choose one of these names in the keypoint parameters",
            )
        detector = DETECTORS[params.detector](params)
    track_roi = _rois(track.roi_px, track.box_px)
    roi = smooth_rois(track_roi, tracking.time_s, params.smooth_s)
    if params.passes > 1:
        first = _run(detector, video_path, roi, camera, "crops", quick=True)
        roi = smooth_rois(refine_rois(roi, first, params), tracking.time_s, params.smooth_s)
    found = _run(detector, video_path, roi, camera, "keypoints", quick=False)
    return _assemble(found, detector, tracking, camera, params)


def smooth_rois(roi: np.ndarray, time_s: np.ndarray, sigma_s: float) -> np.ndarray:
    """Regions (T, 4) smoothed over time by a Gaussian kernel; size as logarithm, rotation on the circle.

    Frames without a region (NaN) stay so, and take no part.
    """
    good = np.flatnonzero(np.isfinite(roi).all(axis=1))
    out = np.full(roi.shape, np.nan)
    if sigma_s <= 0:
        out[good] = roi[good]
        return out
    x, y, side, turn = roi[good].T
    values = np.stack([x, y, np.log(side), np.sin(turn), np.cos(turn)], axis=1)
    time = time_s[good]
    for row, t in zip(good, time, strict=True):
        near = slice(np.searchsorted(time, t - 4 * sigma_s), np.searchsorted(time, t + 4 * sigma_s, side="right"))
        # A straight line is fitted under the kernel: at the ends of a track a mean would lag behind the person.
        tau = time[near] - t
        weight = np.exp(-0.5 * (tau / sigma_s) ** 2)
        design = np.stack([np.ones(len(tau)), tau / sigma_s], axis=1)
        normal = design.T @ (weight[:, None] * design) + np.diag([0.0, 1e-9])
        value = np.linalg.solve(normal, design.T @ (weight[:, None] * values[near]))[0]
        out[row] = [value[0], value[1], np.exp(value[2]), np.arctan2(value[3], value[4])]
    return out


def refine_rois(roi: np.ndarray, found: Sequence[PersonKeypoints | None], params: KeypointParams) -> np.ndarray:
    """Regions (T, 4) that the keypoints show, and those of `roi` where nobody was found or somebody else."""
    out = roi.copy()
    for row, person in enumerate(found):
        if person is None or person.presence < params.min_presence or not np.all(np.isfinite(person.roi_px)):
            continue
        drift = float(np.hypot(*(person.roi_px[:2] - roi[row, :2]))) / roi[row, 2]
        growth = abs(float(np.log(person.roi_px[2] / roi[row, 2])))
        if drift <= params.max_drift and growth <= np.log(params.max_growth):
            out[row] = person.roi_px
    return out


def _rois(roi: np.ndarray, box: np.ndarray) -> np.ndarray:
    """The body circles; where a detector gives only boxes, the circle around an upright body in the box."""
    x0, y0, x1, y1 = box.T
    around = np.stack([(x0 + x1) / 2, (y0 + y1) / 2, np.maximum(x1 - x0, y1 - y0), np.zeros(len(box))], axis=1)
    return np.where(np.isfinite(roi).all(axis=1, keepdims=True), roi, around)


def _run(
    detector: KeypointDetector, video_path: str | Path, roi: np.ndarray, camera: Camera, label: str, *, quick: bool
) -> list[PersonKeypoints | None]:
    rows = np.flatnonzero(np.isfinite(roi).all(axis=1))
    found: list[PersonKeypoints | None] = [None] * len(roi)
    frames = read_frames(video_path, start=int(rows[0]), stop=int(rows[-1]) + 1)
    seen = 0
    for frame in progress.track(frames, label, total=int(rows[-1] - rows[0] + 1)):
        if np.isfinite(roi[frame.index]).all():
            found[frame.index] = detector.detect(frame.image, roi[frame.index], camera, quick=quick)
            seen += 1
    if seen != len(rows):
        raise PblError(
            "VIDEO_CHANGED",
            found=f"{seen} of the {len(rows)} frames in which the person was tracked",
            expected="the video that was tracked",
            next_step="track the people again in this file",
            key=str(video_path),
        )
    return found


def _assemble(
    found: list[PersonKeypoints | None],
    detector: KeypointDetector,
    tracking: Tracking,
    camera: Camera,
    params: KeypointParams,
) -> Keypoints:
    n, j = len(found), len(detector.names)
    xy, xyz = np.full((n, j, 2), np.nan), np.full((n, j, 3), np.nan)
    confidence, box = np.zeros((n, j)), np.full((n, 4), np.nan)
    width, height = tracking.image_size_px
    for row, person in enumerate(found):
        if person is None or person.presence < params.min_presence:
            continue
        # What lies beyond the picture was not seen, whatever the detector extrapolates.
        inside = np.all((person.xy_px >= -0.5) & (person.xy_px <= np.array([width, height]) - 0.5), axis=1)
        xy[row, inside], xyz[row, inside] = person.xy_px[inside], person.xyz_cam_m[inside]
        confidence[row, inside] = np.clip(person.confidence[inside], 0.0, 1.0)
        low, high = person.xy_px.min(axis=0), person.xy_px.max(axis=0)
        margin = params.box_margin * (high - low)
        box[row] = np.clip(np.concatenate([low - margin, high + margin]), 0.0, [width, height, width, height])
    return Keypoints(
        time_s=tracking.time_s,
        names=detector.names,
        marker_set=detector.marker_set,
        xy_px=xy.astype(np.float32),
        xyz_cam_m=xyz.astype(np.float32),
        root_relative=detector.root_relative,
        confidence=confidence.astype(np.float32),
        image_size_px=tracking.image_size_px,
        camera=camera,
        box_px=box.astype(np.float32),
    )
