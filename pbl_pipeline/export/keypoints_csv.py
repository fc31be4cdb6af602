"""`.dlc.csv`: 2D keypoints with their confidence in DeepLabCut's format, which `movement` and others read."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from pbl_pipeline.csv_cells import quoted

from .columns import lines, number_cells
from .trial import ExportTrial


def write_keypoints_csv(trial: ExportTrial, path: Path) -> None:
    """Write pixels of the upright picture (x right, y down, origin at its upper left corner) and the detector's
    confidence (`likelihood`). One row per frame, number first; a point that was not seen has empty cells."""
    points = trial.keypoints
    assert points is not None  # `write_export` has checked it
    n, j = points.xy_px.shape[:2]
    scorer = f"pbl_{points.marker_set}"
    head = [
        ["scorer", *[scorer] * (3 * j)],
        ["bodyparts", *(quoted(name) for name in points.names for _ in range(3))],
        ["coords", *["x", "y", "likelihood"] * j],
    ]
    table = np.concatenate([points.xy_px, points.confidence[..., None]], axis=2).reshape(n, 3 * j)
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(head)
    path.write_bytes(text.getvalue().encode() + lines([number_cells(np.arange(n), 0), number_cells(table, 4)], ","))
