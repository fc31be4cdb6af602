"""`.mot` and `.forces.mot` for OpenSim, and the floor from which the heights of its formats and C3D count."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.body import PELVIS_TURNS, SLIDES, Y_UP_TO_Z_UP, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit.problem import SOLES
from pbl_pipeline.gait.ground import is_metric
from pbl_pipeline.kinetics import GRAVITY
from pbl_pipeline.sampling import interval_of

from .columns import lines, number_cells
from .osim import pelvis_rest_m
from .trial import ExportTrial


def write_forces(trial: ExportTrial, path: Path, origin: Mapping[str, str], title: str, floor_m: np.ndarray) -> None:
    """Write the forces of both feet (N) and their points of application (m) in OpenSim's ground, 100 Hz; 0 for a foot
    in the air.

    `floor_m` (T,): heights subtracted from those of the trial's frames. Times with unknown contact are omitted. The
    moment about the vertical is not computed and written as 0. `check_forces` is called before.
    """
    assert trial.kinetics is not None
    assert trial.kinetics.series is not None
    assert trial.mass_kg is not None
    s = trial.kinetics.series
    known = np.isfinite(s.force_bw).all(axis=(1, 2))
    centre = s.centre_m.copy()
    seen = np.isfinite(floor_m)
    centre[..., 2] -= np.interp(s.time_s, np.asarray(trial.fit.time_s)[seen], floor_m[seen])[:, None]
    force = trial.mass_kg * GRAVITY * s.force_bw @ Y_UP_TO_Z_UP
    centre = np.nan_to_num(centre @ Y_UP_TO_Z_UP)
    columns, names = [s.time_s], ["time"]
    for k, side in ((1, "r"), (0, "l")):
        for what, values in (("force", force[:, k]), ("point", centre[:, k]), ("torque", np.zeros_like(force[:, k]))):
            columns += list(values.T)
            axes = {"force": "v", "point": "p", "torque": ""}[what]
            names += [f"ground_{'torque' if what == 'torque' else 'force'}_{side}_{axes}{x}" for x in "xyz"]
    units = "units: N, m, Nm; ground with y up; r is the right foot, l the left"
    _write_motion(path, title, origin, units, names, np.column_stack(columns)[known])


def _write_motion(
    path: Path, title: str, origin: Mapping[str, str], units: str, names: Sequence[str], table: np.ndarray
) -> None:
    """Write columns with a header of OpenSim, without an empty line (pyomeca stops at one)."""
    head = [title, "version=1", f"nRows={len(table)}", f"nColumns={table.shape[1]}", "inDegrees=yes"]
    head += [*(f"{name}={text}" for name, text in origin.items()), units, "endheader", "\t".join(names)]
    path.write_bytes(("\n".join(head) + "\n").encode("ascii") + lines([number_cells(table, 6)], "\t"))


def check_forces(trial: ExportTrial) -> None:
    """Raise `PblError` EXPORT_INPUT if a trial has no forces or the person's mass is not known."""
    if trial.kinetics is None or trial.kinetics.series is None:
        why = "" if trial.kinetics is None or not trial.kinetics.reason else f": {trial.kinetics.reason}"
        raise PblError(
            "EXPORT_INPUT",
            found=f"no forces{why}",
            expected="a trial with ground reactions (docs/kinetics.md)",
            next_step="leave out --to forces, or write kinetics.json with `pbl gait` beside the fits; in the tables "
            "`pbl why VIDEO_ID` says what stops them",
            key=trial.name,
        )
    if trial.mass_kg is None:
        raise PblError(
            "EXPORT_INPUT",
            found="no body mass",
            expected="the mass that turns body weights into newtons",
            next_step="`pbl gait *.fit.npz --mass-kg 68.5 --out metrics.json` in the folder of the fits; in the tables "
            "`pbl ingest` a video of the visit again with --mass-kg 68.5, then `pbl populate`",
            key=trial.name,
        )


def coordinates(trial: ExportTrial) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the coordinates in the order of OpenSim's models and their values (T, up to 40): degrees, and metres of
    the pelvis in OpenSim's ground. Joints that were not observed are left out: a program then holds them at their
    default. Our pelvis moves from its position in the MJCF, OpenSim's from the origin."""
    body, qpos = load_body(), np.asarray(trial.fit.qpos, float)
    column = {n: i for i, n in enumerate(trial.fit.joint_names)}
    names = (*PELVIS_TURNS, *SLIDES, *(n for n in body.joint_names if n not in (*PELVIS_TURNS, *SLIDES)))
    names = tuple(n for n in names if n not in trial.fit.not_observed)
    rest = pelvis_rest_m(body)
    values = [qpos[:, column[n]] + rest[n] if n in SLIDES else np.degrees(qpos[:, column[n]]) for n in names]
    return names, np.column_stack(values)


