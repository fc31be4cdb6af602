"""Whether the people that several calibrated cameras see are one person: by how much their rays miss each other."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pbl_pipeline.errors import PblError
from pbl_pipeline.video import undistort_px

from .multi_view import MultiView

#: Most by which rays to the points of one person miss the points that are nearest to all of them (m), mean over points.
#: docs/accuracy.md has what it was chosen from.
MOST_MISS_M = 0.1
#: Points that a frame needs in two cameras, as a share of all, to be compared.
_COMPARED_SHARE = 0.5


def ray_miss_m(trial: MultiView) -> Float[np.ndarray, " V"]:
    """How far each camera's rays to the person's points pass the triangulated points (m): the mean over the points of
    a frame, the median over the frames. NaN for a camera that shares no frame with another.

    A point is triangulated where two cameras see it, as the place with the least sum of squared distances to their
    rays, each weighted with its confidence (Hartley & Zisserman 2004, chapter 12, names it the midpoint method for two
    views). Two cameras of one height see a person at another place by the height of the points alone.
    """
    origin = np.stack([p.p_nc for p in trial.poses])
    seen = np.stack([v.confidence > 0 for v in trial.views], axis=2)  # (T, J, V)
    weight = np.where(seen, np.stack([v.confidence for v in trial.views], axis=2), 0.0)
    ray = np.stack([_rays(trial, i) for i in range(len(trial.views))], axis=2)  # (T, J, V, 3)
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    twice = seen.sum(axis=2) >= 2
    a = np.einsum("tjv,tjvab->tjab", weight, across)
    b = np.einsum("tjv,tjvab,vb->tja", weight, across, origin)
    a = np.where(twice[..., None, None], a, np.eye(3))
    place = np.linalg.solve(a + 1e-9 * np.eye(3), b[..., None])[..., 0]
    to = place[:, :, None] - origin
    miss = np.linalg.norm(np.einsum("tjvab,tjvb->tjva", across, to), axis=-1)
    # A camera cannot see a point behind it: its distance counts as the miss.
    behind = np.einsum("tjva,tjva->tjv", to, ray) < 0
    miss = np.where(behind, np.linalg.norm(to, axis=-1), miss)
    counted = seen & twice[..., None]
    n = counted.sum(axis=1)  # (T, V)
    mean = np.where(counted, miss, 0.0).sum(axis=1) / np.maximum(n, 1)
    compared = n >= _COMPARED_SHARE * len(trial.names)
    return np.array([np.median(mean[c, i]) if (c := compared[:, i]).any() else np.nan for i in range(n.shape[1])])


def check_views_agree(trial: MultiView, name: str) -> float:
    """The largest of `ray_miss_m` (m), NaN where no two cameras see the person in one frame.

    Raises `PblError` VIEWS_DISAGREE: more than `MOST_MISS_M`.
    """
    miss = ray_miss_m(trial)
    most = float(np.max(miss, initial=-np.inf, where=np.isfinite(miss)))
    if not np.isfinite(most):
        return float("nan")
    if most > MOST_MISS_M:
        names = trial.cameras or tuple(f"view {i}" for i in range(1, len(miss) + 1))
        cells = ", ".join(f"{n} {100 * m:.0f} cm" for n, m in zip(names, miss, strict=True) if np.isfinite(m))
        raise PblError(
            "VIEWS_DISAGREE",
            found=f"trial {name}: rays of the cameras to the person's points miss each other ({cells})",
            expected=f"at most {100 * MOST_MISS_M:.0f} cm: one person, cameras that stand where the calibration says",
            next_step="look at the numbered people of each view (`pbl choose VIDEO_ID --sheet FILE`) and choose the "
            "same person in all; where they are the same, check the order of the cameras and calibrate again",
            key=name,
        )
    return most


def _rays(trial: MultiView, i: int) -> Float[np.ndarray, "T J 3"]:
    """Unit vectors in the world to each point of a view."""
    view, camera = trial.views[i], trial.views[i].camera
    xy = undistort_px(np.where((view.confidence > 0)[..., None], view.xy_px, 0.0), camera)
    ones = np.ones((*xy.shape[:2], 1))
    ray = np.concatenate([xy, ones], axis=2) @ np.linalg.inv(camera.matrix).T @ trial.poses[i].R_nc.T
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)
