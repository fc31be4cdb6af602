"""`.mot`: the joint angles, as OpenSim reads them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pbl_pipeline.body import PELVIS_TURNS, SLIDES, load_body

from .osim import pelvis_rest_m
from .text import lines, number_cells
from .trial import ExportTrial


def coordinates(trial: ExportTrial) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the coordinates in the order of OpenSim's models and their values (T, 40): degrees, and metres of the
    pelvis in OpenSim's ground. The pelvis of our body moves from its place in the MJCF, OpenSim's from the origin."""
    body, qpos = load_body(), np.asarray(trial.fit.qpos, float)
    column = {n: i for i, n in enumerate(trial.fit.joint_names)}
    names = (*PELVIS_TURNS, *SLIDES, *(n for n in body.joint_names if n not in (*PELVIS_TURNS, *SLIDES)))
    rest = pelvis_rest_m(body)
    values = [qpos[:, column[n]] + rest[n] if n in SLIDES else np.degrees(qpos[:, column[n]]) for n in names]
    return names, np.column_stack(values)


def write_mot(trial: ExportTrial, path: Path, origin: Mapping[str, str], title: str = "coordinates") -> None:
    """Write the 40 joint values under OpenSim's names: angles in degrees with the joints' own signs (knee negative in
    flexion), pelvis_tx, ty, tz in metres in OpenSim's ground. Frames without a pose are left out."""
    names, values = coordinates(trial)
    table = np.column_stack([np.asarray(trial.fit.time_s, float), values])[trial.known]
    head = [title, "version=1", f"nRows={len(table)}", f"nColumns={table.shape[1]}", "inDegrees=yes", ""]
    head += [f"{name}={text}" for name, text in origin.items()]
    head += ["units: angles in degrees, pelvis_tx/ty/tz in metres; ground with y up", "endheader"]
    head.append("\t".join(["time", *names]))
    path.write_bytes(("\n".join(head) + "\n").encode("ascii") + lines([number_cells(table, 6)], "\t"))
