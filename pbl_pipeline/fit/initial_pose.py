"""Start of a fit: the standing body, placed and turned in each frame by the points of the trunk, its arms in the
nearest of some postures.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, SLIDES, Body, MarkerSet

from .problem import TrialArrays
from .session import Session
from .standing import SETS, bodies_at, marker_places, standing_markers, trunk_of

#: Joint angles (deg) of the start beside the standing pose: bent a little, away from limits and from straight limbs.
BENT_DEG = {"knee_angle": -10.0, "elbow_flex": 20.0, "pro_sup": 45.0, "hip_flexion": 5.0}
#: Bodies whose markers show the posture of an arm.
ARM_BODIES = ("humerus", "ulna", "radius", "hand")
#: An arm that does not hang starts in the nearest of these postures (deg, all combinations). From hanging arms the
#: solver converged to elbows bent backwards, and frames recovered one after the other, a step each.
ARM_DEG = {
    "arm_flex": (-30.0, 0.0, 40.0, 90.0, 140.0),
    "arm_add": (-80.0, -40.0, 0.0),
    "arm_rot": (-40.0, 0.0, 40.0),
    "elbow_flex": (20.0, 60.0, 110.0),
}
#: A posture is accepted if the mean distance (m) of an arm's points from it is less than from hanging by the first at
#: least, and below the second, which the walks of the tests do not reach on a body that faces the wrong way.
NEARER_M, FURTHEST_M = 0.10, 0.15
#: The body is placed, and its arms are compared, every so many frames, and interpolated.
PLACED_EVERY, ARMS_EVERY = 3, 15


def placed_poses(session: Session, trial: int, flip: bool = False, every: int = PLACED_EVERY) -> np.ndarray:
    """qpos (T, 40) of one trial; `flip`: facing the other way; `every`: use every so many frames."""
    n = len(session.arrays[trial].used)
    looked = np.arange(0, n, every)
    arrays = _at(session.arrays[trial], looked)
    points, c = world_points(arrays)
    body, markers = session.body, session.markers
    trunk = trunk_of(markers)
    template, weight = standing_markers(body, markers)[trunk], c[:, trunk]
    R, x = align(template, points[:, trunk], weight)
    known = (np.count_nonzero(weight, axis=1) >= 3) & np.isfinite(x).all(axis=1) & arrays.used
    if not known.any():
        # Nothing to turn it by: straight ahead of the first camera, facing it.
        R, x = np.tile(np.diag([-1.0, -1.0, 1.0]), (len(x), 1, 1)), np.tile([4.0, 0.0, 0.0], (len(x), 1))
        known = arrays.used.copy()
    if flip:
        middle = np.mean(template, axis=0)
        about = R @ middle + x
        R = R @ np.diag([-1.0, -1.0, 1.0])  # half a turn about the standing body's vertical
        x = about - R @ middle
    qpos = _poses(body, R[known], x[known], looked[known], n)
    seen = np.flatnonzero(known)[:: ARMS_EVERY // every]
    on_body = np.einsum("tji,tmj->tmi", R[seen], points[seen] - x[seen, None])
    _place_arms(qpos, body, markers, looked[seen], on_body, c[seen])
    return qpos


def _at(arrays: TrialArrays, frames: np.ndarray) -> TrialArrays:
    """Some frames of a trial."""
    rows = {f.name: getattr(arrays, f.name) for f in dataclasses.fields(arrays) if not f.name.startswith("phone")}
    return TrialArrays(**{k: v[frames] for k, v in rows.items()})


def _place_arms(
    qpos: np.ndarray, body: Body, markers: MarkerSet, seen: np.ndarray, points: np.ndarray, c: np.ndarray
) -> None:
    """Set the arms' columns of qpos (T, Q) by points (S, J, 3) and confidences (S, J) of the frames `seen`, in the axes
    of the standing body, from its pelvis."""
    for arm in _arms(body, markers):
        enough = np.count_nonzero(c[:, arm.markers] > 0, axis=1) >= 2
        if enough.any():
            angles = arm.nearest(points[enough][:, arm.markers], c[enough][:, arm.markers])
            for column, values in zip(arm.columns, angles.T, strict=True):
                qpos[:, column] = np.interp(np.arange(len(qpos)), seen[enough], values)


@dataclasses.dataclass(frozen=True)
class _Arm:
    """Postures (K, n) in rad of the joints in `columns`, the first of them hanging, and where the arm's `markers` (m,)
    are in these, from the pelvis (K, m, 3)."""

    markers: np.ndarray
    columns: list[int]
    postures: np.ndarray
    places: np.ndarray

    def nearest(self, points: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Angles (T, n) in rad for points (T, m, 3) of the markers, from the pelvis of the standing body."""
        # Squared distances (m, T, K) by products of matrices: the differences are many.
        x, y = np.swapaxes(points, 0, 1), np.swapaxes(self.places, 0, 1)
        square = np.sum(x**2, axis=-1)[..., None] + np.sum(y**2, axis=-1)[:, None] - 2 * x @ np.swapaxes(y, 1, 2)
        mean = np.einsum("mtk,tm->tk", np.sqrt(np.maximum(square, 0.0)), c) / c.sum(axis=1)[:, None]
        least = np.min(mean, axis=1)
        taken = (least < FURTHEST_M) & (least < mean[:, 0] - NEARER_M)
        return self.postures[np.where(taken, np.argmin(mean, axis=1), 0)]


