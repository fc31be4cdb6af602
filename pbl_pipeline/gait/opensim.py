"""Joint angles that another program wrote as an OpenSim motion (`.mot`, `.sto`), as a trial with events."""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.assumptions import SIZES, Origin, check_size, check_steps
from pbl_pipeline.bounded import count_rows, read_text
from pbl_pipeline.errors import PblError, unread_file
from pbl_pipeline.results.events import SIDES

from ._angles import AngleSeries, check_ranges, legs_of, series_of
from .laboratory import LabTrial, trial_events
from .motion import MIN_TRAVEL_M_PER_S, BodyPoses, FootTrajectories, check_feet, feet_from_poses, poses_of

_PATH = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
_TURNS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation")


@dataclasses.dataclass(frozen=True)
class OpenSimMotion:
    """An OpenSim motion: `time_s` (T,); `angles_deg` maps joints to (T,) with the signs of `body.joint_angles`;
    `pelvis_m` (T, 3) pelvis_tx, ty, tz in a z-up world, or None; `origin`: what was read, told from the data, assumed.
    """

    time_s: np.ndarray
    angles_deg: dict[str, np.ndarray]
    pelvis_m: np.ndarray | None
    origin: Origin


def read_motion(path: str | Path) -> OpenSimMotion:
    """Read an OpenSim motion (.mot, .sto): columns by OpenSim's names, also `/jointset/.../value`; degrees or radians
    as its header says (`inDegrees`), checked against the data. pelvis_tx, ty, tz are metres in a y-up ground.

    Signs differ between models and the file does not state them. The larger excursion over both knees is taken as
    flexion. The ankle counts the way in which the foot is level while it stands, from the foot's right angle to the
    shank; so does the pelvis' tilt where that shows it. `origin.computed` lists what was turned or shifted for it.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (also a column that occurs twice), ANGLE_UNITS.
    """
    from pbl_pipeline.body import Y_UP_TO_Z_UP, angle_of  # JAX loads only where a motion is read

    path = Path(path)
    try:
        lines = read_text(path).splitlines()
        count_rows(len(lines))
        end = next(i for i, line in enumerate(lines) if line.strip().lower() == "endheader")
        header = {k.strip(): v.strip() for k, v in (line.split("=", 1) for line in lines[:end] if "=" in line)}
        in_degrees = {"yes": True, "no": False}[header["inDegrees"].lower()]
        rows = [line for line in lines[end + 1 :] if line.strip()]
        cells = [c.strip() for c in rows[0].strip().split("\t" if "\t" in rows[0] else None)]
        names, values = [_coordinate(n) for n in cells], np.loadtxt(rows[1:], ndmin=2, comments=None)
        twice = [n for n, k in Counter(angle_of(n)[0] for n in names if n).items() if k > 1]
        if twice or len(names) != values.shape[1]:
            wrong = f"{', '.join(twice[:5])} twice" if twice else f"{len(names)} names of {values.shape[1]} columns"
            raise ValueError(wrong)
        column = {n: values[:, i] for i, n in enumerate(names) if n and np.isfinite(values[:, i]).any()}
        time = column.pop("time")
    except (OSError, StopIteration, KeyError, ValueError, IndexError) as error:
        expected = "an OpenSim motion with `inDegrees=yes` or `no`, `endheader`, `time` and each column once"
        raise unread_file(error, expected, "see docs/validation.md, section The reference", path) from error
    turns = {n: v for n, v in column.items() if not n.endswith(("_tx", "_ty", "_tz", "_beta"))}
    _check_unit(path, turns, in_degrees)
    angles, knee_sign = {}, knee_sign_of([v for n, v in column.items() if angle_of(n)[1] < 0])
    for name, series in turns.items():
        degrees = series if in_degrees else np.degrees(series)
        ours, turned = angle_of(name)
        angles[ours] = degrees if turned > 0 else knee_sign * degrees
    program = header.get("software") or (f"OpenSim {header['OpenSimVersion']}" if "OpenSimVersion" in header else "")
    origin = Origin([f"{len(column)} columns of {program or 'a program that is not named'}"])
    origin.taken.append(f"angles in {'degrees' if in_degrees else 'radians'}, as in the header")
    if any(angle_of(n)[1] < 0 for n in turns):
        origin.computed.append(f"the knee is {'positive' if knee_sign > 0 else 'negative'} in flexion")
    pelvis = None
    if all(n in column for n in _PATH):
        pelvis = np.column_stack([column[n] for n in _PATH]) @ Y_UP_TO_Z_UP.T
    origin.computed += _to_our_signs(angles)
    return OpenSimMotion(time, angles, pelvis, origin)


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


