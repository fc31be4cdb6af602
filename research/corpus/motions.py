"""Real recorded motions of other laboratories, as joint values of our body.

A folder has an `index.csv`: a row per file with its person, activity, unit, sign of the knee, source and licence. What
a file holds is read by its columns (`_motion_formats.py`), put on the body, set on the floor, and refused where its
values contradict what the index states.
"""

from __future__ import annotations

import csv
import dataclasses
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import SLIDES, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.synthetic import SOLE_POINTS, sole_points
from research.corpus.motion_formats import Recorded, read_recorded
from research.walker.turns import facing

_LOG = logging.getLogger(__name__)

#: Activity -> words of the index that mean it; the first that fits counts.
ACTIVITIES: dict[str, tuple[str, ...]] = {
    "stairs": ("stair",),
    "squat": ("squat",),
    "sit_to_stand": ("sit-stand", "sit to stand", "chair"),
    "lift": ("material handling", "lift"),
    "jump": ("jump",),
    "run": ("run", "sprint"),
    "walk": ("walk", "gait", "overground"),
    "stand": ("standing",),
}
OTHER = "other"
#: Activities in which a foot is on the floor at any time.
GROUNDED = ("stairs", "squat", "sit_to_stand", "lift", "walk", "stand")
#: Activities in which the left leg does what the right one does, half a stride later.
STRIDING = ("walk", "run")
#: Two names of the index for one person: the same trials come from two repositories or two pipelines.
_SAME_PERSON = {
    "sprinter (Dorn2012-like)": "sprinter JA1",
    "BTK PiG person A or other": "BTK PiG person A",
}
#: Joints that are not recorded stand so (deg); all others at 0.
NEUTRAL_DEG = {"elbow_flex": 20.0, "pro_sup": 85.0, "arm_add": -9.0}
#: A walking person's pelvis is within this of level in the mean, in the body's frame (deg).
WALKING_TILT_DEG = 15.0
#: What a walking mean of the pelvis is set to where the index says that the pelvis frame of the model is off (deg): the
#: mean of the walks of the other laboratories here.
LEVEL_TILT_DEG = -2.0
#: The lower foot of a person who walks or squats is level within this in the median (deg).
FLAT_FOOT_DEG = 15.0
#: A stride is found by what lies a stride later: so much of it at least (s).
_OVERLAP_S = 0.15
#: Smoothing of what follows from the feet: pelvis height and way (s).
_SMOOTH_S = 0.04


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """One recording of one person, as our body moves.

    Attributes
    ----------
    name, person, activity, label
        Unique name; the person, one name over all files of that person; class (a key of `ACTIVITIES`, or "other"); the
        index's own words.
    time_s : (T,)
    qpos : (T, 40)
        Joint values in the body's order and signs (rad, m), the world z up, the floor at z = 0. The body has its own
        size, not the person's: a recorded path is scaled by the height of the pelvis.
    known : (40,)
        Joints that were measured. Others stand at `NEUTRAL_DEG`, or on the left copy a measured right side.
    heading_rad
        Where the pelvis faces in the mean, from the world's x counter-clockwise.
    cycle
        Whether it is one gait cycle, whose end is its beginning.
    quality
        "" or what is wrong with the recording.
    source, licence
        Repository and commit, and what may be done with it.
    """

    name: str
    person: str
    activity: str
    label: str
    time_s: Float[np.ndarray, " T"]
    qpos: Float[np.ndarray, "T 40"]
    known: Bool[np.ndarray, " 40"]
    heading_rad: float
    cycle: bool
    quality: str
    source: str
    licence: str

    @property
    def rate_hz(self) -> float:
        """Samples a second."""
        return (len(self.time_s) - 1) / float(self.time_s[-1] - self.time_s[0])


def read_motions(
    folder: str | Path,
    activities: Iterable[str] | None = None,
    *,
    low_quality: bool = False,
    markerless: bool = False,
) -> list[Motion]:
    """Return all recordings of joint angles that `folder/index.csv` lists, in its order.

    Rows of other kinds (markers, mean curves of groups, tables of persons, pixels) are passed over.

    Parameters
    ----------
    folder
        With `index.csv` and the files it names.
    activities
        Only these (keys of `ACTIVITIES`, "other"); None for all.
    low_quality
        Also recordings that the index calls so.
    markerless
        Also solutions of markerless systems where the index has the markers' of the same trial.

    Raises
    ------
    PblError
        FILE_MISSING, FILE_FORMAT; ANGLE_UNITS and REFERENCE_INPUT where the values of a file contradict the index.
    """
    folder, wanted = Path(folder), None if activities is None else set(activities)
    motions = []
    for row in read_index(folder):
        if not _is_motion(row) or (wanted is not None and activity_of(row["activity"]) not in wanted):
            continue
        if (_quality(row) and not low_quality) or (row["what"].startswith("markerless") and not markerless):
            continue
        motions += read_motion(folder, row)
    _LOG.info("%d recordings of %d persons in %s", len(motions), len({m.person for m in motions}), folder)
    return motions


