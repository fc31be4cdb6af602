"""The joints of both legs that marker sets share, from a fit, from keypoints or from laboratory markers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pbl_pipeline.errors import PblError, said

if TYPE_CHECKING:
    from pbl_pipeline.body import Body
    from pbl_pipeline.fit import TrialFit

_CHUNK = 128
_input_error = functools.partial(
    PblError, "GAIT_INPUT", next_step="pass a fit.npz that `pbl fit` of this version wrote"
)


@dataclasses.dataclass(frozen=True)
class BodyPoses:
    """`position_m` (T, B, 3) and `rotation` (T, B, 3, 3), body to world (z up), NaN in frames without qpos."""

    body: Body
    position_m: np.ndarray
    rotation: np.ndarray

    def index(self, name: str) -> int:
        """Index of a body in the second axis."""
        return self.body.body_names.index(name)

    def of_sides(self, name: str) -> np.ndarray:
        """Positions (T, 2, 3) of a body of the [left, right] side."""
        return self.position_m[:, [self.index(f"{name}_{side}") for side in "lr"]]

    def scale_of(self, name: str, scale: np.ndarray) -> float:
        """The multiplier of a body's points."""
        return float(np.asarray(scale)[self.body.scale_index[self.index(name)]])


def trial_poses(fit: TrialFit) -> BodyPoses:
    """Forward kinematics of a fit.

    Raises `PblError` GAIT_INPUT if no frame is finite, or joints are missing or in degrees.
    """
    from pbl_pipeline.body import SLIDES, load_body  # JAX loads only where a fit is read

    body = load_body()
    if tuple(fit.joint_names) != body.joint_names:
        raise _input_error("joints of another body", f"the {len(body.joint_names)} joints of {body.name}")
    qpos = np.asarray(fit.qpos, float)
    seen = np.flatnonzero(np.all(np.isfinite(qpos), axis=1))
    if len(seen) == 0:
        raise _input_error("a fit without one finite frame", "joint angles in at least some frames")
    turns = np.array([n not in SLIDES and not n.startswith("pelvis") for n in body.joint_names])
    widest = float(np.abs(qpos[np.ix_(seen, np.flatnonzero(turns))]).max())
    # A joint turns by less than half a turn; the pelvis may go round and round.
    if widest > 2 * np.pi:
        raise PblError(
            "GAIT_INPUT",
            found=said("a joint at {widest:.3g} rad", widest=widest),
            expected="qpos in radians, no joint beyond a full turn",
            next_step="write qpos in radians, as `pbl fit` does; the angles.csv beside it is in degrees",
            key=fit.name,
        )
    return poses_of(qpos, fit.scale)


