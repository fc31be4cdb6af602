"""Columns of the frames of a study: what a folder holds and what its data dictionary says."""

from __future__ import annotations

import csv
import dataclasses
from importlib import resources

import numpy as np

SIDES = ("left", "right", "both")
#: Points of a curve, in percent of the gait cycle.
CURVE_PERCENT = np.linspace(0.0, 100.0, 101)
CURVE_POINTS = tuple(f"p{i}" for i in range(101))


@dataclasses.dataclass(frozen=True)
class Column:
    """A column. `kind`: "label" (text, never empty), "text", "number" (empty: unknown), "flag" (true or false).
    `optional`: a study that lacks it has empty texts there."""

    name: str
    kind: str
    unit: str
    meaning: str
    optional: bool = False


def _frames() -> dict[str, tuple[Column, ...]]:
    text = resources.files("pbl_pipeline.study").joinpath("frame_columns.csv").read_text(encoding="utf-8")
    found: dict[str, list[Column]] = {}
    for row in csv.DictReader(text.splitlines()):
        column = Column(row["name"], row["kind"], row["unit"], row["meaning"], row["optional"] == "yes")
        found.setdefault(row["frame"], []).append(column)
    found["curves"] += [
        Column(p, "number", "unit", f"mean at {p[1:]} % of the gait cycle, from foot down") for p in CURVE_POINTS
    ]
    return {frame: tuple(columns) for frame, columns in found.items()}


#: Frame -> columns in their order (frame_columns.csv). `visits` may have more; they are carried along.
FRAMES = _frames()

#: Frame -> the columns of which no two rows may have the same values.
KEYS: dict[str, tuple[str, ...]] = {
    "visits": ("subject", "visit"),
    "measures": ("subject", "visit", "side", "measure"),
    "scores": ("subject", "visit", "instrument"),
    "instruments": ("instrument",),
    "cycles": ("subject", "visit", "side", "cycle", "measure"),
    "curves": ("subject", "visit", "side", "variable"),
}
