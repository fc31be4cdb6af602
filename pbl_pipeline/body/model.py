"""The body model: the MJCF read by C MuJoCo and put on the JAX device, and its joint values as angles in degrees."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import mujoco
import numpy as np

from pbl_pipeline.jax_setup import import_mjx

if TYPE_CHECKING:
    from mujoco import mjx

_MJCF = Path(__file__).parent / "data" / "pbl_body_40.xml"
_GROUP_PREFIX = "scale_group/"

#: The slides of the pelvis, along its axes x, y and z at `qpos = 0` (m); all other joints turn (rad).
SLIDES = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
#: The joints that turn the pelvis, one after the other about z, x and y of the model's ground.
PELVIS_TURNS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation")
#: Turns vectors of OpenSim's ground (x forward, y up, z right) into the z-up world of this project.
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A tree of B bodies with Q degrees of freedom (ours: 21 and 40) and S scale groups (8). Index 0 is the root, the
    pelvis, without MuJoCo's world."""

    #: The model for C MuJoCo.
    mj_model: mujoco.MjModel
    #: OpenSim's, in the order of `qpos`. The slides are pelvis_tx (forward), pelvis_tz (right), pelvis_ty (up).
    joint_names: tuple[str, ...]
    joint_range_rad: np.ndarray  # (Q, 2) limits, radians (metres for slides); -inf, inf where unlimited
    #: (Q,) index of the body that a joint belongs to, and its kind.
    joint_body: np.ndarray
    is_hinge: np.ndarray
    is_slide: np.ndarray
    body_names: tuple[str, ...]
    parent_index: np.ndarray  # (B,) index of the parent in `body_names`; -1 for the root
    path: np.ndarray  # (B, B) 1 where the second body is the first one or an ancestor of it
    moves: np.ndarray  # (B, Q) 1 where a joint moves a body
    scale_names: tuple[str, ...]
    scale_index: np.ndarray  # (B,) which of `scale_names` scales the body
    #: Hash of the MJCF's bytes, and what the MJCF calls itself.
    sha256: str
    name: str
    version: str

    @functools.cached_property
    def mjx_model_and_data(self) -> tuple[mjx.Model, mjx.Data]:
        """The model for MJX, and an empty state to start kinematics from."""
        # The first caller may be tracing: the cache must hold arrays, not constants of that trace.
        with jax.ensure_compile_time_eval():
            module = import_mjx()
            return module.put_model(self.mj_model, impl="jax"), module.make_data(self.mj_model, impl="jax")


@functools.cache
def load_body(path: Path = _MJCF) -> Body:
    """Load the 40-degree-of-freedom body, or that of another MJCF of the same structure (cached).

    The MJCF names its scale groups in texts `scale_group/NAME`, whose data are the bodies of the group; `*` stands for
    all other bodies.
    """
    xml = path.read_bytes()
    model = mujoco.MjModel.from_xml_string(xml.decode())
    texts = _texts(model)
    groups = {k.removeprefix(_GROUP_PREFIX): v for k, v in texts.items() if k.startswith(_GROUP_PREFIX)}
    limited = np.asarray(model.jnt_limited, bool)[:, None]
    names = tuple(model.body(i).name for i in range(1, model.nbody))
    parent = np.asarray(model.body_parentid[1:], np.int32) - 1
    joint_body = np.asarray(model.jnt_bodyid, np.int32) - 1
    above = np.eye(len(names))
    for i, p in enumerate(parent):
        if p >= 0:
            above[i] += above[p]
    return Body(
        mj_model=model,
        joint_names=tuple(model.joint(i).name for i in range(model.njnt)),
        joint_range_rad=_frozen(np.where(limited, model.jnt_range, np.array([-np.inf, np.inf]))),
        joint_body=_frozen(joint_body),
        is_hinge=_frozen(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE),
        is_slide=_frozen(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE),
        body_names=names,
        parent_index=_frozen(parent),
        path=_frozen(above),
        moves=_frozen(above[:, joint_body]),
        scale_names=tuple(groups),
        scale_index=_frozen(_scale_index(names, groups)),
        sha256=hashlib.sha256(xml).hexdigest(),
        name=bytes(model.names).split(b"\0", 1)[0].decode(),
        version=texts["version"],
    )


def _scale_index(body_names: tuple[str, ...], groups: dict[str, str]) -> np.ndarray:
    index = np.full(len(body_names), list(groups.values()).index("*"), np.int32)
    for i, members in enumerate(groups.values()):
        for member in members.split():
            if member != "*":
                index[body_names.index(member)] = i
    return index


def _texts(model: mujoco.MjModel) -> dict[str, str]:
    # In the order of the MJCF, which is the order of the scale vector.
    raw = bytes(model.text_data)
    texts = {}
    for i in range(model.ntext):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXT, i)
        texts[name] = raw[model.text_adr[i] : model.text_adr[i] + model.text_size[i]].rstrip(b"\0").decode()
    return texts


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


#: The entries of `scale`, as the MJCF lists them: overall first, then the groups.
SCALE_NAMES: tuple[str, ...] = load_body().scale_names


#: Joints whose angle has the other sign: OpenSim's knee is negative in flexion. Nothing else changes the sign.
_TURNED = {"knee_angle": "knee_flexion"}


def angle_of(joint: str) -> tuple[str, float]:
    """Name of a joint's angle and its sign against the joint's value: ("knee_flexion_r", -1.0) of "knee_angle_r".

    The side may be omitted. Joints whose angle has the same sign keep their name.
    """
    return _other_name(joint, _TURNED)


def joint_of(angle: str) -> tuple[str, float]:
    """Name of an angle's joint and its sign, as `angle_of`: ("knee_angle_r", -1.0) of "knee_flexion_r"."""
    return _other_name(angle, {angle: joint for joint, angle in _TURNED.items()})


def joint_angles(joint_names: Sequence[str], qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Angles (T,) in degrees of the joints that turn, by `angle_of` their names, from `qpos` (T, N) in radians."""
    out = {}
    for joint, values in zip(joint_names, np.asarray(qpos, float).T, strict=True):
        if joint not in SLIDES:
            name, sign = angle_of(joint)
            out[name] = sign * np.degrees(values)
    return out


def joint_angles_sd(joint_names: Sequence[str], qpos_sd: np.ndarray) -> dict[str, np.ndarray]:
    """Standard deviations (T,) in degrees of `joint_angles`, from those of qpos (T, N) in radians."""
    return {name: np.abs(sd) for name, sd in joint_angles(joint_names, qpos_sd).items()}


def _other_name(name: str, names: dict[str, str]) -> tuple[str, float]:
    for one, other in names.items():
        if name == one or name.startswith(f"{one}_"):
            return other + name.removeprefix(one), -1.0
    return name, 1.0
