"""Columns of the frames of a study: what a folder holds and what its data dictionary says."""

from __future__ import annotations

import dataclasses

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


_VISIT = (
    Column("subject", "label", "", "code of the person"),
    Column("visit", "label", "", "label of the visit, one of its kind per person"),
)

#: Frame -> columns in their order. `visits` may have more; they are carried along.
FRAMES: dict[str, tuple[Column, ...]] = {
    "visits": (
        *_VISIT,
        Column("role", "label", "", "what the visit is in the study, such as baseline, pre, 6_weeks; once per person"),
        Column("days", "number", "d", "days from the event that study.json names; negative before it"),
        Column("group", "label", "", "group of the person, the same at all visits"),
        Column("included", "flag", "", "whether the visit counts"),
        Column("reason", "text", "", "why it does not count; empty where it does"),
        Column("gdi", "number", "", "gait deviation index of both sides; 100 is the norm"),
        Column("gdi_sd", "number", "", "standard deviation of the error of gdi"),
        Column("n_cycles", "number", "", "gait cycles of both sides in gdi"),
    ),
    "measures": (
        *_VISIT,
        Column("side", "label", "", "left, right or both"),
        Column("measure", "label", "", "gait measure, as in docs/measures.md; gdi of both sides stands in visits"),
        Column("value", "number", "unit", "mean over the cycles"),
        Column("sd", "number", "unit", "standard deviation between the cycles"),
        Column("n_cycles", "number", "", "gait cycles behind value"),
        Column("unit", "text", "", "unit of value and sd"),
    ),
    "scores": (
        *_VISIT,
        Column("instrument", "label", "", "clinical score; a row of instruments"),
        Column("value", "number", "unit of the instrument", "the score"),
    ),
    "instruments": (
        Column("instrument", "label", "", "clinical score"),
        Column("unit", "text", "", "of its values"),
        Column("low", "number", "unit", "lowest possible value; empty: none"),
        Column("high", "number", "unit", "highest possible value; empty: none"),
        Column("higher_is_better", "flag", "", "direction"),
        Column("ordinal", "flag", "", "whether its steps are ranks (Spearman) or a continuous measure (Pearson)"),
        Column("mic", "number", "unit", "minimal important change, positive; empty: none published"),
        Column("source", "text", "", "of range and minimal important change"),
        Column("classes", "text", "", "classes by lowest value, such as: 0 high risk; 41 at risk; 51 low risk"),
        Column("mic_classes", "text", "", "mic by lowest value before, such as: 0 3; 12 2; 15 1; empty: mic", True),
    ),
    "cycles": (
        *_VISIT,
        Column("side", "label", "", "left or right; both for a measure of the whole step"),
        Column("cycle", "number", "", "number of the cycle within visit and side"),
        Column("measure", "label", "", "gdi, or a measure of measures"),
        Column("value", "number", "unit of the measure", "of this cycle"),
    ),
    "curves": (
        *_VISIT,
        Column("side", "label", "", "left or right"),
        Column("variable", "label", "", "joint angle, such as knee_flexion"),
        Column("unit", "text", "", "of the points"),
        Column("n_cycles", "number", "", "gait cycles behind the mean curve"),
        *(Column(p, "number", "unit", f"mean at {p[1:]} % of the gait cycle, from foot down") for p in CURVE_POINTS),
    ),
}

#: Frame -> the columns of which no two rows may have the same values.
KEYS: dict[str, tuple[str, ...]] = {
    "visits": ("subject", "visit"),
    "measures": ("subject", "visit", "side", "measure"),
    "scores": ("subject", "visit", "instrument"),
    "instruments": ("instrument",),
    "cycles": ("subject", "visit", "side", "cycle", "measure"),
    "curves": ("subject", "visit", "side", "variable"),
}