def read_index(folder: str | Path) -> list[dict[str, str]]:
    """The rows of `index.csv`. Raises `PblError` FILE_MISSING, FILE_FORMAT."""
    path = Path(folder) / "index.csv"
    needed = {"path", "what", "person", "activity", "model", "units", "knee_sign"}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise PblError(
            "FILE_MISSING" if isinstance(error, OSError) else "FILE_FORMAT",
            found=f"{type(error).__name__}: {error}",
            expected="index.csv of a folder of recorded motions",
            next_step="name the folder that has it with --motions",
            key=str(path),
        ) from error
    if not rows or not needed <= rows[0].keys():
        raise PblError(
            "FILE_FORMAT",
            found=f"columns {', '.join(rows[0]) if rows else 'none'}",
            expected=f"at least {', '.join(sorted(needed))}",
            next_step="see research/README.md, section Recorded motions",
            key=str(path),
        )
    return rows


def read_motion(folder: str | Path, row: Mapping[str, str]) -> list[Motion]:
    """The recordings of one row of the index (a table of gait cycles has several). Raises as `read_motions`."""
    path = Path(folder) / row["path"]
    recorded = read_recorded(path, row)
    name = path.name.removesuffix(".gz")
    names = [name] if len(recorded) == 1 else [f"{name}:{i}" for i in range(1, len(recorded) + 1)]
    return [_motion(n, r, row) for n, r in zip(names, recorded, strict=True)]


def activity_of(label: str) -> str:
    """The class of an activity that is described in words."""
    return next((k for k, words in ACTIVITIES.items() if any(w in label.lower() for w in words)), OTHER)


def _is_motion(row: Mapping[str, str]) -> bool:
    """Return whether a row is angles over time: a rate in Hz, or gait cycles of single trials."""
    if row["units"].split("/")[0] not in ("deg", "rad"):
        return False
    try:
        return float(row.get("rate_hz") or "nan") > 0
    except ValueError:
        return "trials" in row["path"]


def _quality(row: Mapping[str, str]) -> str:
    _, found, why = row["activity"].partition("LOW QUALITY")
    return ("low quality" + why) if found else ""


def _motion(name: str, recorded: Recorded, row: Mapping[str, str]) -> Motion:
    activity = activity_of(row["activity"])
    time, joints = _complete(recorded, name)
    body = load_body()
    column = {n: i for i, n in enumerate(body.joint_names)}
    quality = _quality(row)
    if "offset" in row["activity"] and not quality and activity == "walk":
        quality = _level(joints)
    known = np.zeros(len(column), bool)
    known[[column[n] for n in joints]] = True
    qpos = np.zeros((len(time), len(column)))
    for joint, deg in NEUTRAL_DEG.items():
        qpos[:, [column[f"{joint}_{s}"] for s in "rl"]] = np.radians(deg)
    for joint, values in (_left_as_right(time, joints, recorded.cycle, activity) | joints).items():
        qpos[:, column[joint]] = values
    soles = sole_points(qpos)
    if not quality:
        check_motion(qpos, known, soles, activity, name)
    feet = _Feet(soles, time)
    in_place = recorded.path_m is None or (activity in STRIDING and "treadmill" in row["activity"])
    way = None if in_place else recorded.path_m
    _place(qpos, feet, way, grounded=activity in GROUNDED, cycle=recorded.cycle)
    known[[column[n] for n in SLIDES]] = way is not None
    forward = facing(qpos)
    person = row["person"]
    return Motion(
        name=name,
        person=_SAME_PERSON.get(person, person),
        activity=activity,
        label=row["activity"],
        time_s=time,
        qpos=qpos,
        known=known,
        heading_rad=float(np.arctan2(-forward[2], forward[0])),
        cycle=recorded.cycle,
        quality=quality,
        source=f"{row.get('repo', '')} {row.get('commit', '')}".strip(),
        licence=row.get("licence", ""),
    )


