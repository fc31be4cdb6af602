"""All heads of a video: people and their keypoints, then faces that no body explains."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.keypoints import detect_keypoints
from pbl_pipeline.prefetch import prefetched
from pbl_pipeline.tracking import tiles, track_people
from pbl_pipeline.video import VideoInfo, find_camera, probe, read_frames

from .faces import FaceDetector, same_face
from .head_of_body import head_of_person
from .hold import held
from .params import HeadParams
from .types import DISAGREE, FACE, KEYPOINTS, NONE, Head, Heads

_FRAMES_AHEAD = 4


def find_heads(video_path: str | Path, params: HeadParams | None = None, info: VideoInfo | None = None) -> Heads:
    """Find the heads of everybody in a video, in every frame, held over gaps.

    The video is decoded once for the people, once for the keypoints of each of them, and once for the faces; frames
    stream, so that memory does not grow with the length but by the circles. `info` is what `video.probe` said of the
    file. Where nobody is found, the `Heads` are empty.

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
    """All faces in frames `face_interval_s` apart."""
    detector = FaceDetector(params.face_score)
    sizes = [tiles(info.width_px, info.height_px, f, params.face_overlap) for f in params.face_tiles]
    turns = itertools.cycle(sizes)
    found, next_s = [], -np.inf
    slack = 0.5 * float(np.median(np.diff(info.time_s))) if info.n_frames > 1 else 0.0
    frames = prefetched(read_frames(video_path), _FRAMES_AHEAD)
    for frame in progress.track(frames, "faces", total=info.n_frames):
        if frame.time_s + slack < next_s and frame.index != info.n_frames - 1:
            continue
        next_s = frame.time_s + params.face_interval_s
        faces = zip(*detector.detect(frame.image, next(turns)), strict=True)
        found += [_Face(frame.index, box, float(score)) for box, score in faces]
    return found


def _confirmed(head: Head, faces: Sequence[_Face]) -> Head:
    """The head, no longer in doubt in frames in which a face looks out of its circle."""
    source = head.source.copy()
    for face in faces:
        if source[face.index] == DISAGREE and _inside(face, head):
            source[face.index] = KEYPOINTS
    return dataclasses.replace(head, source=source)


def _trails(faces: Sequence[_Face], time_s: np.ndarray, params: HeadParams) -> list[list[_Face]]:
    """The faces that are seen often enough, each with its sightings in order of time."""
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
    """Whether every sighting lies in the circle of a known head."""
    return all(any(_inside(face, head) for head in heads) for face in trail)


def _on_body(trail: Sequence[_Face], heads: Sequence[Head]) -> bool:
    """Whether most sightings lie within the box of a person whose head is surely elsewhere."""
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
    """The head of a face, interpolated between its sightings."""
    at = [face.index for face in trail]
    boxes = np.array([face.box_px for face in trail])
    side = (boxes[:, 2:] - boxes[:, :2]).max(axis=1)
    seen = np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2, params.face_radius * side])
    inside = slice(at[0], at[-1] + 1)
    circle, source = np.full((len(time_s), 3), np.nan), np.full(len(time_s), NONE, np.uint8)
    circle[inside] = np.column_stack([np.interp(time_s[inside], time_s[at], v) for v in seen.T])
    source[inside] = FACE
    return Head(circle, source, np.full((len(time_s), 4), np.nan))
