"""All heads of a video: those of people by their keypoints, then faces that belong to none of these.

Faces are found by MediaPipe's two detectors, BlazeFace of short and of full range (layouts: modules/face_detection of
the mediapipe 0.10.21 wheel). Both return a square box from the brows to the chin and six points, eyes first, of faces
that look into the camera; a head from behind is only found by its body.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline import assets, progress
from pbl_pipeline.keypoints import Keypoints, detect_keypoints
from pbl_pipeline.models import SsdLayout, SsdModel, box_iou, suppress
from pbl_pipeline.prefetch import prefetched
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.tracking import PersonTrack, tiles, track_people
from pbl_pipeline.video import VideoInfo, find_camera, probe, read_frames

from .types import BODY, DISAGREE, FACE, HELD, KEYPOINTS, NONE, Head, HeadParams, Heads

#: Points that make the face in the marker set `blazepose_33`.
FACE_WORDS = frozenset({"nose", "eye", "ear", "mouth"})
#: Frames before and after one whose heads show where its head should be.
_AROUND = 3


def head_of_person(track: PersonTrack, keypoints: Keypoints, params: HeadParams) -> Head:
    """Find the head of a tracked person in every frame in which she is in view, without holding it over gaps.

    If points of the head were found, the circle is around the middle of the ears, or of those points of the face that
    are in the picture. `head_radius_m` is converted to pixels by the size of the body: the spread of all keypoints in
    the picture over their spread in metres across the line of sight (a weak perspective). Otherwise the circle is
    around the upper end of the body.
    """
    from_body = body_end(track.roi_px, params)
    circle, source = from_body.copy(), np.where(np.isfinite(from_body).all(axis=1), BODY, NONE).astype(np.uint8)
    seen = head_circle(keypoints, params)
    known = np.asarray(np.isfinite(seen).all(axis=1), bool)
    circle[known], source[known] = seen[known], KEYPOINTS
    radius = track.roi_px[:, 2] / 2
    apart = np.linalg.norm(seen[:, :2] - from_body[:, :2], axis=1)
    wrong = known & (apart > params.agree * radius)  # False for NaN: without a body nothing disagrees
    jumped = known & (off_course(seen) > params.jump * seen[:, 2])
    source[wrong | jumped] = DISAGREE
    # Either may be right: the circle that contains both.
    for t in np.flatnonzero(wrong):
        circle[t] = around_both(seen[t], from_body[t])
    return Head(circle, source, track.box_px, keypoints.xy_px, keypoints.names)


def head_circle(keypoints: Keypoints, params: HeadParams) -> np.ndarray:
    """(T, 3) circle of the head by the keypoints, NaN if no point of the face is in the picture."""
    names = keypoints.names
    face = np.array([not FACE_WORDS.isdisjoint(n.split("_")) for n in names])
    ears = np.array(["ear" in n.split("_") for n in names])
    xy = keypoints.xy_px.astype(float)
    centre = np.where(np.isfinite(mean(xy[:, ears])), mean(xy[:, ears]), mean(xy[:, face]))
    of_face = xy[:, face]
    apart = np.linalg.norm(of_face[:, :, None] - of_face[:, None], axis=-1).reshape(len(xy), -1)
    largest = np.where(np.isnan(apart), 0.0, apart).max(axis=1)
    radius = np.fmax(params.head_radius_m * px_per_m(keypoints), params.head_face * largest)
    return np.column_stack([centre, np.where(np.isfinite(centre[:, 0]), radius, np.nan)])


def px_per_m(keypoints: Keypoints) -> np.ndarray:
    """(T,) pixels per metre at the person, from the spread of the points in the picture and in the camera's x and y."""
    both = np.asarray(np.isfinite(keypoints.xy_px).all(-1) & np.isfinite(keypoints.xyz_cam_m).all(-1), bool)
    xy = np.where(both[..., None], keypoints.xy_px, np.nan).astype(float)
    across = np.where(both[..., None], keypoints.xyz_cam_m[..., :2], np.nan).astype(float)
    spread = [np.nansum((a - mean(a)[:, None]) ** 2, axis=(1, 2)) for a in (xy, across)]
    enough = (np.sum(both, axis=1) >= 4) & (spread[1] > 0)
    return np.sqrt(np.divide(spread[0], spread[1], out=np.full(len(xy), np.nan), where=enough))