def _complete(recorded: Recorded, name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Time from 0 and joints without gaps, turns continuous. Raises `PblError` FILE_FORMAT."""
    time = np.asarray(recorded.time_s, float) - recorded.time_s[0]
    if len(time) < 10 or not np.all(np.diff(time) > 0):
        raise PblError(
            "FILE_FORMAT",
            found=f"{len(time)} time stamps" + (" that do not increase" if len(time) >= 10 else ""),
            expected="at least 10 that increase",
            next_step="leave the row out of the index",
            key=name,
        )
    joints = {}
    for joint, values in recorded.joints.items():
        there = np.isfinite(values)
        joints[joint] = np.unwrap(np.interp(time, time[there], values[there]))
    return time, joints


def _level(joints: dict[str, np.ndarray]) -> str:
    """Turn the pelvis frame of a model that is off about its lateral axis; hips and trunk stay where they are."""
    turn = np.radians(LEVEL_TILT_DEG) - float(joints["pelvis_tilt"].mean())
    for joint in joints:
        if joint == "pelvis_tilt":
            joints[joint] = joints[joint] + turn
        elif joint.startswith(("hip_flexion", "lumbar_extension")):
            joints[joint] = joints[joint] - turn
    return f"pelvis frame turned by {np.degrees(turn):.0f} deg"


def _left_as_right(
    time: np.ndarray, joints: dict[str, np.ndarray], cycle: bool, activity: str
) -> dict[str, np.ndarray]:
    """Joints of a left side that was not measured: those of the right one, half a stride later where people stride."""
    missing = [n for n in joints if n.endswith("_r") and n.removesuffix("r") + "l" not in joints]
    if not missing or activity not in STRIDING:
        return {n.removesuffix("r") + "l": joints[n] for n in missing}
    if cycle:
        half = len(time) // 2
        return {n.removesuffix("r") + "l": np.roll(joints[n], half) for n in missing}
    half = 0.5 * stride_s(time, joints["knee_angle_r"])
    at = np.where(time >= half, time - half, time + half)
    return {n.removesuffix("r") + "l": np.interp(at, time, joints[n]) for n in missing}


def stride_s(time_s: np.ndarray, knee: np.ndarray, bounds_s: tuple[float, float] = (0.45, 2.0)) -> float:
    """Mean stride time (s): where a knee's curve is most like itself later (its first good match)."""
    step = float(np.median(np.diff(time_s)))
    even = np.interp(np.arange(time_s[0], time_s[-1], step), time_s, knee)
    even = even - even.mean()
    last = min(int(bounds_s[1] / step), len(even) - int(_OVERLAP_S / step))
    lags = np.arange(max(1, int(bounds_s[0] / step)), last + 1)
    if not len(lags):
        raise PblError(
            "REFERENCE_INPUT",
            found=f"{time_s[-1] - time_s[0]:.2f} s of walking",
            expected="a whole stride",
            next_step="leave the row out of the index",
        )
    like = np.array([np.corrcoef(even[:-k], even[k:])[0, 1] for k in lags])
    peaks = [i for i in range(1, len(like) - 1) if like[i] >= like[i - 1] and like[i] > like[i + 1]]
    best = max((like[i] for i in peaks), default=0.0)
    return float(lags[next((i for i in peaks if like[i] > best - 0.1), int(np.argmax(like)))] * step)


def check_motion(
    qpos: np.ndarray, known: np.ndarray, soles: Mapping[str, np.ndarray], activity: str, name: str
) -> None:
    """Refuse joint values that contradict the convention they were read with.

    Radians that were taken for degrees move no knee; degrees taken for radians turn in circles (ANGLE_UNITS). A knee
    bends further than it overextends; a walker's pelvis is nearly level; the foot that stands is level, which is
    tilt + hip - knee + ankle = 0 in the sagittal plane, so that a wrong sign of any of them shows (REFERENCE_INPUT).
    """
    body = load_body()
    column = {n: i for i, n in enumerate(body.joint_names)}
    deg = np.degrees(qpos)
    legs = [column[f"{n}_{s}"] for n in ("hip_flexion", "knee_angle") for s in "rl"]
    legs = [i for i in legs if known[i]]
    largest = np.abs(deg[:, legs]).max() if legs else 90.0
    if largest > 200.0 or (largest < 2.0 and activity not in ("stand", OTHER)):
        raise PblError(
            "ANGLE_UNITS",
            found=f"a hip or knee of at most {largest:.3g} deg",
            expected="2 to 200 deg in a person who moves",
            next_step="correct the unit in index.csv",
            key=name,
        )
    for side in "rl":
        knee = -deg[:, column[f"knee_angle_{side}"]]
        if known[column[f"knee_angle_{side}"]] and np.percentile(knee, 99) < -np.percentile(knee, 1):
            raise _contradiction(
                f"a knee of {np.percentile(knee, 1):.0f} to {np.percentile(knee, 99):.0f} deg",
                "a knee that bends further than it overextends",
                "correct `knee_sign` in index.csv",
                name,
            )
    if not known[column["pelvis_tilt"]] or activity not in ("walk", "squat", "sit_to_stand", "lift", "stand"):
        return
    tilt = deg[:, column["pelvis_tilt"]]
    if activity == "walk" and abs(tilt.mean()) > WALKING_TILT_DEG:
        raise _contradiction(
            f"a mean pelvic tilt of {tilt.mean():.0f} deg",
            f"within {WALKING_TILT_DEG:g} deg of level in a person who walks (posterior tilt positive)",
            "correct the convention in index.csv, or write there that the pelvis has an offset",
            name,
        )
    heel, toe = (list(SOLE_POINTS).index(n) for n in ("heel", "ball"))
    lower = np.argmin([soles[s][:, :, 2].min(axis=1) for s in "rl"], axis=0)
    rise = np.where(lower == 0, *(_pitch(soles[s][:, heel], soles[s][:, toe]) for s in "rl"))
    if abs(np.median(rise)) > FLAT_FOOT_DEG:
        raise _contradiction(
            f"the foot that stands points up by {np.median(rise):.0f} deg in the median",
            f"within {FLAT_FOOT_DEG:g} deg of level",
            "look at the signs of pelvic tilt, hip, knee and ankle of this model",
            name,
        )


def _pitch(heel: np.ndarray, toe: np.ndarray) -> np.ndarray:
    way = toe - heel
    return np.degrees(np.arctan2(way[:, 2], np.linalg.norm(way[:, :2], axis=1)))


class _Feet:
    """The soles of a motion whose pelvis is where the body's is at rest, and which of their points carry it."""

    def __init__(self, soles: Mapping[str, np.ndarray], time_s: np.ndarray) -> None:
        self.points = np.concatenate([soles["r"], soles["l"]], axis=1)
        self.time_s = time_s
        self._sigma = _SMOOTH_S / float(np.median(np.diff(time_s)))

    def lowest_m(self, cycle: bool) -> np.ndarray:
        return self._smooth(self.points[:, :, 2].min(axis=1), cycle)

    def way_m(self, cycle: bool) -> np.ndarray:
        """(T, 2) the way of the pelvis over a floor on which the lowest points stand still."""
        height = self.points[:, :, 2] - self.points[:, :, 2].min(axis=1, keepdims=True)
        weight = np.exp(-0.5 * (height / 0.01) ** 2)
        speed = np.gradient(self.points[:, :, :2], self.time_s, axis=0)
        mean = -np.sum(weight[..., None] * speed, axis=1) / weight.sum(axis=1, keepdims=True)
        mean = self._smooth(mean, cycle)
        step = np.diff(self.time_s)[:, None] * 0.5 * (mean[1:] + mean[:-1])
        return np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])

    def _smooth(self, values: np.ndarray, cycle: bool) -> np.ndarray:
        return gaussian_filter1d(values, self._sigma, axis=0, mode="wrap" if cycle else "nearest")


