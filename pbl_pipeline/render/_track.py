"""The fitted body in pixels, frame by frame, for a program that draws it itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from pbl_pipeline.body import capsules, load_body
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.render._overlay import check_body
from pbl_pipeline.render._project import to_camera, to_pixels
from pbl_pipeline.render._style import side_of

#: Confidence of a side's leg below which it is drawn as uncertain: as `draw_keypoints` draws points hollow.
SEEN_CONFIDENCE = 0.5
_LEG = ("hip", "knee", "ankle", "heel", "foot_index")


@dataclasses.dataclass(frozen=True)
class BodyTrack:
    """G capsules over T frames, in pixels of the upright video.

    Attributes
    ----------
    body_names, sides
        The body that each capsule belongs to, and its side ("left", "right", "middle").
    discs_px : (T, G, 2, 3)
        x, y and radius of the discs that a capsule's two ends project to; its outline is their hull. NaN where the pose
        is unknown or the end is behind the camera.
    depth_m : (T, G)
        Of the capsule's middle, from the camera.
    """

    body_names: tuple[str, ...]
    sides: tuple[str, ...]
    discs_px: np.ndarray
    depth_m: np.ndarray


def body_track(fit: TrialFit) -> BodyTrack:
    """The body of a fit in every frame of its video, as `render_overlay` draws it (`capsule_outline`).

    Raises `PblError` FILE_FORMAT for a fit of another body model than the installed one.
    """
    body = load_body()
    check_body(fit, body)
    shapes = capsules(body, fit.qpos, fit.scale)
    ends = np.stack([shapes.start, shapes.end], axis=2)  # (T, G, 2, 3)
    seen = np.full_like(ends, np.nan)
    for t, quat in enumerate(np.asarray(fit.phone_quat_wxyz, float)):
        if np.isfinite(quat).all():
            seen[t] = to_camera(ends[t], quat, fit.camera_position_m)
    focal = 0.5 * (fit.camera.matrix[0, 0] + fit.camera.matrix[1, 1])
    centre = to_pixels(seen, fit.camera)
    with np.errstate(invalid="ignore", divide="ignore"):
        radius = focal * shapes.radius_m[:, None] / np.where(np.isfinite(centre[..., 0]), seen[..., 2], np.nan)
    names = shapes.body_names
    discs = np.concatenate([centre, radius[..., None]], axis=-1)
    return BodyTrack(names, tuple(side_of(n) for n in names), discs, seen[..., 2].mean(axis=2))


def uncertain_sides(
    time_s: np.ndarray, far_legs: Iterable[tuple[str, float, float]], keypoints: Keypoints | None
) -> dict[str, np.ndarray]:
    """Side -> (T,) bool: frames in which its leg is less certain than it looks.

    It is behind the other leg (`far_legs`: side, start and end in s, of the cycles: `GaitCycle.far_leg`), or the mean
    confidence of its points is below `SEEN_CONFIDENCE`; marker sets without points of such names tell nothing.
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
    return out