def body_end(roi_px: np.ndarray, params: HeadParams) -> np.ndarray:
    """(T, 3) circle at the upper end of a region of interest (T, 4), around the head of a body that fills it."""
    roi = np.asarray(roi_px, float)
    radius = roi[:, 2] / 2
    up = np.column_stack([np.sin(roi[:, 3]), -np.cos(roi[:, 3])])
    return np.column_stack([roi[:, :2] + params.up * radius[:, None] * up, params.body_radius * radius])


def off_course(circle: np.ndarray) -> np.ndarray:
    """(T,) distance (px) of each centre from the median of those around it; NaN without any."""
    shifted = []
    for step in (s for s in range(-_AROUND, _AROUND + 1) if s):
        moved = np.full((len(circle), 2), np.nan)
        if abs(step) < len(circle):
            moved[max(0, -step) : len(circle) - max(0, step)] = circle[max(0, step) : len(circle) + min(0, step), :2]
        shifted.append(moved)
    around = np.stack(shifted)
    some = np.isfinite(around[..., 0]).any(axis=0)
    course = np.full((len(circle), 2), np.nan)
    if some.any():
        course[some] = np.nanmedian(around[:, some], axis=0)
    return np.hypot(*(circle[:, :2] - course).T)


def around_both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Smallest circle (3,) that contains two circles (3,)."""
    apart = float(np.hypot(*(b[:2] - a[:2])))
    if apart + min(a[2], b[2]) <= max(a[2], b[2]):
        return a if a[2] >= b[2] else b
    radius = (apart + a[2] + b[2]) / 2
    return np.array([*(a[:2] + (b[:2] - a[:2]) * (radius - a[2]) / apart), radius])


def mean(values: np.ndarray) -> np.ndarray:
    """Mean of the known values over the second axis, NaN without any."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def held(head: Head, time_s: np.ndarray, size_px: tuple[int, int], params: HeadParams) -> Head:
    """Fill the gaps of a head, and add second circles from the certain frames around where its position is in doubt.

    Gaps up to `bridge_s` are interpolated. Beyond the ends, and at both sides of a longer gap, the circle stays: for
    `hold_s`, but no longer than the head was seen (a wrong sighting is short), or `leave_s` if it touches the edge of
    the picture, through which a head comes and goes. It grows meanwhile.
    """
    n_seen = int((head.source != NONE).sum())
    seen_s = n_seen * interval_of(time_s) if len(time_s) > 1 else 0.0
    hold_s = params.leave_s if head.body_px is None else params.hold_s
    params = dataclasses.replace(params, hold_s=min(hold_s, max(seen_s, params.leave_s)))
    sure = (head.source == KEYPOINTS) | (head.source == FACE)
    doubt = (head.source != NONE) & ~sure
    also = np.full_like(head.circle_px, np.nan)
    _fill(also, head.circle_px, np.flatnonzero(sure), np.flatnonzero(doubt), time_s, size_px, params)
    circle = head.circle_px.copy()
    absent = np.flatnonzero(head.source == NONE)
    _fill(circle, head.circle_px, np.flatnonzero(head.source != NONE), absent, time_s, size_px, params)
    # A track that drifts off before it ends leaves its head at its last certain position.
    _fill(also, head.circle_px, np.flatnonzero(sure), absent, time_s, size_px, params)
    source = head.source.copy()
    filled = np.isfinite(circle[absent]).all(axis=1) | np.isfinite(also[absent]).all(axis=1)
    source[absent[filled]] = HELD
    return dataclasses.replace(head, circle_px=circle, source=source, also_px=also)


