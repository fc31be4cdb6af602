"""Heel, toe and pelvis over time, from a fit, from keypoints or from laboratory markers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pbl_pipeline.assumptions import check_size, check_steps, check_strides
from pbl_pipeline.errors import PblError

from ._legs import LEG_JOINTS, LEG_POINTS, BodyPoses, legs_from_points, trial_poses

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.keypoints import Keypoints

#: The pelvis turns with every stride, so its direction is averaged twice over this time (about one stride).
HEADING_WINDOW_S = 1.0
#: Below this speed the direction of travel is not compared with the heading.
MIN_TRAVEL_M_PER_S = 0.3
_input_error = functools.partial(
    PblError, "GAIT_INPUT", next_step="pass a fit.npz of `pbl fit`, or a keypoints.npz with 3D points of hips and feet"
)


def heading_from_hips(time_s: np.ndarray, hip_m: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Unit horizontal heading (T, 3) from the hips (T, 2, 3) [left, right]; NaN where no hip is seen nearby.

    Forward is left x up. The horizontal hip line is averaged over `HEADING_WINDOW_S` twice (a triangular window),
    which removes most of the pelvic rotation within a stride and still follows a turn.
    """
    left = hip_m[:, 0] - hip_m[:, 1]
    left = left - (left @ up)[:, None] * up
    smooth = _moving_mean(time_s, _moving_mean(time_s, left, HEADING_WINDOW_S), HEADING_WINDOW_S)
    forward = np.cross(smooth, up)
    length = np.linalg.norm(forward, axis=1)
    forward[~(length > 1e-9)] = np.nan
    return forward / np.where(length > 1e-9, length, 1.0)[:, None]


def heading_agreement(time_s: np.ndarray, pelvis_m: np.ndarray, forward: np.ndarray, up: np.ndarray) -> float:
    """Cosine between heading and displacement over half-second steps, weighted by the way; NaN without travel."""
    seen = np.all(np.isfinite(pelvis_m), axis=1) & np.all(np.isfinite(forward), axis=1)
    if np.count_nonzero(seen) < 2:
        return float("nan")
    time, pelvis, ahead = time_s[seen], pelvis_m[seen], forward[seen]
    later = np.searchsorted(time, time + 0.5)
    start = np.flatnonzero(later < len(time))
    if len(start) == 0:
        return float("nan")
    end = later[start]
    step = pelvis[end] - pelvis[start]
    step = step - (step @ up)[:, None] * up
    way, duration = np.linalg.norm(step, axis=1), time[end] - time[start]
    # A step across a gap in view may hide a turn.
    use = (way / duration > MIN_TRAVEL_M_PER_S) & (duration < 0.75)
    if not np.any(use):
        return float("nan")
    along = np.einsum("ti,ti->t", step[use], ahead[start[use]])
    return float(along.sum() / way[use].sum())


def _moving_mean(time_s: np.ndarray, values: np.ndarray, window_s: float) -> np.ndarray:
    """Mean of the finite rows within half a window; NaN where there is none."""
    ok = np.all(np.isfinite(values), axis=1)
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(np.where(ok[:, None], values, 0.0), axis=0)])
    count = np.concatenate([[0], np.cumsum(ok)])
    low = np.searchsorted(time_s, time_s - window_s / 2)
    high = np.searchsorted(time_s, time_s + window_s / 2, side="right")
    n = (count[high] - count[low]).astype(float)
    n[n == 0] = np.nan
    return (total[high] - total[low]) / n[:, None]


#: Points of a marker set that are read: hips for pelvis and heading, heel and toe, each (left, right). Of laboratory
#: markers the anterior spines give the line of the hips. MeTRAbs' 17 joints end at the ankles: the ankle stands for
#: heel and toe. What is lost: toe-off is then the rearmost ankle, which comes before toe-off because the heel rises
#: first.
_POINTS = {
    marker_set: {part: [own[0] for own in joints.get(part, joints["ankle"])] for part in ("hip", "heel", "toe")}
    for marker_set, joints in LEG_POINTS.items()
}
#: Marker sets that `feet_from_keypoints` and `feet_from_markers` understand.
FOOT_MARKER_SETS = tuple(_POINTS)

#: Heel in the frame of the calcaneus (x forward, y up, z right; metres, unscaled): the level of the heel marker of
#: the body figures, in the middle of the foot. The toe is the origin of the toes body, the joint of the toes, so
#: that a toe angle that no keypoint supports cannot move it.
_HEEL_IN_CALCN_M = np.array([-0.01617, -0.00123, 0.0])
_WORLD_UP = np.array([0.0, 0.0, 1.0])

#: The fit's movement between two observations of a foot is accepted up to this time from the nearer one (s).
BRIDGED_S = 0.25
#: Bodies whose points are those of a foot.
_FOOT = ("talus", "calcn", "toes")