@functools.lru_cache(SETS)
def _arms(body: Body, markers: MarkerSet) -> list[_Arm]:
    found, standing = [], _bent(body)
    for side in "rl":
        columns = [body.joint_names.index(f"{joint}_{side}") for joint in ARM_DEG]
        postures = np.vstack([standing[columns], np.deg2rad(list(itertools.product(*ARM_DEG.values())))])
        qpos = np.tile(standing, (len(postures), 1))
        qpos[:, columns] = postures
        at = np.flatnonzero([b in {f"{name}_{side}" for name in ARM_BODIES} for b in markers.body_names])
        found.append(_Arm(at, columns, postures, marker_places(*bodies_at(body, qpos), markers, at)))
    return found


def world_points(arrays: TrialArrays) -> tuple[np.ndarray, np.ndarray]:
    """World positions (T, J, 3) in m and confidences (T, J) of the observed points, whatever the kind of trial."""
    if np.any(arrays.c_world > 0):
        return arrays.x_world, arrays.c_world
    v = int(np.argmax(np.sum(arrays.c_3d, axis=(0, 2)))) if arrays.c_3d.shape[1] > 1 else 0
    if np.any(arrays.c_3d[:, v] > 0):
        c = arrays.c_3d[:, v]
        root = root_positions(
            arrays.x_cam[:, v], arrays.xy_px[:, v], np.minimum(c, arrays.c_2d[:, v]), arrays.camera_matrix[:, v]
        )
        x = arrays.x_cam[:, v] + root[:, None]
        return x @ np.swapaxes(arrays.R_nc[:, v], -1, -2) + arrays.p_nc[:, v, None], c
    return triangulate(arrays)


