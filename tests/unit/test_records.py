"""Columns that the fields of a dataclass declare."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.qc import Check
from pbl_pipeline.records import column, declared, definition, from_row, record, stored, to_row
from pbl_pipeline.results.cycles import GaitCycle
from pbl_pipeline.results.events import GaitEvent, GaitEvents
from pbl_pipeline.results.measures import Measure


@record
class Part:
    size_m: float | None = column("{}_size", "(m) of {}", default=None)
    why: str = column("{}_why", "reason", "varchar(5)", empty=True, default="")


@record
class Whole:
    number: int = column("{}_no", type="int16", key=True)
    mean: float = column("{}_mean", null=True)
    pairs: tuple = column("{}_pairs", type="json")
    curve: np.ndarray  # in a file
    part: Part = Part()
    side: str = column("{}_side", type="enum('left', 'right')", null=True, before="pairs", default="")

    @property
    @stored("{}_long", type="bool", before="part")
    def long(self) -> bool:
        return len(self.pairs) > 1


def test_a_definition_has_the_columns_in_their_order():
    assert definition(Whole, "x").splitlines() == [
        "x_no : int16",
        "---",
        "x_mean=null : float64",
        "x_side=null : enum('left', 'right')",
        "x_pairs : json",
        "x_long : bool",
        "x_size=null : float64  # (m) of x",
        "x_why='' : varchar(5)  # reason",
    ]
    assert definition(Whole, "x", only=("side",)) == "x_side=null : enum('left', 'right')"
    assert "x_size" not in definition(Whole, "x", without=("part",))


def test_a_record_is_read_as_it_was_written():
    numbers: tuple[Any, Any] = np.int64(3), np.float32(0.5)
    whole = Whole(*numbers, ((1.0, 2.0), (np.float64(3.0), 4.0)), np.ones(2), Part(1.5, "short"), "left")
    row = to_row(whole, "x")
    assert row == {
        "x_no": 3, "x_mean": 0.5, "x_side": "left", "x_pairs": [[1.0, 2.0], [3.0, 4.0]], "x_long": True, "x_size": 1.5,
        "x_why": "short",
    }  # fmt: skip
    assert [type(row[k]) for k in ("x_no", "x_mean", "x_long")] == [int, float, bool]
    again = from_row(Whole, row, "x", curve=whole.curve)
    assert again.curve is whole.curve
    assert (again.number, again.mean, again.part, again.side) == (3, 0.5, Part(1.5, "short"), "left")
    assert again.pairs == ([1.0, 2.0], [3.0, 4.0])
    assert from_row(Whole, {k: v for k, v in row.items() if k != "x_size"}, "x", curve=whole.curve).part.size_m is None


@pytest.mark.parametrize("unknown", [None, math.nan, math.inf])
def test_what_is_not_known_is_null(unknown: float | None):
    row = to_row(Whole(0, math.nan, (), np.ones(2), Part(unknown, "too long a reason")), "x")
    assert [row[k] for k in ("x_mean", "x_side", "x_size", "x_why")] == [None, None, None, "too l"]
    again = from_row(Whole, row, "x", curve=np.ones(2))
    assert math.isnan(again.mean)
    assert (again.side, again.part.size_m) == ("", None)


@pytest.mark.parametrize("cls", [GaitCycle, GaitEvent, GaitEvents, Measure, Check])
def test_each_field_of_a_result_has_a_column_or_a_known_place(cls: type):
    """Those without one are in a file, in a table below, or in the row above."""
    elsewhere = {"trial", "curves", "curves_sd", "angle_model", "error_model", "events", "qc", "params_hash"}
    in_row = {d.path[0] for d in declared(cls)}
    assert {f.name for f in dataclasses.fields(cls)} - in_row <= elsewhere
