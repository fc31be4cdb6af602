"""`.trc`: the fitted markers, as OpenSim reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbl_pipeline.body import Y_UP_TO_Z_UP

from .text import lines, number_cells
from .trial import ExportTrial


def write_trc(trial: ExportTrial, path: Path, title: str = "markers") -> None:
    """Write the fitted markers in mm, in OpenSim's ground: x as ours, y up, z = -y of our world.

    Frames in which no marker is known are left out, because OpenSim's inverse kinematics stops at them; a single marker
    that is not known is an empty cell. `Time` holds the video's own stamps, `DataRate` their median rate.
    """
    fit = trial.fit
    seen = np.isfinite(fit.markers_world_m).any(axis=(1, 2))
    time = np.asarray(fit.time_s, float)[seen]
    xyz = 1e3 * np.asarray(fit.markers_world_m, float)[seen] @ Y_UP_TO_Z_UP
    n, j = xyz.shape[:2]
    rate = f"{1.0 / np.median(np.diff(time)) if n > 1 else 0.0:.6g}"
    numbers = range(1, j + 1)
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{title}.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{j}\tmm\t{rate}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(fit.marker_names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in numbers),
        "",
    ]
    # OpenSim loses an empty cell at the end of a line: a further tab keeps it.
    kept = np.where(np.isnan(xyz[:, -1, 0]), ord("\t"), 0).astype(np.uint8)[:, None]
    cells = number_cells(xyz.reshape(n, -1), 4)
    last = np.concatenate([cells[:, -1], kept], axis=1)
    blocks = [number_cells(np.arange(1, n + 1), 0), number_cells(time, 6), cells[:, :-1], last]
    path.write_bytes(("\n".join(head) + "\n").encode("ascii") + lines(blocks, "\t"))