def knee_sign_of(knees: Sequence[np.ndarray]) -> float:
    """+1 where flexion is positive, -1 where it is negative: knees bend further than they overextend."""
    known = [v[np.isfinite(v)] for v in knees if np.any(np.isfinite(v))]
    return -1.0 if known and min(v.min() for v in known) < -max(v.max() for v in known) else 1.0


#: Coordinates of a leg that place its foot, and those without which feet are not placed.
_LEG = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_flexion", "ankle_angle", "subtalar_angle")
_NEEDED = ("hip_flexion", "knee_flexion", "ankle_angle")
_NO_WIDTH = "joint angles do not tell it: from a laboratory's angles it comes out up to 16 cm too wide"
#: Time (s) over which speeds are taken.
_SPEED_S = 0.1


def read_motion_trial(path: str | Path, events_csv: str | Path | None = None, method: Any = None) -> LabTrial:
    """Read the angles of an OpenSim motion (`read_motion`) and its events.

    Events: those of `events_csv` (`pbl events`), else found by `method` from the feet (`read_motion_feet`). Angles of
    absent coordinates are absent; lengths on the floor need pelvis_tx, ty, tz. Stride and step length differ by 4 and
    6 mm at most from the markers' in 11 walks of a laboratory whose angles were written so, the step width by up to
    16 cm: it is left out. The check `input_assumptions` lists what was read, computed and assumed.

    Raises `PblError` FILE_MISSING, FILE_FORMAT, ANGLE_UNITS (`read_motion`), GAIT_INPUT (no angle of a leg; neither
    events nor the coordinates to find them; angles, size, times or strides that no person has; sides exchanged).
    """
    path, motion = Path(path), read_motion(path)
    series, absent, feet = _series(path, motion), _absent(motion), None
    if not absent:
        feet, poses = _feet(path, motion)
        series = _known(series_of(legs_of(motion.angles_deg), poses, feet), motion.angles_deg)
    motion.origin.assumed.append("angles as OpenSim's models define them, with the pelvis level in neutral standing")
    events = trial_events(path, feet, events_csv, method, _unplaced(path, absent), motion.origin)
    return LabTrial(path.stem, series, events, feet if motion.pelvis_m is not None else None, _NO_WIDTH)


def read_motion_feet(path: str | Path) -> FootTrajectories:
    """Feet and legs (m) of our body in the angles of an OpenSim motion, which needs hip flexion, knee and ankle of both
    sides. With pelvis_tx, ty, tz they are on the ground, in the scale with which the standing foot does not slide.

    Raises `PblError` as `read_motion_trial`.
    """
    path, motion = Path(path), read_motion(path)
    _series(path, motion)
    if absent := _absent(motion):
        raise _unplaced(path, absent)
    return _feet(path, motion)[0]