def write_mot(trial: ExportTrial, path: Path, origin: Mapping[str, str], title: str) -> None:
    """Write the observed joint values with OpenSim's names: angles in degrees with the joints' signs (knee negative in
    flexion), pelvis_tx, ty, tz in metres in OpenSim's ground. Frames without a pose are omitted."""
    names, values = coordinates(trial)
    table = np.column_stack([np.asarray(trial.fit.time_s, float), values])[trial.known]
    units = "units: angles in degrees, pelvis_tx/ty/tz in metres; ground with y up"
    _write_motion(path, title, origin, units, ("time", *names), table)


#: Largest distance (m) of the lowest sole from a floor in `_OF_FRAMES` of the frames.
FLOOR_WITHIN_M = 0.03
_OF_FRAMES = 0.8
#: Window in which the floor is a line, about two strides (s).
_WINDOW_S = 2.0
#: Largest rise of the floor as a fraction of the path, plus an error (m): more is a stair or a ramp.
_STEEPEST, _ERROR_M = 0.1, 0.05
#: Slide of the pelvis along the vertical.
_VERTICAL = "pelvis_ty"


def floor_under_person_m(trial: ExportTrial) -> np.ndarray | None:
    """Return (T,) heights (m) of the floor under the person in the fit's world, NaN without a pose; None: none found.

    At least one foot is on the floor in every frame of a walk, so the floor is the lowest point of both soles, smoothed
    by the line through each window; at the ends the first and the last line go on, because a mean or median of half a
    window lags where the floor rises. A level floor may rise or sink in the world of one camera: an error of the
    vertical of 1 deg makes 10 cm over 6 m, and the distance from the camera has errors. No floor is found if the lowest
    point does not stay within `FLOOR_WITHIN_M` (a jump, a poor fit) or if the floor is too steep (stairs).
    """
    poses, known = trial.poses, trial.known
    soles = []
    for name, place in SOLES:
        at, local = poses.index(name), poses.scale_of(name, trial.fit.scale) * np.asarray(place)
        soles.append(poses.position_m[known, at] + poses.rotation[known, at] @ local)
    lowest = np.stack(soles)[..., 2].min(axis=0)
    times = np.asarray(trial.fit.time_s, float)[known]
    if len(times) < 3:
        return None
    size = min(1 + 2 * round(0.5 * _WINDOW_S / interval_of(times)), len(times))
    from scipy.signal import savgol_filter  # takes longer to import than most commands run

    followed = np.asarray(savgol_filter(lowest, size, 1), float)
    pelvis = poses.position_m[known, poses.index("pelvis"), :2]
    path = float(np.linalg.norm(np.ptp(pelvis, axis=0)))
    close = np.mean(np.abs(lowest - followed) <= FLOOR_WITHIN_M) >= _OF_FRAMES
    if not close or np.ptp(followed) > _STEEPEST * path + _ERROR_M:
        return None
    floor = np.full(len(known), np.nan)
    floor[known] = followed
    return floor


def on_floor(trial: ExportTrial) -> tuple[ExportTrial, str]:
    """Return the trial with heights above the floor under the person, and a description of height 0 for headers.

    Angles do not change: each frame is moved as a whole. Heights in the world of a laboratory or of calibrated cameras
    do not change, because force plates and other markers share it.
    """
    if is_metric(trial.fit):
        return trial, "height 0 is that of the laboratory's or the calibrated cameras' world"
    floor = floor_under_person_m(trial)
    if floor is None:
        return trial, "height 0 is that of the camera at the start: no floor was found"
    fit = trial.fit
    qpos, markers = np.array(fit.qpos, float), np.array(fit.markers_world_m, float)
    qpos[:, fit.joint_names.index(_VERTICAL)] -= floor
    markers[..., 2] -= floor[:, None]
    lowered = dataclasses.replace(fit, qpos=qpos, markers_world_m=markers)
    return dataclasses.replace(trial, fit=lowered), "height 0 is the floor under the person, from the lowest sole"


def taken_off(trial: ExportTrial, standing: ExportTrial) -> np.ndarray:
    """Return (T,) heights that `on_floor` subtracted from those of the frames (m), NaN without a pose."""
    column = trial.fit.joint_names.index(_VERTICAL)
    return np.asarray(trial.fit.qpos, float)[:, column] - np.asarray(standing.fit.qpos, float)[:, column]
