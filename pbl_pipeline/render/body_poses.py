"""Poses of the fitted body in each frame, for programs that draw it themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import CapsuleShapes, body_frames, capsule_shapes, capsules, load_body
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.fit.results import SD_WARN_DEG
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.render.drawing import side_of
from pbl_pipeline.render.overlay import check_body

#: Confidence of a side's leg below which it is drawn as uncertain: as `draw_keypoints` draws points hollow.
SEEN_CONFIDENCE = 0.5
_LEG = ("hip", "knee", "ankle", "heel", "foot_index")


@dataclasses.dataclass(frozen=True)
class BodyTrack:
    """B bodies over T frames in the world of the fit (z up, origin at the camera)."""

    sides: tuple[str, ...]  # "left", "right" or "middle"
    leg: np.ndarray  # (B,) true for the bodies of the two legs, from the thigh on
    parent: np.ndarray  # (B,) index of the parent; -1 for the root, which comes first
    #: (B, 3) origin of a body in its parent's frame, the same in every pose: the joints turn bodies about their
    #: origins. 0 for the root.
    offset_m: np.ndarray
    root_m: np.ndarray  # (T, 3) origin of the root in the world; NaN where the pose is unknown
    #: (T, B, 4) body to world, unit quaternions without changes of sign between known frames; NaN where the pose is
    #: unknown.
    quat_wxyz: np.ndarray
    shapes: CapsuleShapes  # the capsules in the bodies' frames
    #: Height of the floor: the median over the frames of the body's lowest point, because a foot is on the floor in
    #: most frames of a walk. NaN if no pose is known.
    floor_m: float


def body_track(fit: TrialFit) -> BodyTrack:
    """Return the body of a fit in every frame of its video, with the shapes that `render_overlay` draws.

    Raises `PblError` FILE_FORMAT for a fit of another body model than the installed one.
    """
    body = load_body()
    check_body(fit, body)
    at, shapes = body_frames(body, fit.qpos, fit.scale), capsule_shapes(body, fit.scale)
    known = np.flatnonzero(np.asarray(np.isfinite(at.position_m).all(axis=(1, 2)), bool))
    n, parent = len(body.body_names), np.asarray(body.parent_index)
    quat = np.full((len(at.position_m), n, 4), np.nan)
    if len(known):
        found = Rotation.from_matrix(at.rotation[known].reshape(-1, 3, 3)).as_quat(scalar_first=True)
        quat[known] = without_jumps(found.reshape(len(known), n, 4))
    thighs = [i for i, name in enumerate(body.body_names) if name.startswith("femur_")]
    lowest = np.full(len(quat), np.nan)
    drawn = capsules(body, np.asarray(fit.qpos)[known], fit.scale)
    lowest[known] = (np.minimum(drawn.start[..., 2], drawn.end[..., 2]) - drawn.radius_m).min(axis=1)
    return BodyTrack(
        sides=tuple(side_of(name) for name in body.body_names),
        leg=np.array([any(body.path[i, thigh] for thigh in thighs) for i in range(n)], bool),
        parent=parent,
        offset_m=_offsets(at.position_m[known[:1]], at.rotation[known[:1]], parent),
        root_m=at.position_m[:, 0],
        quat_wxyz=quat,
        shapes=shapes,
        floor_m=float(np.median(lowest[known])) if len(known) else float("nan"),
    )


def without_jumps(quat: np.ndarray) -> np.ndarray:
    """Quaternions (T, ..., 4), each with the sign (q and -q are one rotation) that is nearer to the one before, so that
    they can be interpolated. Across one that is NaN the sign stays."""
    turned = np.nan_to_num(np.sign(np.sum(quat[1:] * quat[:-1], axis=-1, keepdims=True)), nan=1.0)
    signs = np.cumprod(np.where(turned == 0, 1.0, turned), axis=0)
    return np.concatenate([quat[:1], signs * quat[1:]])


def _offsets(position_m: np.ndarray, rotation: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """(B, 3) origins of the bodies of one pose, if there is one, in the frames of their parents."""
    offset = np.zeros((len(parent), 3))
    if len(position_m):
        between = position_m[0, 1:] - position_m[0, parent[1:]]
        offset[1:] = np.einsum("bji,bj->bi", rotation[0, parent[1:]], between)
    return offset


def uncertain_sides(
    time_s: np.ndarray,
    far_legs: Iterable[tuple[str, float, float]],
    keypoints: Keypoints | None,
    leg_sd_deg: Mapping[str, Mapping[str, np.ndarray]] | None = None,
) -> dict[str, np.ndarray]:
    """Side -> (T,) bool: frames in which its leg is less certain than it looks.

    It is behind the other leg (`far_legs`: side, start and end in s, of the cycles: `GaitCycle.far_leg`); or the mean
    confidence of its points is below `SEEN_CONFIDENCE` (if the marker set has points of these names); or the standard
    deviation of one of its angles (`gait.leg_angles_sd`, (T,) deg) reaches that of the check `joints_not_observed`.
    """
    time = np.asarray(time_s, float)
    out = {side: np.zeros(len(time), bool) for side in ("left", "right")}
    for side, start, end in far_legs:
        out[side] |= (time >= start) & (time <= end)
    if keypoints is not None and len(keypoints.time_s) == len(time):
        for side, mask in out.items():
            points = [i for i, name in enumerate(keypoints.names) if name in [f"{side}_{p}" for p in _LEG]]
            if points:
                mask |= keypoints.confidence[:, points].mean(axis=1) < SEEN_CONFIDENCE
    for side, angles in (leg_sd_deg or {}).items():
        for sd in angles.values():
            out[side] |= np.nan_to_num(sd, nan=0.0) >= SD_WARN_DEG
    return out
