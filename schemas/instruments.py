"""The clinical scores that ship (`instruments.csv`): rows of `study.ClinicalInstrument`."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_NUMBERS = ("instrument_low", "instrument_high", "minimal_change")
_FLAGS = ("higher_is_better", "ordinal")


def _row(cells: Mapping[str, str]) -> dict[str, Any]:
    numbers = {name: float(cells[name]) if cells[name] else None for name in _NUMBERS}
    return {**cells, **numbers, **{name: cells[name] == "yes" for name in _FLAGS}}


with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as _file:
    INSTRUMENTS = tuple(_row(cells) for cells in csv.DictReader(_file))
