"""Reference of a fit: joint angles and the pelvis' path over time, by joints, rotations and the camera's view."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, Y_UP_TO_Z_UP
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers, load_npz, text_of, texts_of
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import BodyPoses, camera_side, mostly

FRONT, BACK, IPSILATERAL, CONTRALATERAL, MIXED = "front", "back", "ipsilateral", "contralateral", "mixed"
#: View of a joint of the middle if the camera stands on one side.
LATERAL = "lateral"
_refused = functools.partial(PblError, "REFERENCE_INPUT", next_step="see docs/validation.md, section The reference")


def view_of_fit(fit: TrialFit, poses: BodyPoses) -> dict[str, str]:
    """View class for the joints of the "right" and "left" side: see `view_classes`.

    The camera stands at `camera_position_m`; of several cameras that is the first one.
    """
    pelvis = poses.index("pelvis")
    return view_classes(poses.position_m[:, pelvis], poses.rotation[:, pelvis, :, 0], fit.camera_position_m)


def view_classes(pelvis_m: np.ndarray, forward: np.ndarray, camera_m: np.ndarray) -> dict[str, str]:
    """View class per side from where the camera stands in most frames (`gait.camera_side`, with its arguments): "front"
    or "back"; else "ipsilateral" for the joints of the side on which it is and "contralateral" for the other's. Where
    no class holds 70 % of the known frames (a turn, a walk past the camera), or without a camera: "mixed".
    """
    sides = camera_side(pelvis_m, forward, camera_m)
    most = mostly(sides[sides != ""])
    if most in (FRONT, BACK, ""):
        return dict.fromkeys(("right", "left"), most or MIXED)
    return {side: IPSILATERAL if side == most else CONTRALATERAL for side in ("right", "left")}


def body_rotation_angles(rotation: Mapping[str, Rotation]) -> dict[str, np.ndarray]:
    """(T,) degrees of `JOINTS_CLIP` from body rotations whose axes are OpenSim's (forward, up, right).

    Hip: R_pelvis^-1 R_femur as body-fixed ZXY (flexion, adduction, rotation); knee: -(R_femur^-1 R_tibia) as ZXY [0];
    ankle: R_tibia^-1 R_talus as ZXY [0]. Left-side axes are mirrored. Every system goes through here, so that the axes
    that a model gives its ankle and knee count the same way.

    Parameters
    ----------
    rotation
        `pelvis`, `femur_r`, `femur_l`, `tibia_r`, ... `talus_l`, each T rotations, body to any one world.
    """
    out = {}
    for side, sign in (("r", 1.0), ("l", -1.0)):
        hip = _relative(rotation, "pelvis", f"femur_{side}")
        out[f"hip_flexion_{side}"] = hip[:, 0]
        out[f"hip_adduction_{side}"] = sign * hip[:, 1]
        out[f"hip_rotation_{side}"] = sign * hip[:, 2]
        out[f"knee_flexion_{side}"] = -_relative(rotation, f"femur_{side}", f"tibia_{side}")[:, 0]
        out[f"ankle_angle_{side}"] = _relative(rotation, f"tibia_{side}", f"talus_{side}")[:, 0]
    return out


def pelvis_rotations(tilt_deg: np.ndarray, list_deg: np.ndarray, rotation_deg: np.ndarray) -> np.ndarray:
    """(T, 3, 3) pelvis to a z-up world from the body's own pelvis angles (about z, x, y of a y-up ground, body-fixed).

    The columns are forward, up and right of the pelvis.
    """
    angles = np.radians(np.column_stack([tilt_deg, list_deg, rotation_deg]))
    return Y_UP_TO_Z_UP @ Rotation.from_euler("ZXY", angles).as_matrix()


def pelvis_angles_deg(R_world_pelvis: np.ndarray) -> np.ndarray:
    """(T, 3) tilt, list, rotation in degrees: the inverse of `pelvis_rotations`."""
    return Rotation.from_matrix(Y_UP_TO_Z_UP.T @ R_world_pelvis).as_euler("ZXY", degrees=True)


def _relative(rotation: Mapping[str, Rotation], parent: str, child: str) -> np.ndarray:
    return (rotation[parent].inv() * rotation[child]).as_euler("ZXY", degrees=True)


_SIDES = ("r", "l")
_HIPS = tuple(f"hip_{n}_{s}" for n in ("flexion", "adduction", "rotation") for s in _SIDES)
_KNEES = tuple(f"knee_flexion_{s}" for s in _SIDES)
_ANKLES = tuple(f"ankle_angle_{s}" for s in _SIDES)
_LUMBAR = tuple(f"lumbar_{n}" for n in ("extension", "bending", "rotation"))

#: The joints of the paper's median absolute error (Supplementary Methods, Validation Metrics).
JOINTS_PAPER: tuple[str, ...] = (
    *_HIPS,
    *_KNEES,
    *_ANKLES,
    *_LUMBAR,
    *(f"neck_{n}" for n in ("extension", "bending", "rotation")),
    *(f"arm_{n}_{s}" for n in ("flex", "add") for s in _SIDES),
    *(f"elbow_flex_{s}" for s in _SIDES),
)
#: The joints of OpenCap's mean absolute error (Uhlrich et al. 2023, as the paper lists them).
JOINTS_OPENCAP: tuple[str, ...] = (
    *PELVIS_TURNS,
    *_HIPS,
    *_KNEES,
    *_ANKLES,
    *(f"subtalar_angle_{s}" for s in _SIDES),
    *_LUMBAR,
)
#: The angles that body rotations of any model give alike (convention "body_rotations").
JOINTS_CLIP: tuple[str, ...] = (*_HIPS, *_KNEES, *_ANKLES)


def split_side(joint: str) -> tuple[str, str]:
    """`hip_flexion_r` -> (`hip_flexion`, `r`); a joint of the middle has the side ``""``."""
    if joint.endswith(("_r", "_l")):
        return joint[:-2], joint[-1]
    return joint, ""


#: Row of the paper's tables -> the joint without its side.
ROWS_PAPER = {joint.replace("_", " ").title(): joint for joint, _ in map(split_side, JOINTS_PAPER)}
#: The joints of our body, by its own axes.
QPOS = "qpos"
#: Hip, knee and ankle from the rotations of bodies (`body_rotation_angles`), for models that are not ours.
BODY_ROTATIONS = "body_rotations"
CONVENTIONS = (QPOS, BODY_ROTATIONS)


def check_convention(convention: str, key: str | None = None) -> None:
    """Raise `PblError` REFERENCE_INPUT for an unknown convention."""
    if convention not in CONVENTIONS:
        raise _refused(f"convention {convention!r}", " or ".join(CONVENTIONS), key=key)


_FIELDS = ("time_s", "names", "angles_deg", "pelvis_m", "name", "source", "convention")


@dataclasses.dataclass(frozen=True)
class Reference:
    """Reference kinematics of one recording.

    Raises `PblError` REFERENCE_INPUT: time stamps out of order, shapes that do not belong together, an unknown
    convention.
    """

    name: str  # of the recording
    source: str  # where the angles come from: "optical markers", "several cameras", "synthetic",
    #: "qpos": the joints of our body. "body_rotations": hip, knee and ankle from relative body rotations as ZXY.
    convention: str
    time_s: np.ndarray  # (T,) increasing, on the reference's own clock
    #: Joint -> (T,) degrees under OpenSim's names, the knee as `knee_flexion_r/_l`, positive in flexion. Joints that
    #: are not known are absent; NaN where a joint is not known at that time.
    angles_deg: Mapping[str, np.ndarray]
    pelvis_m: np.ndarray | None = None  # (T, 3) origin of the pelvis in the reference's own z-up world, or None
    notes: tuple[str, ...] = ()  # what a reader found out about the file's signs; not saved

    def __post_init__(self) -> None:
        time = np.asarray(self.time_s, float)
        angles = {k: np.asarray(v, float) for k, v in self.angles_deg.items()}
        object.__setattr__(self, "time_s", time)
        object.__setattr__(self, "angles_deg", angles)
        check_convention(self.convention, self.name)
        if time.ndim != 1 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
            raise _refused("time stamps out of order or not finite", "(T,) increasing seconds", key=self.name)
        for joint, values in angles.items():
            if values.shape != time.shape:
                raise _refused(
                    f"{joint} of shape {values.shape}", f"({time.size},), one value a time stamp", key=self.name
                )
        if self.pelvis_m is not None:
            pelvis = np.asarray(self.pelvis_m, float)
            object.__setattr__(self, "pelvis_m", pelvis)
            if pelvis.shape != (time.size, 3):
                raise _refused(f"pelvis_m of shape {pelvis.shape}", f"({time.size}, 3)", key=self.name)

    def save(self, path: str | Path) -> None:
        """Write as .npz: `time_s`, `names` (A,), `angles_deg` (T, A), `pelvis_m`, `name`, `source`, `convention`."""
        table = np.column_stack(list(self.angles_deg.values())) if self.angles_deg else np.zeros((self.time_s.size, 0))
        pelvis = np.full((self.time_s.size, 3), np.nan) if self.pelvis_m is None else self.pelvis_m
        np.savez_compressed(
            path,
            allow_pickle=False,
            time_s=self.time_s,
            names=np.asarray(list(self.angles_deg), dtype=str),
            angles_deg=table,
            pelvis_m=pelvis,
            name=np.asarray(self.name),
            source=np.asarray(self.source),
            convention=np.asarray(self.convention),
        )

    @classmethod
    def load(cls, path: str | Path) -> Reference:
        """Read what `save` wrote. A path of the pelvis that is NaN throughout is None.

        Raises `PblError` FILE_MISSING, FILE_FORMAT, REFERENCE_INPUT.
        """
        data = load_npz(path, needed=_FIELDS, next_step="see docs/validation.md, section The reference")
        t, a = data["time_s"].size, data["names"].size
        check_numbers(path, data, {"time_s": (t,), "angles_deg": (t, a), "pelvis_m": (t, 3)})
        angles = {n: data["angles_deg"][:, i] for i, n in enumerate(texts_of(path, data, "names"))}
        pelvis = data["pelvis_m"] if np.any(np.isfinite(data["pelvis_m"])) else None
        name, source, convention = (text_of(path, data, k) for k in ("name", "source", "convention"))
        return cls(name, source, convention, data["time_s"], angles, pelvis)
