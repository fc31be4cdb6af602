"""People over a whole video: detection in the windows of `Watch`, association, and corrections in both directions."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.methods import Method
from pbl_pipeline.models import box_iou
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.prefetch import prefetched
from pbl_pipeline.results import PersonTrack
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.video import VideoInfo, probe, read_frames

from .appearance import with_appearance
from .associate import Associator, Trail, interpolate, measure, same_body
from .blazepose import body_box
from .detection_schedule import Watch, window_around
from .identity_swaps import undo_swaps
from .methods import METHODS
from .params import TrackingParams
from .reidentify import backtrack, join_trails, with_exact_ends
from .tiling import detect_in
from .types import Detection, PersonDetector, Scene, Tracking, WindowDetector

#: Least overlap of the boxes in a second detection of a new person.
CONFIRM_IOU = 0.3
#: Rotation (rad) beyond which a body is upside down, and the fraction of such sightings beyond which a video is.
UPSIDE_DOWN_RAD, UPSIDE_DOWN_SHARE = 0.75 * np.pi, 0.5
#: Frames decoded ahead while the detector runs, which takes as long as decoding some.
FRAMES_AHEAD = 8


def track_people(
    video_path: str | Path,
    params: Method[TrackingParams] | Paramset | TrackingParams | str | None = None,
    detector: PersonDetector | None = None,
    info: VideoInfo | None = None,
) -> Tracking:
    """Find and follow all people in a video. Memory does not grow with the length of the video.

    `params` as for `METHODS.find`; `detector` replaces the method's. `info` is the result of `video.probe`; without it
    the video is probed, which decodes it once more. A `Tracking` may have no persons.

    Raises the `PblError`s of `video.probe` and `assets.fetch`, VIDEO_UPSIDE_DOWN, SOLVER_UNKNOWN for an unknown method
    or detector, and VIDEO_CHANGED if `info` has another number of frames; for a registered model MODEL_MISSING,
    MODEL_INVALID, MODEL_CHECKSUM, DEVICE_UNAVAILABLE.
    """
    method = METHODS.find(params)
    params = method.params
    finder: PersonDetector = method.function(params) if detector is None else detector
    info = info or probe(video_path)
    size = (info.width_px, info.height_px)
    trails = [t for t in _follow(video_path, params, finder, info) if _is_real(t, params)]
    if params.exact_ends:
        frames = functools.partial(read_frames, video_path)
        watch = params.watch
        within_s = max(watch.search_interval_s, watch.rest_interval_s)
        trails = with_exact_ends(trails, info.time_s, frames, within_s, finder, watch, params.association)
    people = join_trails(undo_swaps(trails, params.uncross), size, params.join)
    longest = params.association.max_gap_s
    persons = tuple(_to_track(i + 1, t, info.time_s, size, longest) for i, t in enumerate(people))
    _check_upright(persons, video_path)
    return Tracking(info.time_s, size, persons, finder.name, finder.model_sha256)


def _check_upright(persons: Sequence[PersonTrack], video_path: str | Path) -> None:
    """Raise `PblError` VIDEO_UPSIDE_DOWN by the axes of the bodies, if the detector returns them."""
    turn = np.concatenate([np.empty(0), *(p.roi_px[p.observed, 3] for p in persons)])
    turn = np.abs(np.angle(np.exp(1j * turn[np.isfinite(turn)])))
    share = float(np.mean(turn > UPSIDE_DOWN_RAD)) if len(turn) else 0.0
    if share > UPSIDE_DOWN_SHARE:
        raise PblError(
            "VIDEO_UPSIDE_DOWN",
            found=said("people whose heads are below their feet, in {share:.0%} of the sightings", share=share),
            expected="people with their heads up",
            next_step="turn the video by half a turn in the phone's editor and send it again",
            key=str(video_path),
        )


def _follow(video_path: str | Path, params: TrackingParams, detector: PersonDetector, info: VideoInfo) -> list[Trail]:
    """Return all trails of one pass over the frames, including false ones."""
    associator = Associator(params.association)
    slack = 0.5 * interval_of(info.time_s) if info.n_frames > 1 else 0.0
    watch = Watch((info.width_px, info.height_px), params.watch, slack)
    # The frames of the last searches, to follow new people backwards: as long as a turn of all windows takes.
    kept: deque[tuple[int, float, Scene]] = deque(maxlen=watch.n_turn)
    n_frames = 0
    frames = prefetched(read_frames(video_path), FRAMES_AHEAD)
    for frame in progress.track(frames, "people", total=info.n_frames):
        n_frames, now = n_frames + 1, frame.time_s
        associator.forget(now)
        # Also in the last frame, so that tracks do not end before the video does.
        due = watch.due(now, associator.live, last=frame.index == info.n_frames - 1)
        elsewhere = watch.elsewhere(now, associator.live)
        if not (due or elsewhere):
            continue
        scene = frame if isinstance(detector, WindowDetector) else frame.image
        found = detect_in(detector, scene, watch.around(now, due), elsewhere)
        found = [with_appearance(d, scene) for d in found]
        for new in associator.step(frame.index, now, found, due):
            sure = _confirmed(new, detector, scene, now, associator.live, params)
            if sure is not None:
                trail = Trail.of(frame.index, now, sure)
                taken = associator.trails()
                associator.begin(backtrack(trail, kept, taken, detector, params.watch, params.association))
        watch.detected(now, due, associator.live)
        if elsewhere:
            kept.append((frame.index, now, scene))
    if n_frames != info.n_frames:
        raise PblError(
            "VIDEO_CHANGED",
            found=said("{n} frames", n=n_frames),
            expected=said("the {n} frames that were probed", n=info.n_frames),
            next_step="probe the video again",
            key=str(video_path),
        )
    return associator.trails()


def _confirmed(
    new: Detection,
    detector: PersonDetector,
    scene: Scene,
    time_s: float,
    live: Sequence[Trail],
    params: TrackingParams,
) -> Detection | None:
    """Detect a new person again, in a window around a detection that fits no known person; None if that fails.

    A single window anywhere cannot distinguish a new person from a poor view of a known one, who may be cut or small in
    it. A window around the person must find her again, at about the same position, away from known people.
    """
    known = [t.predict(time_s) for t in live]
    if any(same_body(measure(new), k) for k in known):
        return None
    window = window_around(measure(new), params.watch)
    again = [d for d in detect_in(detector, scene, [window]) if d.score >= params.association.sure_score]
    if not again:
        return None
    overlap = box_iou(new.box_px, np.array([d.box_px for d in again]))
    best = again[int(np.argmax(overlap))]
    if overlap.max() < CONFIRM_IOU or any(same_body(measure(best), k) for k in known):
        return None
    return with_appearance(best, scene)


def _is_real(trail: Trail, params: TrackingParams) -> bool:
    sure = sum(d.score >= params.association.sure_score for d in trail.detections)
    return sure >= params.min_hits and trail.times[-1] - trail.times[0] >= params.min_track_s


def _to_track(person_id: int, trail: Trail, time_s: np.ndarray, size: tuple[int, int], max_gap_s: float) -> PersonTrack:
    """Track with rows for every frame; between sightings up to `max_gap_s` apart, centre, size and score are
    interpolated linearly in time."""
    n = len(time_s)
    first, last = trail.frames[0], trail.frames[-1]
    inside = slice(first, last + 1)
    roi = np.full((n, 4), np.nan)
    box = np.full((n, 4), np.nan)
    score = np.zeros(n)
    observed = np.zeros(n, bool)
    observed[trail.frames] = True
    score[inside] = np.interp(time_s[inside], trail.times, [d.score for d in trail.detections])
    seen_roi = np.array([d.roi_px for d in trail.detections])
    if np.all(np.isfinite(seen_roi)):
        seen_roi[:, 3] = np.unwrap(seen_roi[:, 3])
        roi[inside] = interpolate(time_s[inside], trail.times, seen_roi)
        roi[:, 3] = np.arctan2(np.sin(roi[:, 3]), np.cos(roi[:, 3]))
        box[inside] = body_box(roi[inside])
    else:
        box[inside] = interpolate(time_s[inside], trail.times, np.array([d.box_px for d in trail.detections]))
    for a, b in zip(trail.frames, trail.frames[1:], strict=False):
        if time_s[b] - time_s[a] > max_gap_s + 1e-9:
            roi[a + 1 : b], box[a + 1 : b], score[a + 1 : b] = np.nan, np.nan, 0.0
    width, height = size
    box = np.clip(box, 0.0, [width, height, width, height])
    # As they are stored; in a long video with many passers-by these arrays take most of the memory.
    box, roi, score = (a.astype(np.float32) for a in (box, roi, score))
    return PersonTrack(person_id, box, roi, score, observed)