def _fill(
    out: np.ndarray,
    circle: np.ndarray,
    known: np.ndarray,
    wanted: np.ndarray,
    time_s: np.ndarray,
    size_px: tuple[int, int],
    params: HeadParams,
) -> None:
    """Write the circles held from the rows `known` of `circle` into the rows `wanted` of `out`, if there are any."""
    if not len(known):
        return
    for t in wanted:
        place = int(np.searchsorted(known, t))
        before = int(known[place - 1]) if place else None
        after = int(known[place]) if place < len(known) else None
        since = float(time_s[t] - time_s[before]) if before is not None else np.inf
        until = float(time_s[after] - time_s[t]) if after is not None else np.inf
        if before is not None and after is not None and since + until <= params.bridge_s:
            between = circle[before] + since / (since + until) * (circle[after] - circle[before])
            out[t] = _grown(between, min(since, until), params)
            continue
        near, for_s = (before, since) if since <= until else (after, until)
        longest = params.leave_s if near is not None and _at_edge(circle[near], size_px) else params.hold_s
        if near is not None and for_s <= longest + 1e-9:
            out[t] = _grown(circle[near], for_s, params)


def _at_edge(circle: np.ndarray, size_px: tuple[int, int]) -> bool:
    x, y, r = circle
    return bool(x < r or y < r or x > size_px[0] - r or y > size_px[1] - r)


def _grown(circle: np.ndarray, for_s: float, params: HeadParams) -> np.ndarray:
    return np.array([*circle[:2], circle[2] * min(1.0 + params.hold_growth * for_s, params.hold_most)])


FULL_RANGE = SsdLayout(input_size=192, layers=((4, 1),), n_keypoints=6)
SHORT_RANGE = SsdLayout(input_size=128, layers=((8, 2), (16, 6)), n_keypoints=6)
#: Overlap above which boxes of two windows are of one face.
SAME_IOU = 0.2