def _place(qpos: np.ndarray, feet: _Feet, path_m: np.ndarray | None, *, grounded: bool, cycle: bool) -> None:
    """Set the pelvis' place in `qpos`: on the floor z = 0, beginning over the origin."""
    body = load_body()
    x, y, z = (body.joint_names.index(n) for n in SLIDES)
    rest = body.mj_model.body("pelvis").pos[2]
    lowest = feet.lowest_m(cycle)
    if path_m is None:
        way = feet.way_m(cycle)
        up = -lowest
    else:
        # As large as the body: by the height of the pelvis over the lowest point of the soles.
        size = float(np.median(rest - lowest) / np.median(path_m[:, 1])) if np.median(path_m[:, 1]) > 0.3 else 1.0
        way = size * np.column_stack([path_m[:, 0], -path_m[:, 2]])
        up = -lowest if grounded else size * path_m[:, 1] - rest
        if not grounded:
            up = up - np.percentile(up + lowest, 2)
    qpos[:, x], qpos[:, z] = way[:, 0] - way[0, 0], -(way[:, 1] - way[0, 1])
    qpos[:, y] = up


def _contradiction(found: str, expected: str, next_step: str, name: str) -> PblError:
    return PblError("REFERENCE_INPUT", found=found, expected=expected, next_step=next_step, key=name)