def _series(path: Path, motion: OpenSimMotion) -> AngleSeries:
    """The angles of the legs, checked."""
    time = motion.time_s
    if not np.isfinite(time).all() or np.any(np.diff(time) <= 0):
        raise _refuse(path, "times that are missing or do not increase", "seconds", "export the motion again")
    check_steps(time, functools.partial(_refuse, path))
    legs = legs_of(motion.angles_deg)
    if not any(legs.values()):
        raise _refuse(
            path,
            f"no coordinate of a leg among {', '.join(list(motion.angles_deg)[:8]) or 'no angles'}",
            "hip_flexion_r, hip_adduction_r, knee_angle_r, ankle_angle_r and those of the left, as OpenSim names them",
            "pass the motion of the inverse kinematics, with the coordinates of the model",
        )
    left, right = (legs[side] for side in SIDES)
    series = AngleSeries(time, left, right)
    check_ranges(series, str(path))
    return series


def _absent(motion: OpenSimMotion) -> list[str]:
    """Coordinates without which the feet are not placed."""
    return [n for n in (f"{n}_{side[0]}" for side in SIDES for n in _NEEDED) if n not in motion.angles_deg]


def _unplaced(path: Path, absent: Sequence[str]) -> PblError:
    found = f"no events, and no {', '.join(absent)} to find them"
    return _refuse(path, found, "hip flexion, knee and ankle of both sides", "pass events with --events")


def _known(series: AngleSeries, known: Collection[str]) -> AngleSeries:
    """The series without the angles of pelvis and feet whose coordinates are not known."""
    pelvis = set(_TURNS) <= {*known}
    absent = [] if pelvis else ["pelvis_tilt", "pelvis_obliquity", "pelvis_rotation"]
    absent += [] if pelvis and {"hip_rotation_r", "hip_rotation_l"} <= {*known} else ["foot_progression"]
    left, right = ({n: v for n, v in series.of_side(s).items() if n not in absent} for s in SIDES)
    return dataclasses.replace(series, left=left, right=right)


def _feet(path: Path, motion: OpenSimMotion) -> tuple[FootTrajectories, BodyPoses]:
    """Feet of the body in the angles of the motion, and its poses, on the ground where pelvis_tx, ty, tz are known."""
    said, origin = "pelvis_tx, ty, tz are absent: no lengths on the floor", motion.origin
    zero = [n for n in (*_TURNS, *(f"{n}_{s}" for n in _LEG for s in "rl")) if n not in motion.angles_deg]
    if zero:
        origin.assumed.append(f"0 deg where feet are placed, not measured: {', '.join(zero)}")
    poses = _poses(motion, motion.angles_deg)
    feet = _placed(path, motion, poses, 1.0)
    check_feet(feet, str(path))
    if motion.pelvis_m is not None:
        scale, slides = _scale(motion, poses)
        check_size(max(scale, SIZES[0]), functools.partial(_refuse, path))
        said = "the pelvis hardly travels, or the standing foot slides with it: no lengths on the floor"
        if scale >= SIZES[0]:
            _check_standing(path, motion, slides)
            feet = _placed(path, motion, poses, scale)
            said = f"legs {scale:.2f} times the unscaled body's: so standing feet slide least ({slides:.2f} m/s)"
    origin.computed.append(said)
    return feet, poses


def _placed(path: Path, motion: OpenSimMotion, poses: BodyPoses, scale: float) -> FootTrajectories:
    pelvis, travels = poses.position_m[:, :1], motion.pelvis_m is not None
    poses = dataclasses.replace(poses, position_m=pelvis + scale * (poses.position_m - pelvis))
    unseen = np.zeros((len(motion.time_s), 2), bool)
    return feet_from_poses(motion.time_s, poses, np.full(8, scale), f"angles of {path.name}", travels, unseen)


def _check_standing(path: Path, motion: OpenSimMotion, slides: float) -> None:
    """Compare how fast standing feet slide (m/s) with the angles of the other leg. Raises `PblError` GAIT_INPUT."""
    other = {n: motion.angles_deg.get(_other(n), v) for n, v in motion.angles_deg.items()}
    exchanged = _scale(motion, _poses(motion, other))[1]
    if exchanged < _EXCHANGED * slides:
        raise _refuse(
            path,
            "left and right exchanged: only with the other leg's angles the standing foot stays in its place "
            f"(it slides at {exchanged:.2f} instead of {slides:.2f} m/s)",
            "the right leg's angles in the columns that end in _r",
            "exchange the columns _r and _l of the legs, or turn pelvis_list and pelvis_rotation if those are wrong",
        )
    if slides > _SLIDES:
        motion.origin.assumed.append(
            f"the standing foot slides at {slides:.1f} m/s: coordinates of pelvis or hips may have other signs, or "
            "another order of turns, than in OpenSim's models"
        )