class FaceDetector:
    """Both networks. Faces from about a tenth of a window's side up. Not to be shared by threads.

    Raises the `PblError`s of `assets.fetch`.
    """

    def __init__(self, min_score: float = 0.5) -> None:
        self._full = _load("face_detector", FULL_RANGE, min_score)
        self._short = _load("face_detector_near", SHORT_RANGE, min_score)

    def detect(self, image: np.ndarray, windows: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
        """Find faces in the `windows` (x0, y0, x1, y1) of `image` (H, W, 3) uint8 BGR: boxes (N, 4) x0, y0, x1, y1 in
        px and scores (N,), best first. The short range's network is applied to the whole picture only."""
        height, width = image.shape[:2]
        boxes, scores = [np.zeros((0, 4))], [np.zeros(0)]
        parts = [(self._full, w) for w in windows] + [(self._short, (0, 0, width, height))]
        for model, (x0, y0, x1, y1) in parts:
            points, score = model.find(image[y0:y1, x0:x1])
            boxes.append(points[:, :2].reshape(-1, 4) + np.array([x0, y0, x0, y0]))
            scores.append(score)
        every, score = np.concatenate(boxes), np.concatenate(scores)
        order = np.argsort(-score, kind="stable")
        return suppress(every[order], score[order], SAME_IOU)


def same_face(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(N,) overlap of a box (4,) with boxes (N, 4), 0 if they are not of one face."""
    overlap = box_iou(box, boxes)
    return np.where(overlap > SAME_IOU, overlap, 0.0)


def _load(name: str, layout: SsdLayout, min_score: float) -> SsdModel:
    return SsdModel(assets.fetch(name), assets.ASSETS[name].sha256, layout, min_score)


_FRAMES_AHEAD = 4


def find_heads(video_path: str | Path, params: HeadParams | None = None, info: VideoInfo | None = None) -> Heads:
    """Find the heads of all people in a video, in every frame, held over gaps.

    The video is decoded once for the people, once for the keypoints of each person, and once for the faces; memory
    grows with its length by the circles only. `info` is the result of `video.probe`. Without people the `Heads` are
    empty.

    Raises the `PblError`s of `video.probe`, `tracking.track_people`, `keypoints.detect_keypoints`, `assets.fetch`.
    """
    params = params or HeadParams()
    info = info or probe(video_path)
    camera = find_camera(info)
    tracking = track_people(video_path, params.tracking, info=info)
    people = []
    for person in tracking.persons:
        found = detect_keypoints(video_path, tracking, person.person_id, camera, params=params.keypoints)
        people.append(head_of_person(person, found, params))
    sightings = _sightings(video_path, info, params)
    people = [_confirmed(head, sightings) for head in people]
    trails = [t for t in _trails(sightings, info.time_s, params) if not _explained(t, people)]
    alone = [t for t in trails if not _on_body(t, people) or sum(face.score for face in t) >= params.face_on_body]
    heads = [*people, *(_of_face(t, info.time_s, params) for t in alone)]
    size = (info.width_px, info.height_px)
    return Heads(info.time_s, size, tuple(held(h, info.time_s, size, params) for h in heads))


@dataclasses.dataclass
class _Face:
    """A face in one frame: its box (4,) and score."""

    index: int
    box_px: np.ndarray
    score: float


def _sightings(video_path: str | Path, info: VideoInfo, params: HeadParams) -> list[_Face]:
    """Find all faces in frames `face_interval_s` apart."""
    detector = FaceDetector(params.face_score)
    sizes = [tiles(info.width_px, info.height_px, f, params.face_overlap) for f in params.face_tiles]
    turns = itertools.cycle(sizes)
    found, next_s = [], -np.inf
    slack = 0.5 * interval_of(info.time_s) if info.n_frames > 1 else 0.0
    frames = prefetched(read_frames(video_path), _FRAMES_AHEAD)
    for frame in progress.track(frames, "faces", total=info.n_frames):
        if frame.time_s + slack < next_s and frame.index != info.n_frames - 1:
            continue
        next_s = frame.time_s + params.face_interval_s
        faces = zip(*detector.detect(frame.image, next(turns)), strict=True)
        found += [_Face(frame.index, box, float(score)) for box, score in faces]
    return found


def _confirmed(head: Head, faces: Sequence[_Face]) -> Head:
    """Return the head, no longer in doubt in frames with a face in its circle."""
    source = head.source.copy()
    for face in faces:
        if source[face.index] == DISAGREE and _inside(face, head):
            source[face.index] = KEYPOINTS
    return dataclasses.replace(head, source=source)


def _trails(faces: Sequence[_Face], time_s: np.ndarray, params: HeadParams) -> list[list[_Face]]:
    """Group the sightings by face, in order of time, and drop faces that are seen too rarely."""
    trails: list[list[_Face]] = []
    for face in faces:
        live = [t for t in trails if 0 < time_s[face.index] - time_s[t[-1].index] <= params.face_gap_s]
        overlap = same_face(face.box_px, np.array([t[-1].box_px for t in live]).reshape(-1, 4))
        if len(overlap) and overlap.max() > 0:
            live[int(overlap.argmax())].append(face)
        else:
            trails.append([face])
    return [t for t in trails if sum(face.score for face in t) >= params.face_sure]


def _explained(trail: Sequence[_Face], heads: Sequence[Head]) -> bool:
    """True if every sighting lies in the circle of a known head."""
    return all(any(_inside(face, head) for head in heads) for face in trail)


def _on_body(trail: Sequence[_Face], heads: Sequence[Head]) -> bool:
    """True if most sightings lie within the box of a person whose head is certainly elsewhere."""
    n = sum(any(_within_box(face, head) for head in heads) for face in trail)
    return n > len(trail) / 2


def _within_box(face: _Face, head: Head) -> bool:
    x, y = (face.box_px[:2] + face.box_px[2:]) / 2
    x0, y0, x1, y1 = head.box_px[face.index]
    return bool(head.source[face.index] == KEYPOINTS and x0 < x < x1 and y0 < y < y1)


def _inside(face: _Face, head: Head) -> bool:
    if head.source[face.index] == NONE:
        return False
    x, y, r = head.circle_px[face.index]
    centre = (face.box_px[:2] + face.box_px[2:]) / 2
    return bool(np.hypot(*(centre - [x, y])) < r)


def _of_face(trail: Sequence[_Face], time_s: np.ndarray, params: HeadParams) -> Head:
    """Head of a face, interpolated between its sightings."""
    at = [face.index for face in trail]
    boxes = np.array([face.box_px for face in trail])
    side = (boxes[:, 2:] - boxes[:, :2]).max(axis=1)
    seen = np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2, params.face_radius * side])
    inside = slice(at[0], at[-1] + 1)
    circle, source = np.full((len(time_s), 3), np.nan), np.full(len(time_s), NONE, np.uint8)
    circle[inside] = np.column_stack([np.interp(time_s[inside], time_s[at], v) for v in seen.T])
    source[inside] = FACE
    return Head(circle, source, np.full((len(time_s), 4), np.nan))