@dataclasses.dataclass(frozen=True)
class FootTrajectories:
    """Feet and pelvis of one trial. Frames without the person are NaN."""

    time_s: np.ndarray  # (T,)
    #: (T, 2, 3) [left, right], metres (or any one unit: only ratios to the leg length are used).
    heel_m: np.ndarray
    toe_m: np.ndarray
    #: (T, 3) middle between the hips. May stand still (root-relative points): only positions relative to it are used.
    pelvis_m: np.ndarray
    forward: np.ndarray  # (T, 3) unit horizontal heading, the direction the pelvis faces, averaged over about a stride
    #: (3,) unit vertical. World: z. Camera frame without phone orientation: -y, which assumes a level camera.
    up: np.ndarray
    confidence: np.ndarray  # (T, 2) 0..1 of each foot's points; NaN where the source states none (a fit)
    source: str  # "fit", "keypoints <marker set>", "markers <marker set>"
    #: Cosine between heading and displacement, weighted by the way covered; 1 = walks where the pelvis faces, -1 =
    #: backwards or left and right exchanged; NaN where the pelvis does not travel or its position is relative.
    heading_agreement: float = float("nan")
    #: (T, 5, 2, 3) or None: hip, knee, ankle, heel, toe of [left, right] in the same frame, NaN where not known; what
    #: the event model reads.
    legs_m: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.time_s)
        wanted = {"heel_m": (n, 2, 3), "toe_m": (n, 2, 3), "pelvis_m": (n, 3), "forward": (n, 3), "confidence": (n, 2)}
        if self.legs_m is not None:
            wanted["legs_m"] = (n, len(LEG_JOINTS), 2, 3)
        for name, shape in wanted.items():
            if np.shape(getattr(self, name)) != shape:
                raise _input_error(f"{name} has shape {np.shape(getattr(self, name))}", f"shape {shape}")
        time = np.asarray(self.time_s, float)
        if not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
            raise _input_error("time stamps that are missing or do not increase", "strictly increasing seconds")


def feet_from_fit(fit: TrialFit, poses: BodyPoses | None = None) -> FootTrajectories:
    """Heel, toe joint and hip centres of the fitted body, world frame (z up); `poses` saves computing them again.

    Frames whose qpos is NaN stay NaN, and so does a leg below the hip while nothing of its foot was seen
    (`_feet_seen`): there the fit follows its priors, which contain no steps. Raises `PblError` GAIT_INPUT (no finite
    frame, time stamps out of order).
    """
    poses = poses or trial_poses(fit)
    # A handheld phone moves with the person: the way in its frame is not the way on the ground.
    travels = fit.camera_motion == "static"
    return feet_from_poses(fit.time_s, poses, fit.scale, "fit", travels, ~_feet_seen(fit))


def feet_from_poses(
    time_s: np.ndarray, poses: BodyPoses, scale: np.ndarray, source: str, travels: bool, unseen: np.ndarray
) -> FootTrajectories:
    """Heel, toe joint and hip centres of a body of this scale (8,) in its poses; a leg below the hip is NaN where it is
    `unseen` (T, 2). `travels`: the pelvis' path is that over the ground. Raises `PblError` GAIT_INPUT (time stamps)."""
    hips, knees, ankles, heels, toes = map(poses.of_sides, ("femur", "tibia", "talus", "calcn", "toes"))
    for s, name in enumerate(("calcn_l", "calcn_r")):
        heels[:, s] += poses.rotation[:, poses.index(name)] @ (_HEEL_IN_CALCN_M * poses.scale_of(name, scale))
    for joint in (knees, ankles, heels, toes):
        joint[unseen] = np.nan
    legs = np.stack([hips, knees, ankles, heels, toes], axis=1)
    return _assemble(
        time_s, hips, heels, toes, _WORLD_UP, np.full((len(poses.position_m), 2), np.nan), source, travels, legs
    )


#: Distance (m) from the middle of the hips to a heel of an adult who stands.
_ADULT_M = 0.93


def check_feet(feet: FootTrajectories, name: str) -> None:
    """Check unit, times and strides of feet in metres against a person. Raises `PblError` GAIT_INPUT."""

    def refuse(found: str, expected: str, next_step: str) -> PblError:
        return PblError("GAIT_INPUT", found, expected, next_step, name)

    check_steps(feet.time_s, refuse)
    reach = np.linalg.norm(feet.heel_m - feet.pelvis_m[:, None], axis=2)
    seen = reach[np.isfinite(reach)]
    check_size(float(np.percentile(seen, 95)) / _ADULT_M if len(seen) else float("nan"), refuse)
    across = np.eye(3)[[i for i in range(3) if i != np.argmax(np.abs(feet.up))]]
    check_strides((feet.heel_m[:, 0] - feet.heel_m[:, 1]) @ across.T, feet.time_s, refuse)