def poses_of(qpos: np.ndarray, scale: np.ndarray) -> BodyPoses:
    """Forward kinematics of joint values (T, 40) in m and rad, NaN in unknown frames, of a body of this scale (8,)."""
    from pbl_pipeline.body import load_body

    body, seen = load_body(), np.flatnonzero(np.all(np.isfinite(qpos), axis=1))
    padded = np.zeros((max(-(-len(seen) // _CHUNK), 1) * _CHUNK, qpos.shape[1]), np.float32)
    padded[: len(seen)] = qpos[seen]
    scale = np.asarray(scale, np.float32)
    parts = [_compiled()(padded[i : i + _CHUNK], scale) for i in range(0, len(padded), _CHUNK)]
    position = np.full((len(qpos), len(body.body_names), 3), np.nan)
    rotation = np.full((*position.shape, 3), np.nan)
    position[seen] = np.concatenate([np.asarray(p[0]) for p in parts])[: len(seen)]
    rotation[seen] = np.concatenate([np.asarray(p[1]) for p in parts])[: len(seen)]
    return BodyPoses(body, position, rotation)


@functools.cache
def _compiled() -> Any:
    import jax

    from pbl_pipeline.body import body_poses, load_body

    body = load_body()
    return jax.jit(lambda qpos, scale: body_poses(body, qpos, scale))


#: Joints in the order of `legs_m`; a marker set may lack some.
LEG_JOINTS = ("hip", "knee", "ankle", "heel", "toe")

#: joint -> names (left, right) by marker set. Several names are averaged.
LEG_POINTS: dict[str, dict[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "blazepose_33": {
        "hip": (("left_hip",), ("right_hip",)),
        "knee": (("left_knee",), ("right_knee",)),
        "ankle": (("left_ankle",), ("right_ankle",)),
        "heel": (("left_heel",), ("right_heel",)),
        "toe": (("left_foot_index",), ("right_foot_index",)),
    },
    # The feet end at the ankles.
    "mpi_inf_3dhp_17": {
        "hip": (("left_hip",), ("right_hip",)),
        "knee": (("left_knee",), ("right_knee",)),
        "ankle": (("left_ankle",), ("right_ankle",)),
    },
    # The set's hip lies about 10 cm behind the joint, the anterior spine 5 cm ahead of it.
    "bml_movi_87": {
        "hip": (("LHip", "lasis"), ("RHip", "rasis")),
        "knee": (("LKnee",), ("RKnee",)),
        "ankle": (("LAnkle",), ("RAnkle",)),
        "heel": (("LHeel",), ("RHeel",)),
        "toe": (("lfirstmetatarsal",), ("rfirstmetatarsal",)),
    },
    "plug_in_gait": {
        "hip": (("LASI",), ("RASI",)),
        "knee": (("LKNE",), ("RKNE",)),
        "ankle": (("LANK",), ("RANK",)),
        "heel": (("LHEE",), ("RHEE",)),
        "toe": (("LTOE",), ("RTOE",)),
    },
}


def legs_from_points(
    marker_set: str,
    names: Sequence[str],
    xyz_m: Float[np.ndarray, "T J 3"],
    confidence: Float[np.ndarray, "T J"] | None,
) -> Float[np.ndarray, "T 5 2 3"]:
    """Joints of both legs in the frame of the points, NaN if the set has none, nothing was seen or the confidence is
    below 0.1. Hip joints of `plug_in_gait` follow from the spines of the pelvis (Harrington et al. 2007) if the
    posterior ones are among the names; else the anterior spine is taken as the hip."""
    index = {name: i for i, name in enumerate(names)}
    seen = np.asarray(xyz_m, float)
    if confidence is not None:
        unsure = np.asarray(confidence) < MIN_CONFIDENCE  # False for NaN: unknown is not low
        seen = np.where(unsure[..., None], np.nan, seen)
    out = np.full((len(seen), len(LEG_JOINTS), 2, 3), np.nan)
    for joint, sides in LEG_POINTS.get(marker_set, {}).items():
        for s, wanted in enumerate(sides):
            if all(name in index for name in wanted):
                out[:, LEG_JOINTS.index(joint), s] = seen[:, [index[n] for n in wanted]].mean(axis=1)
    if marker_set == "plug_in_gait":
        hips = _hips_from_spines(index, seen)
        if hips is not None:
            out[:, 0] = hips
    return out


#: Points with a lower confidence are not used.
MIN_CONFIDENCE = 0.1


def _hips_from_spines(index: Mapping[str, int], seen: np.ndarray) -> np.ndarray | None:
    """Hip joints (T, 2, 3) from the spines by the regression of Harrington et al. 2007 (J Biomech 40:595-602): from the
    middle of the anterior spines, back 0.24 depth + 9.9 mm, down 0.30 width + 10.9 mm, out 0.33 width + 7.3 mm."""
    back = [seen[:, index[n]] for n in ("LPSI", "RPSI", "SACR") if n in index]
    if "LASI" not in index or "RASI" not in index or not back:
        return None
    left, right = seen[:, index["LASI"]], seen[:, index["RASI"]]
    middle, sacrum = 0.5 * (left + right), np.mean(back, axis=0)
    out = _unit(left - right)
    ahead = middle - sacrum
    ahead = _unit(ahead - np.sum(ahead * out, axis=1, keepdims=True) * out)
    up = np.cross(ahead, out)
    width, depth = np.linalg.norm(left - right, axis=1)[:, None], np.linalg.norm(middle - sacrum, axis=1)[:, None]
    centre = middle - (0.24 * depth + 0.0099) * ahead - (0.30 * width + 0.0109) * up
    aside = (0.33 * width + 0.0073) * out
    return np.stack([centre + aside, centre - aside], axis=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
