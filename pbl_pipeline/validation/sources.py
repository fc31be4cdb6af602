"""References from what there is: a fit, rotations of bodies, an OpenSim motion; and the same angles of our fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Y_UP_TO_Z_UP, joint_angles, joint_angles_sd, joint_of, load_body
from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import unread_file
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import BodyPoses, read_motion, trial_poses

from .reference import BODY_ROTATIONS, JOINTS_CLIP, QPOS, Reference, body_rotation_angles, check_convention

_PELVIS_PATH = ("pelvis_tx", "pelvis_ty", "pelvis_tz")


def fit_angles(fit: TrialFit, convention: str = QPOS, poses: BodyPoses | None = None) -> dict[str, np.ndarray]:
    """(T,) degrees per joint at the fit's time stamps, NaN where the person is out of view or the
    joint was not observed.

    Raises `PblError` REFERENCE_INPUT (unknown convention), GAIT_INPUT (a fit of another body, or without a frame).
    """
    check_convention(convention)
    if convention == QPOS:
        return joint_angles(fit.joint_names, fit.observed_qpos)
    poses = poses or trial_poses(fit)
    seen = np.flatnonzero(np.all(np.isfinite(poses.rotation), axis=(1, 2, 3)))
    turned = {n: Rotation.from_matrix(poses.rotation[seen, i]) for i, n in enumerate(poses.body.body_names)}
    out = {}
    for name, values in body_rotation_angles(turned).items():
        out[name] = np.full(len(fit.time_s), np.nan)
        out[name][seen] = np.nan if joint_of(name)[0] in fit.not_observed else values
    return out


def fit_angles_sd(fit: TrialFit, convention: str = QPOS) -> dict[str, np.ndarray]:
    """(T,) standard deviations in degrees of `fit_angles`, NaN where the solver gives none.

    For "body_rotations" that of the model's own joint of the same name: its axis is not quite the same.
    """
    check_convention(convention)
    sd = joint_angles_sd(fit.joint_names, fit.qpos_sd)
    return sd if convention == QPOS else {k: sd[k] for k in JOINTS_CLIP if k in sd}


def reference_of_qpos(
    name: str,
    source: str,
    time_s: np.ndarray,
    joint_names: Sequence[str],
    qpos: np.ndarray,
    pelvis_m: np.ndarray | None = None,
) -> Reference:
    """Known joint values of our body, (T, 40) in m and rad, such as a synthetic walker's. `pelvis_m` in a z-up world.

    Without `pelvis_m` the path comes from pelvis_tx, ty, tz, which move the pelvis from its place in the body model
    along the ground's x, y, z.
    """
    if pelvis_m is None and all(n in joint_names for n in _PELVIS_PATH):
        index = [list(joint_names).index(n) for n in _PELVIS_PATH]
        rest = load_body().mj_model.body("pelvis").pos
        pelvis_m = rest + np.asarray(qpos, float)[:, index] @ Y_UP_TO_Z_UP.T
    return Reference(name, source, QPOS, time_s, joint_angles(joint_names, qpos), pelvis_m)


def reference_of_fit(fit: TrialFit, source: str, convention: str = QPOS) -> Reference:
    """A fit as the reference of another: several cameras, or a laboratory's markers."""
    poses = trial_poses(fit)
    pelvis = poses.position_m[:, poses.index("pelvis")]
    return Reference(fit.name, source, convention, fit.time_s, fit_angles(fit, convention, poses), pelvis)


def reference_of_bodies(path: str | Path) -> Reference:
    """Read a `.json.gz` (or `.json`) of body rotations and positions: `time` (T,) in s, `bodies` -> name ->
    `rotation` (T, 3), body-fixed XYZ Euler angles in rad, and `translation` (T, 3) in m, in a y-up ground.

    Raises `PblError` FILE_MISSING, FILE_FORMAT.
    """
    bodies = load_bodies(path)
    try:
        pelvis = bodies.position_m["pelvis"] @ Y_UP_TO_Z_UP.T
        angles = body_rotation_angles(bodies.rotation)
    except (KeyError, ValueError) as error:
        raise unread_file(error, _BODIES, _NEXT, path) from error
    name = Path(path).name.split(".")[0]
    return Reference(name, "optical markers", BODY_ROTATIONS, bodies.time_s, angles, pelvis)


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Moving bodies of a model: `time_s` (T,); by body `rotation` (T), `position_m` (T, 3) in the y-up ground of the
    file, and `scale` (3,) of the body's axes (1 if the file has none)."""

    time_s: np.ndarray
    rotation: dict[str, Rotation]
    position_m: dict[str, np.ndarray]
    scale: dict[str, np.ndarray]


_BODIES = "a file with `time` and `bodies`, each with `rotation` and `translation`"
_NEXT = "see docs/validation.md, section The reference"


def load_bodies(path: str | Path) -> Bodies:
    """The bodies of a file as `reference_of_bodies` reads it. Raises `PblError` FILE_MISSING, FILE_FORMAT."""
    path = Path(path)
    try:
        data = read_json(path)
        bodies = data["bodies"]
        return Bodies(
            np.asarray(data["time"], float),
            {n: Rotation.from_euler("XYZ", np.asarray(b["rotation"], float)) for n, b in bodies.items()},
            {n: np.asarray(b["translation"], float) for n, b in bodies.items()},
            {n: np.asarray(b.get("scaleFactors", (1.0, 1.0, 1.0)), float) for n, b in bodies.items()},
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise unread_file(error, _BODIES, _NEXT, path) from error


def reference_of_mot(path: str | Path, source: str = "optical markers", convention: str = QPOS) -> Reference:
    """Read an OpenSim motion (`gait.read_motion`); `notes` lists what was turned or shifted to our signs and zeros.

    Raises `PblError` FILE_MISSING, FILE_FORMAT, ANGLE_UNITS.
    """
    read, name = read_motion(path), Path(path).stem
    return Reference(name, source, convention, read.time_s, read.angles_deg, read.pelvis_m, tuple(read.origin.computed))