def _feet_seen(fit: TrialFit) -> np.ndarray:
    """(T, 2) [left, right]: whether a point of that foot, from the ankle down, was observed within `BRIDGED_S`.

    Observed points have residuals. A fit of a laboratory's own marker set, whose points are not known here, counts as
    seen.
    """
    from pbl_pipeline.body import MARKER_SETS, marker_set  # JAX loads only where a fit is read

    seen = np.ones((len(fit.time_s), 2), bool)
    if fit.marker_set not in MARKER_SETS or marker_set(fit.marker_set).names != fit.marker_names:
        return seen
    time = np.asarray(fit.time_s, float)
    observed = np.isfinite(fit.residual_2d_px) | np.isfinite(fit.residual_3d_m)
    for s, side in enumerate("lr"):
        foot = np.isin(marker_set(fit.marker_set).body_names, [f"{b}_{side}" for b in _FOOT])
        known = time[observed[:, foot].any(axis=1)]
        if not len(known):
            seen[:, s] = False
            continue
        after = np.clip(np.searchsorted(known, time), 0, len(known) - 1)
        away = np.minimum(np.abs(known[after] - time), np.abs(known[np.maximum(after - 1, 0)] - time))
        seen[:, s] = away <= BRIDGED_S
    return seen


def feet_from_keypoints(keypoints: Keypoints) -> FootTrajectories:
    """Feet from the 3D points of a detector.

    With phone orientation the points are turned into the world frame (z up); without it they stay in the camera
    frame and gravity is taken as -y of the camera, which assumes a level camera: 10 deg of tilt shorten the forward
    movement by 2 % and do not move its extrema in time. Root-relative points are as good as absolute ones because the
    method is relative to the pelvis; only the check of the heading needs absolute ones.

    Raises `PblError` GAIT_INPUT if the marker set has no feet or no 3D point was seen.
    """
    xyz = np.asarray(keypoints.xyz_cam_m, float)
    up = np.array([0.0, -1.0, 0.0])
    if keypoints.phone_time_s is not None and keypoints.phone_quat_wxyz is not None and len(keypoints.phone_time_s) > 1:
        turns = Rotation.from_quat(np.asarray(keypoints.phone_quat_wxyz, float), scalar_first=True)
        phone = np.asarray(keypoints.phone_time_s, float)
        at = Slerp(phone, turns)(np.clip(keypoints.time_s, phone[0], phone[-1]))
        xyz = np.einsum("tij,tkj->tki", at.as_matrix(), xyz)
        up = _WORLD_UP
    from pbl_pipeline.keypoints import unoriented_frames

    known = ~unoriented_frames(keypoints)[:, None]
    xyz = np.where(known[..., None], xyz, np.nan)
    return _from_points(
        np.asarray(keypoints.time_s, float),
        keypoints.names,
        keypoints.marker_set,
        xyz,
        np.asarray(keypoints.confidence, float) * known,
        up,
        f"keypoints {keypoints.marker_set}",
        travels=not keypoints.root_relative,
    )


def feet_from_markers(
    time_s: np.ndarray,
    names: Sequence[str],
    marker_set: str,
    xyz_world_m: np.ndarray,
    confidence: np.ndarray | None = None,
) -> FootTrajectories:
    """Feet from laboratory markers (T, J, 3) in a world frame with z up. `confidence` (T, J) or None for unknown.

    Raises `PblError` GAIT_INPUT as `feet_from_keypoints`.
    """
    xyz = np.asarray(xyz_world_m, float)
    known = np.full(xyz.shape[:2], np.nan) if confidence is None else np.asarray(confidence, float)
    return _from_points(
        np.asarray(time_s, float), names, marker_set, xyz, known, _WORLD_UP, f"markers {marker_set}", travels=True
    )


def _from_points(time_s, names, marker_set, xyz, confidence, up, source, *, travels) -> FootTrajectories:
    if marker_set not in _POINTS:
        raise _input_error(f"marker set {marker_set!r}", f"one of {', '.join(FOOT_MARKER_SETS)}")
    index = {name: i for i, name in enumerate(names)}
    wanted = _POINTS[marker_set]
    missing = [n for pair in wanted.values() for n in pair if n not in index]
    if missing:
        raise _input_error(f"no points named {', '.join(dict.fromkeys(missing))}", f"the names of {marker_set}")
    columns = {part: [index[n] for n in pair] for part, pair in wanted.items()}
    hip, heel, toe = (xyz[:, columns[part]] for part in ("hip", "heel", "toe"))
    if not np.any(np.isfinite(hip).all(axis=(1, 2)) & np.isfinite(heel + toe).all(axis=2).any(axis=1)):
        raise _input_error("no frame with hips and feet in 3D", "3D points (xyz) of hips and feet")
    foot = np.minimum(confidence[:, columns["heel"]], confidence[:, columns["toe"]])
    legs = legs_from_points(marker_set, names, xyz, confidence)
    return _assemble(time_s, hip, heel, toe, up, foot, source, travels, legs)


def _assemble(time_s, hip, heel, toe, up, confidence, source, travels, legs) -> FootTrajectories:
    time = np.asarray(time_s, float)
    pelvis = hip.mean(axis=1)
    if np.any(np.diff(time) <= 0) or not np.all(np.isfinite(time)):
        raise _input_error("time stamps that are missing or do not increase", "strictly increasing seconds")
    forward = heading_from_hips(time, hip, up)
    agreement = heading_agreement(time, pelvis, forward, up) if travels else float("nan")
    return FootTrajectories(time, heel, toe, pelvis, forward, up, confidence, source, agreement, legs)
