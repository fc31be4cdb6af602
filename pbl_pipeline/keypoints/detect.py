"""Keypoints of one tracked person over a video.

There are two passes, because the quality depends on the crop: the first, over some of the frames, crops along the
person's track, and its keypoints show the true region of interest; the second, over every frame, crops that region,
smoothed over time in both directions. The crop does not depend on the keypoints of the previous frame, so it cannot
drift to another person: if the first pass contradicts the track, the track is used.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.methods import Method
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.resources import cores
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.tracking import Tracking, time_in_view_s
from pbl_pipeline.video import Camera, Frame, read_frames

from .crops import Regions, sampled_rows, smooth_rois
from .flips import exchange_sides, exchanged, lowered
from .methods import METHODS
from .passes import BatchDetector, BatchedInference, ParallelInference, two_passes
from .picture import Picture, PictureMeter
from .protocol import Inspection, KeypointDetector, KeypointParams, MirrorDetector
from .quality_checks import confidence_curve
from .types import Keypoints, PersonKeypoints

#: More detectors than this are hardly faster and take memory.
MAX_DETECTORS = 8


def detect_keypoints(
    video_path: str | Path,
    tracking: Tracking,
    person_id: int,
    camera: Camera,
    params: Method[KeypointParams] | Paramset | KeypointParams | str | None = None,
    detector: KeypointDetector | None = None,
) -> Keypoints:
    """Keypoints of person `person_id` in every frame that the method uses (`KeypointParams.interval_s`); NaN with
    confidence 0 where she or the point is not in view.

    `params` as for `METHODS.find`; `detector` replaces the method's. The video is decoded once, and frames of about
    half a second are in memory.

    Raises `PblError`: SUBJECT_UNKNOWN_PERSON; TRACK_TOO_SHORT if she is in view for less than `min_time_s`;
    VIDEO_CHANGED if the video has other frames than the tracking; SOLVER_UNKNOWN for an unknown method or detector;
    those of `video.read_frames` and `assets.fetch`.
    """
    method = METHODS.find(params)
    params = method.params
    track = next((p for p in tracking.persons if p.person_id == person_id), None)
    if track is None:
        raise PblError(
            "SUBJECT_UNKNOWN_PERSON",
            found=said("person {n}", n=person_id),
            expected=f"one of {', '.join(str(p.person_id) for p in tracking.persons) or 'no one: no person was found'}",
            next_step="choose one of the numbers that tracking returned",
            key=str(video_path),
        )
    in_view = time_in_view_s(track, tracking.time_s)
    if in_view < params.min_time_s:
        lasts = float(tracking.time_s[-1] - tracking.time_s[0]) if len(tracking.time_s) else 0.0
        raise PblError(
            "TRACK_TOO_SHORT",
            found=said("the whole video lasts {s:.2f} s", s=lasts)
            if lasts < params.min_time_s
            else said("person {n} is in view for {s:.2f} s", n=person_id, s=in_view),
            expected=f"{params.min_time_s:g} s or more; a gait cycle takes about 1.1 s and three or more are wanted",
            next_step="film again so that the whole body stays in the picture for several steps, or choose another "
            "person",
            key=str(video_path),
        )
    detectors = [detector] if detector is not None else _detectors(method)
    roi = smooth_rois(_rois(track.roi_px, track.box_px), tracking.time_s, params.smooth_s)
    meter = PictureMeter()
    used = sampled_rows(np.arange(len(roi)), tracking.time_s, params.interval_s)
    found = _detect_all(detectors, video_path, roi, used, tracking.time_s, camera, params, meter)
    time_s, size_px = tracking.time_s[used], tracking.image_size_px
    keypoints = _assemble(found, detectors[0], time_s, size_px, camera, params, meter.result())
    return keypoints if len(used) == len(roi) else dataclasses.replace(keypoints, frame=used)


def _rois(roi: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Regions of interest; of a detector that returns only boxes, the circle around an upright body in the box."""
    x0, y0, x1, y1 = box.T
    around = np.stack([(x0 + x1) / 2, (y0 + y1) / 2, np.maximum(x1 - x0, y1 - y0), np.zeros(len(box))], axis=1)
    return np.where(np.isfinite(roi).all(axis=1, keepdims=True), roi, around)


def _detectors(method: Method[KeypointParams]) -> list[KeypointDetector]:
    """Return the detector of the method, or one for each core if it states that this is fastest. One on a GPU is
    repeated: as many threads as it asks for share it."""
    first = method.function(method.params)
    shared = getattr(first, "side_by_side", 1)
    if shared > 1:
        return [first] * shared
    more = min(cores(), MAX_DETECTORS) - 1 if getattr(first, "per_core", False) else 0
    return [first, *(method.function(method.params) for _ in range(more))]