def _other(name: str) -> str:
    return name[:-1] + {"r": "l", "l": "r"}[name[-1]] if name.endswith(("_r", "_l")) else name


def _poses(motion: OpenSimMotion, angles: Mapping[str, np.ndarray]) -> BodyPoses:
    from pbl_pipeline.body import SCALE_NAMES, SLIDES, Y_UP_TO_Z_UP, angle_of, load_body

    path = np.zeros((len(motion.time_s), 3)) if motion.pelvis_m is None else motion.pelvis_m @ Y_UP_TO_Z_UP
    columns = dict(zip(_PATH, path.T, strict=True))
    qpos = np.zeros((len(path), len(load_body().joint_names)))
    for i, joint in enumerate(load_body().joint_names):
        name, sign = angle_of(joint)
        placed = name in _TURNS or name.startswith(_LEG)
        if joint in SLIDES:
            qpos[:, i] = columns[joint]
        elif placed and name in angles:
            qpos[:, i] = sign * np.radians(angles[name])
    return poses_of(qpos, np.ones(len(SCALE_NAMES)))


def _scale(motion: OpenSimMotion, poses: BodyPoses) -> tuple[float, float]:
    """Scale of the legs with which the standing foot does not slide, and how fast it then does (m/s, median).

    In the direction of travel the foot that stands goes back against the pelvis as fast as the pelvis goes ahead.
    0 and 0 for a pelvis that does not travel.
    """
    if motion.pelvis_m is None:
        return 0.0, 0.0
    time = motion.time_s
    pelvis = poses.position_m[:, poses.index("pelvis"), None, :2]
    foot = 0.5 * (poses.of_sides("calcn") + poses.of_sides("toes"))[..., :2] - pelvis
    at = np.arange(time[0], time[-1] - _SPEED_S, 0.5 * _SPEED_S)
    way, step = (_differences(time, x, at) / _SPEED_S for x in (pelvis, foot))
    speed = np.linalg.norm(way, axis=-1, keepdims=True)
    walks = speed[:, 0, 0] > MIN_TRAVEL_M_PER_S
    if np.count_nonzero(walks) < 0.5 * len(walks) or not len(walks):
        return 0.0, 0.0
    back = -np.sum(step * way / speed, axis=-1)[walks]
    stands, rows = back.argmax(axis=1), np.arange(np.count_nonzero(walks))
    scale = float(np.median(speed[walks, 0, 0] / np.maximum(back[rows, stands], 1e-3)))
    slide = np.linalg.norm(way[walks, 0] + scale * step[walks][rows, stands], axis=-1)
    return scale, float(np.median(slide))


def _differences(time_s: np.ndarray, x: np.ndarray, at: np.ndarray) -> np.ndarray:
    flat = x.reshape(len(x), -1).T
    ahead, here = (np.array([np.interp(t, time_s, row) for row in flat]) for t in (at + _SPEED_S, at))
    return (ahead - here).T.reshape(len(at), *x.shape[1:])


#: Speed (m/s) at which the standing foot slides if signs are wrong: 0.03 to 0.11 in six motions of laboratories, 0.78
#: to 4 with the angles of the other leg. Sides are exchanged where it is less than this fraction with these.
_SLIDES, _EXCHANGED = 0.3, 0.5


def _refuse(path: Path, found: str, expected: str, next_step: str) -> PblError:
    return PblError("GAIT_INPUT", found, expected, next_step, str(path))
