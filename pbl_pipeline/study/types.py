"""Data of a study, and the columns of its frames."""

from __future__ import annotations

import csv
import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import is_plain
from pbl_pipeline.shipped import shipped_text

SIDES = ("left", "right", "both")
#: Points of a curve, in percent of the gait cycle.
CURVE_PERCENT = np.linspace(0.0, 100.0, 101)
CURVE_POINTS = tuple(f"p{i}" for i in range(101))
invalid = functools.partial(PblError, "STUDY_INVALID")


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a frame."""

    name: str
    kind: str  # "label" (text, never empty), "text", "number" (empty: unknown) or "flag" (true or false)
    unit: str
    meaning: str
    optional: bool = False  # may be missing: then its texts are empty


def _frames() -> dict[str, tuple[Column, ...]]:
    found: dict[str, list[Column]] = {}
    for row in csv.DictReader(shipped_text("study/frame_columns.csv").splitlines()):
        column = Column(row["name"], row["kind"], row["unit"], row["meaning"], row["optional"] == "yes")
        found.setdefault(row["frame"], []).append(column)
    found["curves"] += [
        Column(p, "number", "unit", f"mean at {p[1:]} % of the gait cycle, from initial contact") for p in CURVE_POINTS
    ]
    return {frame: tuple(columns) for frame, columns in found.items()}


#: Frame -> columns in their order (frame_columns.csv). `visits` may have more, which are kept.
FRAMES = _frames()

#: Frame -> the columns that identify a row.
KEYS: dict[str, tuple[str, ...]] = {
    "visits": ("subject", "visit"),
    "measures": ("subject", "visit", "side", "measure"),
    "scores": ("subject", "visit", "instrument"),
    "instruments": ("instrument",),
    "cycles": ("subject", "visit", "side", "cycle", "measure"),
    "curves": ("subject", "visit", "side", "variable"),
}


#: Roles before the event of a study: no other visit of the person may be earlier.
FIRST_ROLES = ("baseline", "pre")
_LONGEST = 200


@dataclasses.dataclass(frozen=True)
class StudyDescription:
    """A study and how it was made."""

    name: str = ""  # of the frozen slice, "" without one
    hash: str = ""  # of its rows
    #: Stage -> method, such as {"fit": "blazepose-2"}.
    methods: Mapping[str, str] = dataclasses.field(default_factory=dict)
    code_version: str = ""  # of the code that computed the values
    event: str = ""  # day 0 of the visits, such as "surgery"
    #: Roles between which change is assessed, and the group that is expected to change. "": the first and the last role
    #: by their days, and the group with the most persons who have both.
    change_from: str = ""
    change_to: str = ""
    change_group: str = ""
    note: str = ""  # shown on the report


@dataclasses.dataclass(frozen=True)
class StudyData:
    """A study as pandas frames, without a database; docs/study.md names the columns (`FRAMES` in code).

    Columns are sorted and typed when it is made; a missing frame is an empty one. Persons are codes.

    Raises `PblError` STUDY_INVALID: no visit, a column missing or of another kind, infinite values, the same row twice,
    a row of an unknown visit, a person in two groups, a role twice among the included visits of a person, an excluded
    visit without a reason, a first visit (`FIRST_ROLES`) after another, a measure or curve with two units, an unknown
    score or one outside its range.
    """

    visits: pd.DataFrame  # one row per visit, also of excluded ones (`included` false, with `reason`)
    #: Long: one row per visit, side and gait measure.
    measures: pd.DataFrame = dataclasses.field(default_factory=pd.DataFrame)
    #: Long: one row per visit and clinical score; range and direction of each score.
    scores: pd.DataFrame = dataclasses.field(default_factory=pd.DataFrame)
    instruments: pd.DataFrame = dataclasses.field(default_factory=pd.DataFrame)
    #: Long: one row per gait cycle and measure, for the repeatability of cycles. May be empty.
    cycles: pd.DataFrame = dataclasses.field(default_factory=pd.DataFrame)
    #: One row per visit, side and joint angle: the mean curve at 0, 1, ..., 100 % of the cycle. May hold NaN.
    curves: pd.DataFrame = dataclasses.field(default_factory=pd.DataFrame)
    description: StudyDescription = dataclasses.field(default_factory=StudyDescription)  # of the study

    def __post_init__(self) -> None:
        for name in FRAMES:
            object.__setattr__(self, name, typed(name, getattr(self, name)))
        _check_visits(self.visits)
        visits: Any = self.visits
        known = pd.MultiIndex.from_frame(visits[["subject", "visit"]])
        for name, key in KEYS.items():
            frame: Any = getattr(self, name)
            if (twice := frame.duplicated(list(key))).any():
                raise invalid(f"{_row(frame, twice, key)} twice", "one row of each", "remove or correct one", name)
            if "visit" in key:
                lost = ~pd.MultiIndex.from_frame(frame[["subject", "visit"]]).isin(known)
                if lost.any():
                    raise invalid(
                        f"{_row(frame, lost, key)}, a visit that is not in visits", "visits of visits", "add it", name
                    )
            if "side" in key and (odd := ~frame["side"].isin(SIDES)).any():
                raise invalid(f"side {frame.loc[odd, 'side'].iloc[0]!r}", ", ".join(SIDES), "correct the side", name)
        _check_units(self.measures, "measures", "measure")
        _check_units(self.curves, "curves", "variable")
        measures: Any = self.measures
        if ((measures["measure"] == "gdi") & (measures["side"] == "both")).any():
            raise invalid("gdi of both sides", "that index in visits only", "remove it here", "measures")
        _check_scores(self.scores, self.instruments)

    @property
    def n_subjects(self) -> int:
        """Number of persons, also those without an included visit."""
        return len(set(self.visits["subject"]))

    @property
    def n_visits(self) -> int:
        """Number of visits, also excluded ones."""
        return len(self.visits)


def typed(name: str, frame: pd.DataFrame) -> pd.DataFrame:
    """Copy a frame with its columns sorted and typed. Raises `PblError` STUDY_INVALID."""
    columns, frame = FRAMES[name], frame.reset_index(drop=True)
    if not len(frame) and not len(frame.columns):
        frame = pd.DataFrame({c.name: [] for c in columns})
    frame = frame.assign(**{c.name: "" for c in columns if c.optional and c.name not in frame})
    if absent := [c.name for c in columns if c.name not in frame]:
        raise invalid(f"no column {', '.join(absent[:5])}", "the columns of docs/study.md", "add them", name)
    more = [c for c in frame.columns if c not in {k.name for k in columns}]
    if more and name != "visits":
        raise invalid(f"unknown column {more[0]!r}", "the columns of docs/study.md", "remove it", name)
    known = pd.DataFrame({c.name: _values(name, c, frame[c.name]) for c in columns}, index=frame.index)
    return known.join(frame[more])


def _values(name: str, column: Column, values: Any) -> Any:
    try:
        if column.kind == "number":
            numbers: Any = pd.Series(pd.to_numeric(values), index=values.index, dtype=float)
            if np.isinf(numbers).any():
                raise ValueError("an infinite value")
            return numbers
        if column.kind == "flag":
            return values.map(_flag).astype(bool)
    except (TypeError, ValueError) as error:
        raise invalid(f"{column.name}: {error}", f"a column of kind {column.kind}", "correct it", name) from None
    texts = values.astype(object).where(values.notna(), "").astype(str).str.strip()
    odd = [t for t in texts.unique() if len(t) > _LONGEST or not is_plain(t) or (not t and column.kind == "label")]
    if odd:
        found = f"{column.name}: {ascii(odd[0])[:80]}" if odd[0] else f"{column.name}: empty"
        raise invalid(
            found, f"one line of {'1' if column.kind == 'label' else '0'} to {_LONGEST} characters", "correct it", name
        )
    return texts


def _flag(value: Any) -> bool:
    text = str(value).strip().lower()
    if text in ("true", "yes", "1", "1.0"):
        return True
    if text in ("false", "no", "0", "0.0"):
        return False
    raise ValueError(f"{value!r} is neither true nor false")


def _check_visits(visits: Any) -> None:
    if not len(visits):
        raise invalid("no visit", "one at least", "put visits into the study", "visits")
    by_person = visits.groupby("subject", sort=False)
    if len(odd := by_person["group"].nunique().loc[lambda n: n > 1]):
        raise invalid(f"subject {odd.index[0]} in {odd.iloc[0]} groups", "one group per person", "correct it", "visits")
    excluded = visits[~visits["included"]]
    if (bare := excluded["reason"] == "").any():
        raise invalid(
            f"{_row(excluded, bare, KEYS['visits'])} does not count, without a reason", "a reason", "write it", "visits"
        )
    counted = visits[visits["included"]]
    if (twice := counted.duplicated(["subject", "role"])).any():
        raise invalid(
            f"{_row(counted, twice, ('subject', 'role'))} twice among the visits that count",
            "each role once per person",
            "exclude one of them with the reason, or give it another role",
            "visits",
        )
    first = counted[counted["role"].isin(FIRST_ROLES)].groupby("subject")["days"].max()
    others = counted[~counted["role"].isin(FIRST_ROLES)]
    if (late := others["days"] < others["subject"].map(first).astype(float)).any():
        raise invalid(
            f"{_row(others, late, ('subject', 'visit', 'role'))} before the visit {' or '.join(FIRST_ROLES)}",
            "days that fit the roles",
            "correct role or date",
            "visits",
        )


def _check_units(frame: Any, name: str, what: str) -> None:
    units = frame.groupby(what, sort=False)["unit"].nunique()
    if len(odd := units[units > 1]):
        raise invalid(f"{what} {odd.index[0]} in {odd.iloc[0]} units", "one unit", "convert the values", name)


def _check_scores(scores: Any, instruments: Any) -> None:
    table = instruments.set_index("instrument")
    if (odd := ~scores["instrument"].isin(table.index)).any():
        raise invalid(
            f"instrument {scores.loc[odd, 'instrument'].iloc[0]!r}", "a row of instruments", "add its row", "scores"
        )
    if (table["low"] >= table["high"]).any() or (table["mic"] <= 0).any():
        raise invalid(
            "a range whose low is not below its high, or a minimal important change that is not positive",
            "low < high, mic > 0",
            "correct the row",
            "instruments",
        )
    for text in table["classes"]:
        classes_of(text)
    for text in table["mic_classes"]:
        minimal_change_at(0.0, None, text)
    low, high = (scores["instrument"].map(table[c]).astype(float) for c in ("low", "high"))
    if (outside := (scores["value"] < low) | (scores["value"] > high)).any():
        row = scores[outside].iloc[0]
        raise invalid(
            f"{row['instrument']} {row['value']:g} of {row['subject']}, {row['visit']}",
            f"{low[outside].iloc[0]:g} to {high[outside].iloc[0]:g}",
            "correct the score at its source",
            "scores",
        )


def classes_of(text: str) -> list[tuple[float, str]]:
    """Parse the classes of an instrument, lowest first: (lowest value, name). Raises `PblError` STUDY_INVALID."""
    found = []
    for part in filter(None, (p.strip() for p in text.split(";"))):
        number, _, word = part.partition(" ")
        try:
            found.append((float(number), word.strip() or number))
        except ValueError:
            raise invalid(
                f"classes {text!r}", "such as: 0 high risk; 21 low risk", "correct it", "instruments"
            ) from None
    if [v for v, _ in found] != sorted({v for v, _ in found}):
        raise invalid(f"classes {text!r}", "lowest values that increase", "put them in order", "instruments")
    return found


def minimal_change_at(before: float, change: float | None, classes: str) -> float | None:
    """Minimal important change of a score that was `before`, in its unit; None if there is none.

    Raises `PblError` STUDY_INVALID: `classes` that are not positive numbers by increasing values.

    Parameters
    ----------
    change
        The one of all values, if any.
    classes
        Changes by the lowest value before, such as "0 3; 12 2; 15 1", which replace `change`; or "".
    """
    for lowest, text in classes_of(classes):
        try:
            least = float(text)
        except ValueError:
            least = np.nan
        if not least > 0:
            raise invalid(f"minimal change {text!r}", "such as: 0 3; 12 2; 15 1", "correct it", "instruments")
        if before >= lowest:
            change = least
    return change


def _row(frame: Any, where: Any, key: tuple[str, ...]) -> str:
    row = frame[np.asarray(where)].iloc[0]
    return ", ".join(f"{k} {row[k]}" for k in key)
