"""References from what there is: a fit, rotations of bodies, an OpenSim motion; and the same angles of our fit."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Y_UP_TO_Z_UP, angle_of, joint_angles, joint_angles_sd, joint_of, load_body
from pbl_pipeline.bounded import count_rows, read_json, read_text
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import BodyPoses, trial_poses

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
        raise _unreadable(Path(path), error, _BODIES) from error
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
        raise _unreadable(path, error, _BODIES) from error


def reference_of_mot(path: str | Path, source: str = "optical markers", convention: str = QPOS) -> Reference:
    """Read an OpenSim motion (.mot, .sto): columns by OpenSim's names, also `/jointset/.../value`; degrees or radians
    as its header says (`inDegrees`), checked against the data. pelvis_tx, ty, tz are metres in a y-up ground.

    Signs differ between models and the file does not state them. The larger excursion over both knees is taken as
    flexion. The ankle counts the way in which the foot is level while it stands, from the foot's right angle to the
    shank; so does the pelvis' tilt where that shows it. `notes` lists what was turned or shifted for it.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (also a column that occurs twice), ANGLE_UNITS.
    """
    path = Path(path)
    try:
        lines = read_text(path).splitlines()
        count_rows(len(lines))
        end = next(i for i, line in enumerate(lines) if line.strip().lower() == "endheader")
        header = dict(line.split("=", 1) for line in lines[:end] if "=" in line)
        in_degrees = {"yes": True, "no": False}[{k.strip(): v.strip().lower() for k, v in header.items()}["inDegrees"]]
        rows = [line for line in lines[end + 1 :] if line.strip()]
        names, values = [_coordinate(n) for n in rows[0].split()], np.loadtxt(rows[1:], ndmin=2, comments=None)
        twice = [n for n, k in Counter(angle_of(n)[0] for n in names if n).items() if k > 1]
        if twice or len(names) != values.shape[1]:
            wrong = f"{', '.join(twice[:5])} twice" if twice else f"{len(names)} names of {values.shape[1]} columns"
            raise ValueError(wrong)
        column = {n: values[:, i] for i, n in enumerate(names) if n}
        time = column.pop("time")
    except (OSError, StopIteration, KeyError, ValueError, IndexError) as error:
        raise _unreadable(
            path, error, "an OpenSim motion with `inDegrees=yes` or `no`, `endheader`, `time` and each column once"
        ) from error
    turns = {n: v for n, v in column.items() if not n.endswith(("_tx", "_ty", "_tz", "_beta"))}
    _check_unit(path, turns, in_degrees)
    angles, notes, knee_sign = {}, [], _knee_sign([v for n, v in column.items() if angle_of(n)[1] < 0])
    for name, series in turns.items():
        degrees = series if in_degrees else np.degrees(series)
        ours, turned = angle_of(name)
        angles[ours] = degrees if turned > 0 else knee_sign * degrees
    if any(angle_of(n)[1] < 0 for n in turns):
        notes.append(f"the knee is {'positive' if knee_sign > 0 else 'negative'} in flexion")
    pelvis = None
    if all(n in column for n in _PELVIS_PATH):
        pelvis = np.column_stack([column[n] for n in _PELVIS_PATH]) @ Y_UP_TO_Z_UP.T
    notes += _to_our_signs(angles)
    return Reference(path.stem, source, convention, time, angles, pelvis, tuple(notes))


def _coordinate(column: str) -> str:
    """Name of the coordinate of a column; empty for speeds, activations and other states."""
    if not column.startswith("/"):
        return column
    *parts, last = column.split("/")
    return parts[-1] if last == "value" and "jointset" in parts else ""


#: No hip, knee, ankle, trunk or elbow reaches this many radians (200 deg), and a person moves one of them by more than
#: this many degrees. Arms, and the pelvis of a person who turns around, may go beyond it.
_LARGEST_RAD = 3.5
_BOUNDED = ("pelvis_tilt", "pelvis_list", "hip_", "knee_", "ankle_", "subtalar_", "mtp_", "lumbar_", "elbow_")
#: An ankle whose median is this near to 90 deg counts from the line of the shank.
_ANKLE_FROM_SHANK_DEG, _NEAR_DEG = 90.0, 30.0
#: The foot that stands is level within this (deg); least fraction of the time, and least ratio to the other sign.
_LEVEL_DEG, _FLAT, _STANDS, _CLEARLY = 15, 4.0, 0.25, 2.0


def _check_unit(path: Path, turns: Mapping[str, np.ndarray], in_degrees: bool) -> None:
    """Compare the unit of a header with the largest angle. Raises `PblError` ANGLE_UNITS."""
    known = [v for n, v in turns.items() if n.startswith(_BOUNDED)] or list(turns.values())
    largest = max(
        (float(np.percentile(np.abs(v[np.isfinite(v)]), 99)) for v in known if np.isfinite(v).any()), default=0
    )
    if largest == 0 or in_degrees == (largest > _LARGEST_RAD):
        return
    said = "`inDegrees=yes`" if in_degrees else "`inDegrees=no`"
    raise PblError(
        "ANGLE_UNITS",
        found=f"{said} and angles of at most {largest:.3g}"
        + (", as in radians or in a person who does not move" if in_degrees else ", which no joint reaches in radians"),
        expected=f"degrees beyond {_LARGEST_RAD:g}, or radians up to it",
        next_step="correct `inDegrees` in the header, or export the motion again",
        key=str(path),
    )


def _to_our_signs(angles: dict[str, np.ndarray]) -> list[str]:
    """Bring ankles and pelvis to the body's zero and signs (dorsiflexion and posterior tilt positive); return notes.

    In the sagittal plane the foot stands level where pelvis tilt + hip - knee + ankle = 0.
    """
    notes = []
    ankles = [n for n in ("ankle_angle_r", "ankle_angle_l") if n in angles and np.isfinite(angles[n]).any()]
    middle = float(np.median([np.nanmedian(angles[n]) for n in ankles])) if ankles else 0.0
    if abs(abs(middle) - _ANKLE_FROM_SHANK_DEG) < _NEAR_DEG:
        for name in ankles:
            angles[name] = angles[name] - np.copysign(_ANKLE_FROM_SHANK_DEG, middle)
        notes.append("the ankle counts from the line of the shank: 90 deg taken off")
    level = dict.fromkeys(((1, 1), (1, -1), (-1, 1), (-1, -1)), 0.0)  # by the signs of tilt and ankle
    for name in ankles:
        side = name[-2:]
        if not {"pelvis_tilt", f"hip_flexion{side}", f"knee_flexion{side}"} <= angles.keys():
            continue
        leg = angles[f"hip_flexion{side}"] - angles[f"knee_flexion{side}"]
        for tilted, ankle in level:
            pitch = tilted * angles["pelvis_tilt"] + leg + ankle * angles[name]
            near = np.abs(pitch[:, None] - np.arange(-_LEVEL_DEG, _LEVEL_DEG + 1)) < _FLAT
            level[tilted, ankle] += float(near.mean(axis=0).max()) / len(ankles)
    best = {sign: max(level[1, sign], level[-1, sign]) for sign in (1, -1)}
    ankle = -1 if best[-1] >= _STANDS and best[-1] > _CLEARLY * best[1] else 1
    if ankle < 0:
        for name in ankles:
            angles[name] = -angles[name]
        notes.append("the ankle is positive in plantarflexion and was turned: only so is the standing foot level")
    if level[-1, ankle] >= _STANDS and level[-1, ankle] > _CLEARLY * level[1, ankle]:
        angles["pelvis_tilt"] = -angles["pelvis_tilt"]
        notes.append("the tilt of the pelvis is positive forwards and was turned: only so is the standing foot level")
    return notes


def _knee_sign(knees: Sequence[np.ndarray]) -> float:
    """+1 where flexion is positive, -1 where it is negative: knees bend further than they overextend."""
    known = [v[np.isfinite(v)] for v in knees if np.any(np.isfinite(v))]
    return -1.0 if known and min(v.min() for v in known) < -max(v.max() for v in known) else 1.0


def _unreadable(path: Path, error: Exception, expected: str) -> PblError:
    absent = isinstance(error, FileNotFoundError | IsADirectoryError | NotADirectoryError | PermissionError)
    return PblError(
        "FILE_MISSING" if absent else "FILE_FORMAT",
        found=f"{type(error).__name__}: {error}",
        expected=expected,
        next_step="check the path" if absent else "see docs/validation.md, section The reference",
        key=str(path),
    )
