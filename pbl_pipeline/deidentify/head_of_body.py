"""The circle around a person's head, from keypoints and from the body's region of interest."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.tracking import PersonTrack

from .params import HeadParams
from .types import BODY, DISAGREE, KEYPOINTS, NONE, Head

#: Points that make the face in the marker set `blazepose_33`.
FACE_WORDS = ("nose", "eye", "ear", "mouth")
#: Frames around one that say where its head should be.
_AROUND = 3


def is_face(name: str) -> bool:
    """Whether a keypoint is of the face."""
    return any(word in name.split("_") for word in FACE_WORDS)


def head_of_person(track: PersonTrack, keypoints: Keypoints, params: HeadParams) -> Head:
    """The head of a tracked person in every frame in which she is in view, not yet held over gaps.

    Where the points of the head were found, the circle is around the middle of the ears, or of those points of the face
    that are in the picture. `head_radius_m` becomes pixels by the size of the body: the spread of all keypoints in the
    picture over their spread in metres across the line of sight (a weak perspective). Elsewhere the circle is around
    the upper end of the body.
    """
    from_body = body_end(track.roi_px, params)
    circle, source = from_body.copy(), np.where(np.isfinite(from_body).all(axis=1), BODY, NONE).astype(np.uint8)
    seen = head_circle(keypoints, params)
    known = np.asarray(np.isfinite(seen).all(axis=1), bool)
    circle[known], source[known] = seen[known], KEYPOINTS
    radius = track.roi_px[:, 2] / 2
    apart = np.linalg.norm(seen[:, :2] - from_body[:, :2], axis=1)
    wrong = known & (apart > params.agree * radius)  # NaN compares as False: without a body nothing disagrees
    jumped = known & (off_course(seen) > params.jump * seen[:, 2])
    source[wrong | jumped] = DISAGREE
    # Whom to believe is not known: the circle that holds both.
    for t in np.flatnonzero(wrong):
        circle[t] = around_both(seen[t], from_body[t])
    return Head(circle, source, track.box_px, keypoints.xy_px, keypoints.names)


def head_circle(keypoints: Keypoints, params: HeadParams) -> np.ndarray:
    """(T, 3) the circle of the head by the keypoints, NaN where no point of the face is in the picture."""
    names = keypoints.names
    face = np.array([is_face(n) for n in names])
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
    """(T, 3) the circle at the upper end of a region of interest (T, 4): where the head of a body is that fills it."""
    roi = np.asarray(roi_px, float)
    radius = roi[:, 2] / 2
    up = np.column_stack([np.sin(roi[:, 3]), -np.cos(roi[:, 3])])
    return np.column_stack([roi[:, :2] + params.up * radius[:, None] * up, params.body_radius * radius])


def off_course(circle: np.ndarray) -> np.ndarray:
    """(T,) how far (px) each centre is from the median of those around it; NaN without any."""
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
    """The smallest circle (3,) that holds two circles (3,)."""
    apart = float(np.hypot(*(b[:2] - a[:2])))
    if apart + min(a[2], b[2]) <= max(a[2], b[2]):
        return a if a[2] >= b[2] else b
    radius = (apart + a[2] + b[2]) / 2
    return np.array([*(a[:2] + (b[:2] - a[:2]) * (radius - a[2]) / apart), radius])


def mean(values: np.ndarray) -> np.ndarray:
    """Mean over the second axis of those that are known, NaN where none is."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
