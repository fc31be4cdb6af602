"""`.trc`: the fitted markers, as OpenSim reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pbl_pipeline.body import Y_UP_TO_Z_UP

from ._text import rows
from ._trial import ExportTrial


def write_trc(trial: ExportTrial, path: Path, title: str = "markers") -> None:
    """Write the fitted markers in mm, in OpenSim's ground: x as ours, y up, z = -y of our world.

    Frames at the ends in which no marker is known are left out; inside, unknown markers are empty cells. `Time` holds
    the video's own stamps, `DataRate` their mean rate.
    """
    fit = trial.fit
    seen = np.flatnonzero(np.isfinite(fit.markers_world_m).any(axis=(1, 2)))
    part = slice(seen[0], seen[-1] + 1)
    time = np.asarray(fit.time_s, float)[part]
    xyz = 1e3 * np.asarray(fit.markers_world_m, float)[part] @ Y_UP_TO_Z_UP
    n, j = xyz.shape[:2]
    rate = f"{(n - 1) / (time[-1] - time[0]) if n > 1 else 0.0:.6g}"
    numbers = range(1, j + 1)
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{title}.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{j}\tmm\t{rate}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(fit.marker_names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in numbers),
        "",
    ]
    table = np.column_stack([np.arange(1, n + 1), time, xyz.reshape(n, -1)])
    body = rows(table, ["%d", "%.6f", *["%.4f"] * (3 * j)], "\t", "")
    path.write_text("\n".join([*head, *body]) + "\n", encoding="ascii")
