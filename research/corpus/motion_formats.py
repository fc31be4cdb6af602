"""Joint values of our body from the files of other laboratories, family by family."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from pbl_pipeline.body import SLIDES, load_body
from pbl_pipeline.bounded import read_text
from pbl_pipeline.errors import PblError, unread_file
from pbl_pipeline.gait.normative import BODY_ANGLES, PLUG_IN_GAIT, offset_deg

#: What the ankle of the LBMC recordings (ISB axes, no neutral pose subtracted) is below the body's (deg): the mean of
#: both persons over walking is -10, and markerless solutions of the same trials are 10 to 14 above.
ISB_ANKLE_DEG = 11.0
#: Column -> joint, sign, of a child's model in SIMM's names. Turns about the room's x (ahead), y (up), z (right).
_SIMM = {
    "lower_torso_RZ": ("pelvis_tilt", 1.0),
    "lower_torso_RX": ("pelvis_list", 1.0),
    "lower_torso_RY": ("pelvis_rotation", 1.0),
    **{
        f"{theirs}_{side}": (f"{ours}_{side}", sign)
        for side in "rl"
        for theirs, (ours, sign) in {
            "hip_flex": ("hip_flexion", 1.0),
            "hip_add": ("hip_adduction", 1.0),
            "hip_rot": ("hip_rotation", 1.0),
            "knee_flex": ("knee_angle", -1.0),
            "ankle_flex": ("ankle_angle", 1.0),
        }.items()
    },
    "lumbar_pitch": ("lumbar_extension", 1.0),
}
#: Plug-in Gait, column without its side -> joint without its side, sign.
_PIG_SIDED = {
    "HipAngles_X": ("hip_flexion", 1.0),
    "HipAngles_Y": ("hip_adduction", 1.0),
    "HipAngles_Z": ("hip_rotation", 1.0),
    "KneeAngles_X": ("knee_angle", -1.0),
    "AnkleAngles_X": ("ankle_angle", 1.0),
    "ShoulderAngles_X": ("arm_flex", 1.0),
    "ElbowAngles_X": ("elbow_flex", 1.0),
}
#: The right side's pelvis and trunk. Anterior tilt, right side up, right side ahead, trunk flexion are positive there.
_PIG_MIDDLE = {
    "RPelvisAngles_X": ("pelvis_tilt", -1.0),
    "RPelvisAngles_Y": ("pelvis_list", -1.0),
    "RPelvisAngles_Z": ("pelvis_rotation", 1.0),
    "RSpineAngles_X": ("lumbar_extension", -1.0),
}
#: ISB angles of one leg; the knee and the lumbar joint are negative in flexion, as the body's are.
_ISB = {
    "RHip_FE": "hip_flexion_r",
    "RHip_AA": "hip_adduction_r",
    "RKnee_FE": "knee_angle_r",
    "RAnkle_FE": "ankle_angle_r",
    "L5S1_FE": "lumbar_extension",
    "RElbow_FE": "elbow_flex_r",
}
#: A joint that turns by less in the whole recording is locked in the model that was used: not known.
_LOCKED_RAD = 1e-3


@dataclasses.dataclass(frozen=True)
class Recorded:
    """Content of one file: `time_s` (T,); joint -> (T,) rad, of the body's joints with its signs; `path_m` (T, 3), the
    pelvis in the y-up ground of the file, or None; `cycle`: one gait cycle, whose end is its beginning."""

    time_s: np.ndarray
    joints: dict[str, np.ndarray]
    path_m: np.ndarray | None = None
    cycle: bool = False


def read_recorded(path: Path, row: Mapping[str, str]) -> list[Recorded]:
    """The recordings of a file (one, or the trials of a table), by the columns it has.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (no family knows these columns), ANGLE_UNITS and REFERENCE_INPUT (units
    or the knee's sign are not stated).
    """
    table, in_degrees = _table(path)
    names = {_pig_name(n) for n in table.columns}
    for needed, read in _FAMILIES:
        if needed <= names:
            return read(table, _to_rad(row, in_degrees, path), row, path)
    raise PblError(
        "FILE_FORMAT",
        found=f"columns {', '.join(map(str, list(table.columns)[:6]))} ...",
        expected="joint angles over time: OpenSim's, SIMM's, Plug-in Gait's or ISB's columns",
        next_step="leave the row out of the index, or add its family to _motion_formats.py",
        key=str(path),
    )


def _turning(table: pd.DataFrame, rad: float) -> dict[str, np.ndarray]:
    """The body's joints that turn, as far as the table has them (rad)."""
    names = [n for n in load_body().joint_names if n in table.columns and n not in SLIDES]
    return {n: rad * table[n].to_numpy(float) for n in names}


def _opensim(table: pd.DataFrame, rad: float, row: Mapping[str, str], path: Path) -> list[Recorded]:
    joints = _turning(table, rad)
    sign = _knee_sign(row, path)
    joints |= {n: -sign * v for n, v in joints.items() if n.startswith("knee_angle")}
    path_m = table[list(SLIDES)].to_numpy(float) if set(SLIDES) <= set(table.columns) else None
    return [Recorded(table["time"].to_numpy(float), _moving(joints), path_m)]


def _simm(table: pd.DataFrame, rad: float, row: Mapping[str, str], path: Path) -> list[Recorded]:
    joints = {j: sign * rad * table[n].to_numpy(float) for n, (j, sign) in _SIMM.items() if n in table.columns}
    way = table[[f"lower_torso_T{axis}" for axis in "XYZ"]].to_numpy(float)
    cycle = "average" in row.get("activity", "")
    return [Recorded(table["time"].to_numpy(float), _moving(joints), way, cycle)]


def _plug_in_gait(table: pd.DataFrame, rad: float, row: Mapping[str, str], path: Path) -> list[Recorded]:
    table, joints = table.rename(columns=_pig_name), {}
    for side in "RL":
        for name, (joint, sign) in _PIG_SIDED.items():
            if side + name in table.columns:
                joints[f"{joint}_{side.lower()}"] = sign * rad * table[side + name].to_numpy(float)
    for name, (joint, sign) in _PIG_MIDDLE.items():
        if name in table.columns:
            joints[joint] = sign * rad * table[name].to_numpy(float)
    joints = _moving(joints)
    more = {a: np.radians(offset_deg(a, PLUG_IN_GAIT, BODY_ANGLES)) for a in ("hip_flexion", "pelvis_tilt")}
    for joint in joints:
        if joint.startswith("hip_flexion"):
            joints[joint] = joints[joint] + more["hip_flexion"]
        elif joint == "pelvis_tilt":
            joints[joint] = joints[joint] - more["pelvis_tilt"]
        elif joint == "lumbar_extension":  # of the trunk against the pelvis, whose front is now higher
            joints[joint] = joints[joint] + more["pelvis_tilt"]
    return [Recorded(table["time"].to_numpy(float), joints)]


def _isb(table: pd.DataFrame, rad: float, row: Mapping[str, str], path: Path) -> list[Recorded]:
    joints = {j: rad * table[n].to_numpy(float) for n, j in _ISB.items() if n in table.columns}
    sign = _knee_sign(row, path)
    joints["knee_angle_r"] = -sign * joints["knee_angle_r"]
    joints = _moving(joints)
    if "ankle_angle_r" in joints and row.get("what", "").startswith("mocap"):
        joints["ankle_angle_r"] = joints["ankle_angle_r"] + np.radians(ISB_ANKLE_DEG)
    return [Recorded(table["Time"].to_numpy(float), joints)]


def _cycles(table: pd.DataFrame, rad: float, row: Mapping[str, str], path: Path) -> list[Recorded]:
    """Gait cycles of the right leg, 0 to 99 %; the time of each follows from its way and the stated speed."""
    speed = re.search(r"([\d.]+)\s*m/s", row.get("activity", ""))
    if speed is None:
        raise _unstated("the walking speed", "a speed such as 1.33 m/s in the activity", path)
    right = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle")
    arm = ("arm_flex", "arm_add", "arm_rot", "elbow_flex")
    sign = _knee_sign(row, path)
    out = []
    for _, trial in table.groupby("trial", sort=False):
        joints = _turning(trial, rad)
        joints |= {f"{n}_r": rad * trial[n].to_numpy(float) for n in (*right, *arm) if n in trial.columns}
        joints["knee_angle_r"] = -sign * joints["knee_angle_r"]
        way = trial[list(SLIDES)].to_numpy(float)
        n = len(way)
        seconds = abs(way[-1, 0] - way[0, 0]) * n / (n - 1) / float(speed[1])
        out.append(Recorded(seconds * np.arange(n) / n, _moving(joints), way, cycle=True))
    return out


_FAMILIES: tuple[tuple[set[str], Callable[..., list[Recorded]]], ...] = (
    ({"time", "pelvis_tilt", "hip_flexion_r", "knee_angle_r"}, _opensim),
    ({"time", "lower_torso_RZ", "hip_flex_r", "knee_flex_r"}, _simm),
    ({"time", "RHipAngles_X", "LHipAngles_X", "RKneeAngles_X", "RPelvisAngles_X"}, _plug_in_gait),
    ({"Time", "RHip_FE", "RKnee_FE"}, _isb),
    ({"trial", "pct", "hip_flexion", "knee_angle", "pelvis_tx"}, _cycles),
)


def _pig_name(column: str) -> str:
    """An older version of the model writes LHipAnglesV for LHipAngles."""
    return str(column).replace("AnglesV_", "Angles_")


def _table(path: Path) -> tuple[pd.DataFrame, bool | None]:
    """The columns of a .mot or .csv, gzipped or not, and what its header says of degrees (None: nothing)."""
    try:
        text = read_text(path)
        head, found, body = text.partition("endheader")
        if not found:
            return pd.read_csv(io.StringIO(text)), None
        stated = re.search(r"inDegrees\s*=\s*(yes|no)", head, re.IGNORECASE)
        table = pd.read_csv(io.StringIO(body), sep=r"\s+")
        return table, None if stated is None else stated[1].lower() == "yes"
    except (OSError, ValueError) as error:
        expected = "a .mot or .csv of joint angles over time, gzipped or not"
        raise unread_file(error, expected, "fetch the file again", path) from error


def _to_rad(row: Mapping[str, str], in_degrees: bool | None, path: Path) -> float:
    units = row.get("units", "").split("/")[0]
    if units not in ("deg", "rad"):
        raise _unstated("the angles' unit", "deg or rad in the column `units`", path)
    if in_degrees is not None and in_degrees != (units == "deg"):
        raise PblError(
            "ANGLE_UNITS",
            found=f"units {units} in the index, inDegrees={'yes' if in_degrees else 'no'} in the file",
            expected="the same in both",
            next_step="correct the index after a look at the values",
            key=str(path),
        )
    return np.pi / 180 if units == "deg" else 1.0


def _knee_sign(row: Mapping[str, str], path: Path) -> float:
    """+1 where the file's knee is positive in flexion."""
    sign = {"+flex": 1.0, "-flex": -1.0}.get(row.get("knee_sign", "").split(" ")[0])
    if sign is None and "knee NEGATIVE flexion" in row.get("model", ""):
        sign = -1.0
    if sign is None:
        raise _unstated("the knee's sign", "+flex or -flex in the column `knee_sign`", path)
    return sign


def _moving(joints: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Without joints that were locked, and without those of which most values are missing."""
    return {
        n: v for n, v in joints.items() if np.isfinite(v).mean() > 0.5 and np.nanmax(v) - np.nanmin(v) > _LOCKED_RAD
    }


def _unstated(what: str, expected: str, path: Path) -> PblError:
    return PblError(
        "REFERENCE_INPUT",
        found=f"{what} is not stated",
        expected=expected,
        next_step="state it in index.csv",
        key=str(path),
    )