def _detect_all(
    detectors: list[KeypointDetector],
    video_path: str | Path,
    roi: np.ndarray,
    used: np.ndarray,
    time_s: np.ndarray,
    camera: Camera,
    params: KeypointParams,
    meter: PictureMeter,
) -> list[PersonKeypoints | None]:
    """Detections in each of the frames `used` (K,) of the person whose region is `roi` (T, 4), NaN where she is not in
    view."""
    mirrored = np.zeros(len(roi), bool)
    mirrored[used[1::2]] = True
    regions = Regions(np.where(np.isin(np.arange(len(roi)), used)[:, None], roi, np.nan), time_s, params)
    found: list[PersonKeypoints | None] = [None] * len(roi)
    frames = meter.watch(_in_view(video_path, regions.rows), roi)
    one = detectors[0]
    batched = isinstance(one, BatchDetector)
    sharing = one if isinstance(one, MirrorDetector) and _close(time_s[regions.rows], params.share_looks_s) else None

    def inspection(row: int) -> Inspection:
        return Inspection.FULL if sharing is None else Inspection.MIRRORED if mirrored[row] else Inspection.PLAIN

    with BatchedInference(one, camera) if batched else ParallelInference(detectors, camera) as inference:
        seen = two_passes(frames, inference, time_s, regions, inspection)
        for row, person in progress.track(seen, "keypoints", total=len(regions.rows)):
            found[row] = person
    n_seen = sum(person is not None for person in found)
    if n_seen != len(regions.rows):
        raise PblError(
            "VIDEO_CHANGED",
            found=said("{n} of the {all} frames in which the person was tracked", n=n_seen, all=len(regions.rows)),
            expected="the video that was tracked",
            next_step="track the people again in this file",
            key=str(video_path),
        )
    found = [found[i] for i in used]
    if sharing is None:
        return found
    return sharing.mirrored_inference.shared(found, mirrored[used], time_s[used], params.min_presence)


def _close(time_s: np.ndarray, most_s: float) -> bool:
    """True if the interval of these frames is at most `most_s`."""
    return len(time_s) > 1 and interval_of(time_s) <= most_s


def _in_view(video_path: str | Path, rows: np.ndarray) -> Iterator[Frame]:
    wanted = set(rows.tolist())
    for frame in read_frames(video_path, start=int(rows[0]), stop=int(rows[-1]) + 1):
        if frame.index in wanted:
            yield frame


def _assemble(
    found: list[PersonKeypoints | None],
    detector: KeypointDetector,
    time_s: np.ndarray,
    size_px: tuple[int, int],
    camera: Camera,
    params: KeypointParams,
    picture: Picture,
) -> Keypoints:
    n, j = len(found), len(detector.names)
    xy, xyz = np.full((n, j, 2), np.nan), np.full((n, j, 3), np.nan)
    confidence, box, crop = np.zeros((n, j)), np.full((n, 4), np.nan), np.full(n, np.nan)
    width, height = size_px
    for row, person in enumerate(found):
        if person is None or person.presence < params.min_presence:
            continue
        # Points beyond the picture were not seen: the detector extrapolates them.
        inside = np.all((person.xy_px >= -0.5) & (person.xy_px <= np.array([width, height]) - 0.5), axis=1)
        xy[row, inside], xyz[row, inside] = person.xy_px[inside], person.xyz_cam_m[inside]
        confidence[row, inside] = np.clip(person.confidence[inside], 0.0, 1.0)
        crop[row] = person.crop_px
        low, high = person.xy_px.min(axis=0), person.xy_px.max(axis=0)
        margin = params.box_margin * (high - low)
        box[row] = np.clip(np.concatenate([low - margin, high + margin]), 0.0, [width, height, width, height])
    changed = None
    if params.sides is not None:
        exchange = exchange_sides(time_s, detector.names, xy, xyz, confidence, params.sides)
        xy, xyz = (exchanged(values, exchange, detector.names) for values in (xy, xyz))
        confidence = lowered(confidence, exchange, detector.names, params.sides)
        changed = exchange.table
    return Keypoints(
        time_s=time_s,
        names=detector.names,
        marker_set=detector.marker_set,
        xy_px=xy.astype(np.float32),
        xyz_cam_m=xyz.astype(np.float32),
        root_relative=detector.root_relative,
        confidence=confidence.astype(np.float32),
        image_size_px=size_px,
        camera=camera,
        box_px=box.astype(np.float32),
        origin=getattr(detector, "origin", ""),
        picture=picture,
        confidence_curve=_curve_of(detector, params),
        sides_changed=changed,
        crop_px=crop.astype(np.float32) if np.isfinite(crop).any() else None,
    )


def _curve_of(detector: KeypointDetector, params: KeypointParams) -> str:
    """Return the curve's name if it is of this detector, else "". Raises `PblError` SOLVER_UNKNOWN."""
    name = params.confidence_curve
    return name if name and confidence_curve(name).detector == detector.name else ""
