"""Results as rows: the fields of a frozen dataclass declare their columns, and rows follow from them.

    @record
    class GaitEvent:
        time_s: float = column("event_time", "(s) time of the trial")

`definition` returns the lines of a DataJoint table, `to_row` the values of one record, `from_row` the record of a row.
Names, types and comments are DataJoint's; "{}" in a name or a comment stands for the prefix of the table, where several
tables hold the same class. The columns of a field that is a declared dataclass itself stand in the same row.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from pbl_pipeline.names import check_label, shortened
from pbl_pipeline.paramset import structured

T = TypeVar("T")
F = TypeVar("F", bound=Callable)


class Column(NamedTuple):
    """Column of a field."""

    name: str
    comment: str = ""  # (unit) meaning
    type: str = "float64"  # of DataJoint, such as varchar(64)
    null: bool = False  # NULL for None, "" and what is not finite; always so where the field may be None
    old: str | None = None  # value in the rows that were there when it was added
    # Text in words, which is shortened; "tag": of a file, cut without an ellipsis. Of a name `to_row` raises.
    cut: bool | str = False
    key: bool = False  # in the primary key of the table
    digits: int | None = None  # decimals of the numbers of a json column
    meaning: str = ""  # in words, for files
    before: str = ""  # field before whose column it stands; "": in the order of the fields, "(end)": after all


class Declared(NamedTuple):
    """A column with the fields that lead to its value, and how that is written to a row and read from it."""

    path: tuple[str, ...]
    column: Column
    write: Callable[[Any], Any]
    read: Callable[[Any], Any] | None  # None: a property, which is not read
    missing: Any = None  # value of the field for NULL


def column(
    name: str,
    comment: str = "",
    type: str = "float64",
    *,
    default: Any = dataclasses.MISSING,
    default_factory: Any = dataclasses.MISSING,
    **how: Any,
) -> Any:
    """Return a field of a dataclass with a `Column`; `how`: its other attributes."""
    own = {"column": Column(name, comment, type, **how)}
    return dataclasses.field(default=default, default_factory=default_factory, metadata=own)


@typing.overload
@typing.dataclass_transform(frozen_default=True, field_specifiers=(column, dataclasses.field))
def record(cls: type[T], /) -> type[T]: ...
@typing.overload
@typing.dataclass_transform(frozen_default=True, field_specifiers=(column, dataclasses.field))
def record(*, kw_only: bool) -> Callable[[type[T]], type[T]]: ...
def record(cls: Any = None, /, **how: Any) -> Any:
    """Decorate a frozen dataclass with columns, `how` as for `dataclasses.dataclass`; type checkers know `column`."""
    return dataclasses.dataclass(cls, frozen=True, **how)


def stored(name: str, comment: str = "", type: str = "float64", **how: Any) -> Callable[[F], F]:
    """Decorate the function of a property that has a column too, which is written and not read."""

    def mark(function: F) -> F:
        function.__dict__["column"] = Column(name, comment, type, **how)
        return function

    return mark


@functools.cache
def declared(cls: type) -> tuple[Declared, ...]:
    """Return the columns of a class in order."""
    found: list[Declared] = []
    for field in dataclasses.fields(cls):
        kind = _hints(cls)[field.name]
        if own := field.metadata.get("column"):
            own = own._replace(null=own.null or isinstance(kind, types.UnionType))
            found.append(Declared((field.name,), own, _writer(own), *_reader(kind)))
        elif dataclasses.is_dataclass(kind):
            found += [d._replace(path=(field.name, *d.path)) for d in declared(typing.cast("type", kind))]
    for name, member in (item for base in reversed(cls.__mro__) for item in vars(base).items()):
        if isinstance(member, property) and (own := getattr(member.fget, "column", None)):
            found.append(Declared((name,), own, _writer(own), None))
    for d in [d for d in found if len(d.path) == 1 and d.column.before]:
        found.remove(d)
        at = next((i for i, other in enumerate(found) if other.path[0] == d.column.before), len(found))
        found.insert(at, d)
    return tuple(found)


def definition(cls: type, prefix: str = "", without: Collection[str] = (), only: Collection[str] = ()) -> str:
    """Return the lines of a DataJoint definition for the columns of a class; those of the key end with "---".

    `without`, `only`: names of fields that this table does not have, and that are asked for.
    """
    own = _picked(cls, without, only)
    keys, values = ([_line(c, prefix) for c in own if c.key == key] for key in (True, False))
    return "\n".join([*keys, "---", *values] if keys else values)


def names(cls: type, prefix: str = "", without: Collection[str] = (), only: Collection[str] = ()) -> list[str]:
    """Return the names of the columns of a class, as `to_row` writes them; `without`, `only` as in `definition`."""
    return [c.name.format(prefix) for c in _picked(cls, without, only)]


def _picked(cls: type, without: Collection[str], only: Collection[str]) -> list[Column]:
    return [d.column for d in declared(cls) if d.path[0] not in without and (not only or d.path[0] in only)]


def meanings(cls: type) -> dict[str, str]:
    """Return field -> meaning in words, of those fields that state one, in their order."""
    columns = {f.name: f.metadata["column"] for f in dataclasses.fields(cls) if "column" in f.metadata}
    return {name: c.meaning for name, c in columns.items() if c.meaning}


def _line(c: Column, prefix: str) -> str:
    default = "=null" if c.null else "" if c.old is None else f"='{c.old}'"
    comment = f"  # {c.comment.format(prefix)}" if c.comment else ""
    return f"{c.name.format(prefix)}{default} : {c.type}{comment}"


def to_row(record: Any, prefix: str = "", without: Collection[str] = ()) -> dict[str, Any]:
    """Return the values of a record by column, numbers as plain Python's; of a class those of an unknown record.

    Raises `PblError` USAGE for a name that is longer than its column, or is not one plain line.
    """
    row, unknown = {}, isinstance(record, type)
    for path, c, write, _, missing in declared(record if unknown else type(record)):
        if path[0] not in without:
            value = missing if unknown else functools.reduce(getattr, path, record)
            row[c.name.format(prefix) if prefix else c.name] = write(value)
    return row


def from_row(cls: type[T], row: Mapping[str, Any], prefix: str = "", **others: Any) -> T:
    """Return the record of a row.

    Parameters
    ----------
    row
        Values by column. A field whose column is not there keeps its default: a table may hold fewer of them.
    others
        Values of the fields without a column, or instead of its value.
    """
    own, nested = dict[str, Any](), dict[str, dict[str, Any]]()
    for path, c, _, read, missing in declared(cls):
        name = c.name.format(prefix) if prefix else c.name
        if read is not None and name in row:
            group = own if len(path) == 1 else nested.setdefault(path[0], {})
            value = row[name]
            group[path[-1]] = missing if value is None else read(value)
    return cls(**own | {name: _hints(cls)[name](**of) for name, of in nested.items()} | others)


def from_json(cls: type[T], values: Mapping[str, Any], **others: Any) -> T:
    """Return the record of JSON that `plain` made of its fields; `others`: fields that stand elsewhere.

    Raises `ValueError` as `paramset.structured`, TypeError, AttributeError.
    """
    own = dict(values)
    for path, c, _, read, missing in declared(cls):
        value = own.get(path[0], "")
        if value is None and c.null:
            own[path[0]] = missing
        elif isinstance(value, Mapping) and read is not None and len(path) == 1:
            own[path[0]] = read(value)
    return structured({**own, **others}, cls)


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _reader(kind: Any) -> tuple[Callable[[Any], Any], Any]:
    """Return the function that reads a field, and what NULL means there: None if it may be that, else NaN, 0 or ""."""
    if kind is np.ndarray:
        return np.asarray, None
    if kind == dict[int, float]:
        return lambda stored: {int(k): math.nan if v is None else float(v) for k, v in stored.items()}, None
    optional = isinstance(kind, types.UnionType)
    if optional:
        kind = next(a for a in typing.get_args(kind) if a is not type(None))
    kind = typing.get_origin(kind) or kind
    return kind, None if optional else math.nan if kind is float else kind()


def number(value: Any) -> float | None:
    """Return a float for a nullable column: None if the value is missing or not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def plain(value: Any, digits: int | None = None) -> Any:
    """Return a value for JSON: records and mappings as dicts, tuples and arrays as lists, NaN and infinity as None.

    digits: decimals of floats, None for all.
    """
    if dataclasses.is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): plain(v, digits) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v, digits) for v in value]
    if not isinstance(value, float):
        return value
    return None if not math.isfinite(value) else value if digits is None else round(value, digits)


def _writer(c: Column) -> Callable[[Any], Any]:
    """Return the function that makes the value of a column."""
    if c.type == "json":
        return functools.partial(plain, digits=c.digits)
    if c.type.startswith("float"):
        return number if c.null else float
    kind: Callable[[Any], Any] = {"int": int, "bool": bool}.get(c.type.rstrip("0123456789"), _same)
    if c.type.startswith("varchar"):
        longest, name = int(c.type[8:-1]), c.name.format("").strip("_")
        cut = (lambda text: str(text)[:longest]) if c.cut == "tag" else lambda text: shortened(str(text), longest)
        kind = cut if c.cut else functools.partial(_name, name, longest)
    return (lambda value: None if value is None or value == "" else kind(value)) if c.null else kind


def _name(column: str, longest: int, value: object) -> str:
    text = str(value)
    check_label(column, text, longest)
    return text


def _same(value: T) -> T:
    return value