def root_positions(x_cam: np.ndarray, xy_px: np.ndarray, c: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Camera-frame position (T, 3) in m of the origin of root-relative points (T, J, 3), from their pixels.

    Weighted least squares on ``fx (x + tx) = (u - cx) (z + tz)`` and the like for v, linear in the unknown
    (tx, ty, tz). NaN in frames with fewer than four points seen.
    """
    x, y, z = np.moveaxis(x_cam, -1, 0)
    u, v = ((xy_px[..., k] - matrix[:, k, 2, None]) / matrix[:, k, k, None] for k in (0, 1))  # (T, J)
    # Rows a . t = b with a = (1, 0, -u) and (0, 1, -v), b = (u, v) z - (x, y).
    b_u, b_v = u * z - x, v * z - y
    total = lambda a: np.einsum("tj,tj->t", c, a)  # noqa: E731
    n, of_u, of_v = np.sum(c, axis=1) + 1e-9, total(u), total(v)
    to_u, to_v = total(b_u), total(b_v)
    tz = of_u * to_u + of_v * to_v - n * total(u * b_u + v * b_v)
    tz /= n * (total(u**2 + v**2) + 1e-9) - of_u**2 - of_v**2
    out = np.stack([(to_u + of_u * tz) / n, (to_v + of_v * tz) / n, tz], axis=-1)
    out[np.count_nonzero(c > 0, axis=1) < 4] = np.nan
    return out


def triangulate(arrays: TrialArrays) -> tuple[np.ndarray, np.ndarray]:
    """World points (T, J, 3) of several cameras: the point nearest to all viewing rays; confidence 0 under 2 views."""
    matrix, R = arrays.camera_matrix, arrays.R_nc
    focal = np.stack([matrix[..., 0, 0], matrix[..., 1, 1]], -1)[:, :, None]
    d = (arrays.xy_px - matrix[..., None, :2, 2]) / focal
    ray = np.concatenate([d, np.ones((*d.shape[:-1], 1))], axis=-1)
    ray = np.einsum("tvij,tvmj->tvmi", R, ray / np.linalg.norm(ray, axis=-1, keepdims=True))
    across = arrays.c_2d[..., None, None] * (np.eye(3) - ray[..., :, None] * ray[..., None, :])
    normal = np.sum(across, axis=1)
    right = np.einsum("tvmij,tvj->tmi", across, arrays.p_nc)
    seen = np.count_nonzero(arrays.c_2d > 0, axis=1) >= 2
    out = np.zeros(right.shape)
    out[seen] = np.linalg.solve(normal[seen] + 1e-9 * np.eye(3), right[seen][..., None])[..., 0]
    return out, np.where(seen, np.max(arrays.c_2d, axis=1), 0.0)


def align(template: np.ndarray, points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3) and positions (T, 3) with points = R template + x, weighted least squares (Kabsch)."""
    total = np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    a = weight @ template / total
    weighted = weight[..., None] * points
    b = weighted.sum(axis=1) / total
    # The weighted points have mean b, so the template needs no centring.
    H = np.tensordot(weighted, template, (1, 0)) - b[:, :, None] * (weight @ template)[:, None]
    U, _, Vt = np.linalg.svd(np.nan_to_num(H))
    mirror = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= np.where(mirror == 0, 1.0, mirror)[:, None]
    R = U @ Vt
    return R, b - (R @ a[..., None])[..., 0]


def _poses(body: Body, R: np.ndarray, x: np.ndarray, frames: np.ndarray, n: int) -> np.ndarray:
    """Poses (n, Q) with the pelvis of the standing template turned by R and moved to x in some frames, and between."""
    column = {n: k for k, n in enumerate(body.joint_names)}
    qpos = np.tile(_bent(body), (n, 1))
    stands = pelvis_rest(body)[0]
    for name, value in pelvis_values(body, R @ stands, x).items():
        qpos[:, column[name]] = np.interp(np.arange(n), frames, value)
    return qpos


def _bent(body: Body) -> np.ndarray:
    """The standing posture of the start, (Q,)."""
    qpos = np.zeros(len(body.joint_names))
    for k, name in enumerate(body.joint_names):
        qpos[k] = np.deg2rad(BENT_DEG.get(name.removesuffix("_r").removesuffix("_l"), 0.0))
    return qpos


@functools.cache
def pelvis_rest(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and position (3,) of the pelvis in the world at qpos 0."""
    pelvis = body.mj_model.body("pelvis")
    return Rotation.from_quat(pelvis.quat, scalar_first=True).as_matrix(), np.asarray(pelvis.pos)


def pelvis_path(body: Body, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and rotations (T, 3, 3) of the pelvis in the world."""
    column = {n: k for k, n in enumerate(body.joint_names)}
    stands, rest = pelvis_rest(body)
    slides = qpos[:, [column[n] for n in SLIDES]]
    turns = qpos[:, [column[n] for n in PELVIS_TURNS]]
    return slides @ stands.T + rest, stands @ _pelvis_turn(*turns.T)


def _pelvis_turn(tilt: np.ndarray, lean: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Rz(tilt) Rx(list) Ry(heading), (T, 3, 3): the hinges turn about z, x and y in this order."""
    (a, b, c), (sa, sb, sc) = ([f(angle) for angle in (tilt, lean, heading)] for f in (np.cos, np.sin))
    rows = [
        [a * c - sa * sb * sc, -sa * b, a * sc + sa * sb * c],
        [sa * c + a * sb * sc, a * b, sa * sc - a * sb * c],
        [-b * sc, sb, b * c],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def pelvis_values(body: Body, R: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray]:
    """The pelvis' six joint values (T,) where its frame is turned by R (T, 3, 3) and lies at x (T, 3), in the world."""
    stands, rest = pelvis_rest(body)
    turned = stands.T @ R
    tilt = np.arctan2(-turned[:, 0, 1], turned[:, 1, 1])
    lean = np.arcsin(np.clip(turned[:, 2, 1], -1.0, 1.0))
    heading = np.arctan2(-turned[:, 2, 0], turned[:, 2, 2])
    slides = stands.T @ (x - rest).T
    turns = {"pelvis_tilt": tilt, "pelvis_list": lean, "pelvis_rotation": np.unwrap(heading)}
    return dict(zip(SLIDES, slides, strict=True)) | turns


def paper_pose(session: Session, trial: int, distance_m: float, middle: Float[np.ndarray, " Q"]) -> np.ndarray:
    """qpos (Q,) with every angle at the middle of its range and the pelvis straight ahead of the trial's camera.

    Ahead of its median orientation where it turns. Trials of several cameras or of markers in the world, for which the
    paper has no start, take `median_pose`.
    """
    arrays = session.arrays[trial]
    if arrays.c_3d.shape[1] != 1:
        return median_pose(session, trial)
    ahead = Rotation.from_rotvec(median_orientation(session, trial)).as_matrix()[:, 2]
    stands, rest = pelvis_rest(session.body)
    qpos = np.array(middle)
    qpos[[session.body.joint_names.index(n) for n in SLIDES]] = stands.T @ (
        arrays.p_nc[0, 0] + distance_m * ahead - rest
    )
    return qpos


def median_pose(session: Session, trial: int) -> np.ndarray:
    """qpos (Q,) of the standing body at the medians over the trial of pelvis position and heading."""
    body, used = session.body, session.arrays[trial].used
    poses = placed_poses(session, trial, every=1)[used]
    angle = poses[:, body.joint_names.index("pelvis_rotation")]
    mean = np.angle(np.mean(np.exp(1j * angle)))  # circular, so that +179 and -179 deg agree
    heading = mean + np.median(np.angle(np.exp(1j * (angle - mean))))
    qpos = np.where(body.is_slide, np.median(poses, axis=0), 0.0)
    qpos[body.joint_names.index("pelvis_rotation")] = np.angle(np.exp(1j * heading))
    return qpos


def median_orientation(session: Session, trial: int) -> np.ndarray:
    """Rotation vector (3,) in rad of the median orientation R_nc of a trial's camera over the frames that count.

    The median of each component of the rotations away from the mean orientation. Zero without a camera.
    """
    arrays = session.arrays[trial]
    if arrays.R_nc.shape[1] == 0:
        return np.zeros(3)
    R = Rotation.from_matrix(arrays.R_nc[arrays.used, 0])
    mean = R.mean()
    return (Rotation.from_rotvec(np.median((R * mean.inv()).as_rotvec(), axis=0)) * mean).as_rotvec()
