"""People over a whole video: tiled detection at intervals, cheap detection around known people in between."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pbl_pipeline import assets, progress
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.video import VideoInfo, probe, read_frames

from ._associate import AssociationParams, Associator, Trail
from ._blazepose import MODEL_SHA256, BlazePoseDetector, body_box
from ._join import JoinParams, join_trails
from ._tiles import detect_in, tiles
from ._types import PersonDetector, PersonTrack, Tracking


@dataclasses.dataclass(frozen=True)
class TrackingParams:
    """Parameters of `track_people`.

    search_interval_s: every so often the whole frame and all tiles are searched.
    follow_interval_s: in between, one window around each known person is searched this often.
    tile_fraction, tile_overlap: tiles are squares of this share of the shorter side, overlapping by that share or more.
    window_sizes: side of the window around a person, in body circles.
    min_score: detections below it are ignored. association: see `AssociationParams`; gaps up to its `max_gap_s` are
    bridged (observed=False), after a longer one a new person begins, unless `join` finds that it is the same one; such
    a gap stays without boxes.
    min_hits: a person must be seen surely (`sure_score` of the association) this often, and over `min_track_s`, or
    the track is dropped as false.
    """

    detector: str = "blazepose"
    model_sha256: str = MODEL_SHA256
    search_interval_s: float = 0.2
    follow_interval_s: float = 0.1
    tile_fraction: float = 0.7
    tile_overlap: float = 0.3
    window_sizes: float = 1.6
    min_score: float = 0.5
    min_hits: int = 3
    min_track_s: float = 0.25
    association: AssociationParams = dataclasses.field(default_factory=AssociationParams)
    join: JoinParams = dataclasses.field(default_factory=JoinParams)


DEFAULT = "blazepose-tiles"
PARAMSETS: dict[str, Paramset] = {DEFAULT: Paramset.of("tracking", DEFAULT, 1, TrackingParams())}


def _blazepose(params: TrackingParams) -> PersonDetector:
    return BlazePoseDetector(assets.fetch("blazepose_detector"), params.min_score)


#: Detectors by the name that `TrackingParams.detector` uses. Another detector joins here.
DETECTORS: dict[str, Callable[[TrackingParams], PersonDetector]] = {"blazepose": _blazepose}


def track_people(
    video_path: str | Path,
    params: TrackingParams | None = None,
    detector: PersonDetector | None = None,
    info: VideoInfo | None = None,
) -> Tracking:
    """Find everybody in a video and follow them. Frames stream: memory does not grow with the video.

    `detector` replaces the one that `params.detector` names. `info` is what `video.probe` said of this file; without
    it the video is probed, which decodes it once more. No person found gives a `Tracking` without persons.
    Raises the `PblError`s of `video.probe` and `assets.fetch`, SOLVER_UNKNOWN for an unknown detector name, and
    VIDEO_CHANGED when `info` is of another number of frames.
    """
    params = params or TrackingParams()
    if detector is None:
        if params.detector not in DETECTORS:
            raise PblError(
                "SOLVER_UNKNOWN",
                found=f"person detector {params.detector!r}",
                expected=f"one of {', '.join(DETECTORS)}",
                next_step="choose one of these names in the tracking parameters",
            )
        detector = DETECTORS[params.detector](params)
    info = info or probe(video_path)
    associator = Associator(params.association)
    size = (info.width_px, info.height_px)
    windows = tiles(*size, params.tile_fraction, params.tile_overlap)
    # A frame is due when the nearest multiple of the interval falls to it; half a frame of slack avoids beating.
    slack = 0.5 * float(np.median(np.diff(info.time_s))) if info.n_frames > 1 else 0.0
    next_search = next_follow = 0.0
    n_frames = 0
    for frame in progress.track(read_frames(video_path), "people", total=info.n_frames):
        n_frames += 1
        # The last frame too, so that tracks do not end before the video does.
        last = frame.index == info.n_frames - 1
        if frame.time_s + slack >= next_search:
            found = detect_in(detector, frame.image, windows)
            next_search = frame.time_s + params.search_interval_s
            may_begin = True
        elif last or frame.time_s + slack >= next_follow:
            around = [_window(t.predict(frame.time_s), params.window_sizes) for t in associator.live]
            found = detect_in(detector, frame.image, around)
            # A lone window cannot tell a new person from a poor view of the known one.
            may_begin = False
        else:
            continue
        next_follow = frame.time_s + params.follow_interval_s
        associator.step(frame.index, frame.time_s, found, may_begin)
    if n_frames != info.n_frames:
        raise PblError(
            "VIDEO_CHANGED",
            found=f"{n_frames} frames",
            expected=f"the {info.n_frames} frames that were probed",
            next_step="probe the video again",
            key=str(video_path),
        )
    people = join_trails([t for t in associator.trails() if _is_real(t, params)], size, params.join)
    longest = params.association.max_gap_s
    persons = tuple(_to_track(i + 1, t, info.time_s, size, longest) for i, t in enumerate(people))
    return Tracking(info.time_s, size, persons, detector.name, detector.model_sha256)


def _window(state: np.ndarray, sizes: float) -> tuple[int, int, int, int]:
    half = 0.5 * sizes * float(np.exp(state[2]))
    return round(state[0] - half), round(state[1] - half), round(state[0] + half), round(state[1] + half)


def _is_real(trail: Trail, params: TrackingParams) -> bool:
    sure = sum(d.score >= params.association.sure_score for d in trail.detections)
    return sure >= params.min_hits and trail.times[-1] - trail.times[0] >= params.min_track_s


def _to_track(person_id: int, trail: Trail, time_s: np.ndarray, size: tuple[int, int], max_gap_s: float) -> PersonTrack:
    """Rows for every frame; between sightings up to `max_gap_s` apart, centre, size and score are interpolated linearly
    in time."""
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
        roi[inside] = _interpolate(time_s[inside], trail.times, seen_roi)
        roi[:, 3] = np.arctan2(np.sin(roi[:, 3]), np.cos(roi[:, 3]))
        box[inside] = body_box(roi[inside])
    else:
        box[inside] = _interpolate(time_s[inside], trail.times, np.array([d.box_px for d in trail.detections]))
    for a, b in zip(trail.frames, trail.frames[1:], strict=False):
        if time_s[b] - time_s[a] > max_gap_s + 1e-9:
            roi[a + 1 : b], box[a + 1 : b], score[a + 1 : b] = np.nan, np.nan, 0.0
    width, height = size
    box = np.clip(box, 0.0, [width, height, width, height])
    return PersonTrack(person_id, box, roi, score, observed)


def _interpolate(at: np.ndarray, times: list[float], values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, times, v) for v in values.T], axis=-1)
