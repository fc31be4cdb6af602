"""Clinical scores of a laboratory's own: rows of ClinicalInstrument, checked as a command or a form states them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label

from .. import study
from ..decisions.review_decisions import record
from ..intake.sheets import Line, Row, number_of, refused
from ..transactions import in_transaction
from . import study_sheets

#: Text fields and the most characters of each; the first three are needed.
TEXTS = {
    "instrument": 32,
    "instrument_name": 128,
    "instrument_unit": 16,
    "instrument_source": 255,
    "minimal_change_source": 255,
}
NUMBERS = ("instrument_low", "instrument_high", "minimal_change")
FLAGS = ("higher_is_better", "ordinal")
_NEEDED = (*list(TEXTS)[:3], *FLAGS)


def add_instrument(values: Mapping[str, str], by: str) -> dict[str, PblError]:
    """Insert an instrument with a row of Decision; returns the errors by field, and with any of them inserts nothing.

    Parameters
    ----------
    values
        Text by field (`TEXTS`, `NUMBERS`, `FLAGS` as yes or no); an empty one is not stated.
    """
    return in_transaction(lambda: _add(Row("instrument", {k: t for k, v in values.items() if (t := v.strip())}), by))


def _add(row: Row, by: str) -> dict[str, PblError]:
    made: dict[str, Any] = {}
    errors: dict[str, PblError] = {}
    for field in (*TEXTS, *NUMBERS, *FLAGS):
        line = Line(field)
        with line.about():
            made[field] = _value(row, field)
        if line.errors:
            errors[field] = line.errors[0]
    low, high = (made.get(f"instrument_{end}") for end in ("low", "high"))
    if low is not None and high is not None and low >= high:
        expected = f"more than the lowest value, {low:g}"
        errors["instrument_high"] = refused("instrument_high", f"{high:g}", expected, "correct one of them")
    if made.get("minimal_change") is not None and made.get("minimal_change_source") == "":
        found = "a minimal important change without its source"
        expected = "who found it, in whom"
        errors["minimal_change_source"] = refused("minimal_change_source", found, expected, "write it, or neither")
    if not errors:
        study.ClinicalInstrument.insert1(made)
        record("instrument", by, {"instrument": made["instrument"]}, {}, made)
    return errors


def _value(row: Row, field: str) -> Any:
    text = row.cells.get(field, "")
    if not text and field in _NEEDED:
        raise refused(field, "nothing", "a value", "write it")
    if field in FLAGS:
        if text not in ("yes", "no"):
            raise refused(field, repr(text[:20]), "yes or no", "choose one of them")
        return text == "yes"
    if field in NUMBERS:
        value = number_of(row, field, text) if text else None
        if field == "minimal_change" and value is not None and value <= 0:
            raise refused(field, text, "a change above 0", "correct it, or leave it empty")
        return value
    check_label(field, text, TEXTS[field])
    if field == "instrument":
        taken = {*study_sheets.COLUMNS, "instrument", "value", "video"}
        taken |= {str(name).lower() for name in study.ClinicalInstrument().to_arrays("instrument")}
        if text.lower() in taken or text.lower().replace(" ", "_") in taken:
            raise refused(field, repr(text), "a name that no instrument and no column of a sheet has", "choose another")
    if field == "instrument_unit" and text.lower() == "punkte":
        return "points"  # the word by which whole numbers are asked for (`study.check_score`)
    return text
