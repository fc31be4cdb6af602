"""`.forces.mot`: the ground reactions, as OpenSim reads external loads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pbl_pipeline.body import Y_UP_TO_Z_UP
from pbl_pipeline.errors import PblError
from pbl_pipeline.kinetics import GRAVITY

from .text import lines, number_cells
from .trial import ExportTrial


def write_forces(
    trial: ExportTrial, path: Path, origin: Mapping[str, str], title: str = "forces", floor_m: np.ndarray | None = None
) -> None:
    """Write the forces of both feet (N) and where they act (m) in OpenSim's ground, 100 Hz; 0 for a foot in the air.

    `floor_m` (T,): what was taken off the heights of the trial's frames. Times at which contact is not known are left
    out. The moment about the vertical is 0: the stage has none.

    Raises `PblError` EXPORT_INPUT where there are no forces or the mass is not known (`check_forces`).
    """
    check_forces(trial)
    assert trial.kinetics is not None
    assert trial.kinetics.series is not None
    assert trial.mass_kg is not None
    s = trial.kinetics.series
    known = np.isfinite(s.force_bw).all(axis=(1, 2))
    centre = s.centre_m.copy()
    if floor_m is not None:
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
    table = np.column_stack(columns)[known]
    head = [title, "version=1", f"nRows={len(table)}", f"nColumns={table.shape[1]}", "inDegrees=yes", ""]
    head += [f"{name}={text}" for name, text in origin.items()]
    head += ["units: N, m, Nm; ground with y up; r is the right foot, l the left", "endheader", "\t".join(names)]
    path.write_bytes(("\n".join(head) + "\n").encode("ascii") + lines([number_cells(table, 6)], "\t"))


def check_forces(trial: ExportTrial) -> None:
    """Raise `PblError` EXPORT_INPUT where a trial has no forces or the person's mass is not known."""
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
