"""The clinical scores that ship (`instruments.csv`): rows of `study.ClinicalInstrument`, and which contradict."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

NUMBERS = ("instrument_low", "instrument_high", "minimal_change")
FLAGS = ("higher_is_better", "ordinal")


def _row(cells: Mapping[str, str]) -> dict[str, Any]:
    numbers = {name: float(cells[name]) if cells[name] else None for name in NUMBERS}
    return {**cells, **numbers, **{name: cells[name] == "yes" for name in FLAGS}}


with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as _file:
    INSTRUMENTS = tuple(_row(cells) for cells in csv.DictReader(_file))

#: Total -> parts, whose sum it is.
PARTS = {"mJOA": ("mJOA-UE", "mJOA-LE", "mJOA-S", "mJOA-B")}
#: Distances (m) that a 10 metre walk test is timed over: all of it, or without the metres of speeding up and slowing.
_TIMED_M = (10.0, 6.0)
_BOUNDS = {row["instrument"]: (row["instrument_low"], row["instrument_high"]) for row in INSTRUMENTS}


def disagreement(scores: Mapping[str, float]) -> tuple[tuple[str, ...], str, str] | None:
    """Return which scores of a visit contradict each other, what they are and what is expected; None if none do."""
    for total, parts in PARTS.items():
        known = [name for name in parts if name in scores]
        if total not in scores or not known:
            continue
        bounds = [(scores[n],) * 2 if n in scores else _BOUNDS[n] for n in parts]
        low, high = (sum(side) for side in zip(*bounds, strict=True))
        if not low <= scores[total] <= high:
            names = (total, *known)
            found = ", ".join(f"{n} {scores[n]:g}" for n in names)
            return names, found, f"{total} {low:g}{'' if low == high else f' to {high:g}'}, the sum of its parts"
    names = ("10MWT_s", "10MWT_m_per_s")
    if set(names) <= set(scores):
        time_s, speed = (scores[n] for n in names)
        if not any(abs(time_s * speed / distance - 1.0) <= 0.05 for distance in _TIMED_M):
            found = f"10MWT: seconds {time_s:g}, m/s {speed:g}"
            return names, found, f"a speed of {10 / time_s:.2f} m/s, or {6 / time_s:.2f} where 6 m of the 10 are timed"
    return None
