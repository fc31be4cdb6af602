"""Columns that the fields of a dataclass declare."""

import collections.abc
import dataclasses
import json
import math
import types
import typing
from typing import Any

import numpy as np
import pytest

from pbl_pipeline import results
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import shortened
from pbl_pipeline.qc import Check
from pbl_pipeline.records import column, declared, definition, from_json, from_row, plain, record, stored, to_row
from pbl_pipeline.results.cycles import GaitCycle
from pbl_pipeline.results.events import GaitEvent, GaitEvents, SetEvent
from pbl_pipeline.results.fits import Residuals, TrialFigures
from pbl_pipeline.results.index import NormFacts, VariableScore
from pbl_pipeline.results.measures import Measure
from pbl_pipeline.results.people import HiddenHeads, KeypointFigures, TrackFigures
from pbl_pipeline.results.video_facts import Intrinsics
from pbl_schemas import gait


@record
class Part:
    size_m: float | None = column("{}_size", "(m) of {}", default=None)
    why: str = column("{}_why", "reason", "varchar(5)", old="", cut=True, default="")


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
    assert [row[k] for k in ("x_mean", "x_side", "x_size", "x_why")] == [None, None, None, "t ..."]
    again = from_row(Whole, row, "x", curve=np.ones(2))
    assert math.isnan(again.mean)
    assert (again.side, again.part.size_m) == ("", None)


def test_a_name_that_is_longer_than_its_column_is_refused():
    """Cut, two names could become one; a text in words is cut."""
    profile = VariableScore("a" * 33, 1.0, 2.0)
    with pytest.raises(PblError, match=r"^USAGE: (?s:.*)angle of 33 characters(?s:.*)0 to 32 characters"):
        to_row(profile, "x")
    assert to_row(dataclasses.replace(profile, angle="a" * 32), "x")["x_angle"] == "a" * 32


@pytest.mark.parametrize(
    ("text", "longest", "expected"),
    [
        ("one two three", 13, "one two three"),
        ("one two three", 12, "one two ..."),
        ("one two three", 11, "one two ..."),
        ("one two three", 10, "one ..."),
        ("a" * 20, 10, "aaaaaa ..."),  # without a word that ends
        ("a " + "b" * 20, 10, "a bbbb ..."),
        ("one two", 3, " .."),
    ],
)
def test_a_text_that_is_too_long_ends_after_a_word_and_says_so(text: str, longest: int, expected: str):
    assert shortened(text, longest) == expected


def test_reasons_are_written_whole(monkeypatch: pytest.MonkeyPatch):
    """One of 700 characters was cut at 255, unsaid."""
    written: list[dict[str, Any]] = []
    table = gait.Spatiotemporal.Measure
    monkeypatch.setattr(table, "insert", classmethod(lambda _, rows: written.extend(rows)))
    reason = "the feet are hidden behind the walking frame in 40 of 60 frames; " * 11
    table.insert_measures({}, {"cadence": None, "speed": None}, {"cadence": reason, "speed": reason * 2})
    assert written[0]["measure_missing"] == reason
    assert len(written[1]["measure_missing"]) <= 1000
    assert written[1]["measure_missing"].endswith(" ...")
    kept = written[1]["measure_missing"].removesuffix(" ...")
    assert (reason * 2).startswith(kept + " ")


def test_an_unknown_record_is_null_and_counts_nothing():
    unknown = to_row(Measure, "x")
    assert unknown.pop("x_n") == 0
    assert set(unknown.values()) == {None}
    assert list(unknown) == [n for n in to_row(Measure(1.0, 2.0, 1.5, None, 2), "x") if n != "x_n"]


#: Values off every default by the type of a field.
VALUES: dict[Any, Any] = {
    float: 1.5, int: 3, bool: True, np.ndarray: np.array([1.5, 2.5]), dict[int, float]: {2: 0.5},
    tuple[str, ...]: ("a",),
    tuple[tuple[float, float], ...]: ((0.5, 1.5),),
    tuple[dict, ...]: ({"first": 0, "why": ["held"]},),
}  # fmt: skip


def filled(cls: Any) -> Any:
    """Return a record with a value off its default in each field with a column, and empty ones in the others."""
    own: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        kind, how = typing.get_type_hints(cls)[field.name], field.metadata.get("column")
        if isinstance(kind, types.UnionType):
            kind = typing.get_args(kind)[0] if how else type(None)
        plain_kind = typing.get_origin(kind) or kind
        if how is None:
            plain_kind = dict if plain_kind is collections.abc.Mapping else plain_kind
            empty = np.zeros(0) if kind is np.ndarray else None
            own[field.name] = (
                filled(kind) if dataclasses.is_dataclass(kind) else plain_kind() if empty is None else empty
            )
        else:
            last = how.type.split("'")[-2] if how.type.startswith("enum") else "why"
            own[field.name] = last if kind is str else VALUES[kind]
    return cls(**own)


RESULTS = [c for c in vars(results).values() if isinstance(c, type) and dataclasses.is_dataclass(c) and declared(c)]


OTHERS = [Check, SetEvent, NormFacts, Residuals, TrialFigures, Intrinsics, TrackFigures, KeypointFigures, HiddenHeads]


@pytest.mark.parametrize("cls", [*RESULTS, *OTHERS])
def test_every_field_with_a_column_survives_row_and_json(cls: Any):
    """A column of two fields would lose one of them; so would one that is not read as it is written."""
    whole = filled(cls)
    assert len({d.column.name for d in declared(cls)}) == len(declared(cls))
    in_row = {d.path[0] for d in declared(cls)}
    others = {f.name: getattr(whole, f.name) for f in dataclasses.fields(cls) if f.name not in in_row}
    row = to_row(whole, "x", without={d.path[0] for d in declared(cls) if d.read is None})  # an empty trace has no end
    assert plain(from_row(cls, row, "x", **others)) == plain(whole)
    told = json.loads(json.dumps(plain(whole)))
    assert plain(from_json(cls, told)) == plain(whole)


@pytest.mark.parametrize("cls", [GaitCycle, GaitEvent, GaitEvents, Measure, Check])
def test_each_field_of_a_result_has_a_column_or_a_known_place(cls: type):
    """Those without one are in a file, in a table below, or in the row above."""
    elsewhere = {"trial", "curves", "curves_sd", "angle_model", "error_model", "events", "qc", "params_hash"}
    in_row = {d.path[0] for d in declared(cls)}
    assert {f.name for f in dataclasses.fields(cls)} - in_row <= elsewhere
