"""Tables of columns with units, and writing them as CSV and Parquet.

Cells of text tables are rows of bytes, filled digit by digit for all numbers at once; bytes of value 0 are dropped at
the end. This is three times as fast as Python's formatting, which took most of the time of an export.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.csv_cells import quoted
from pbl_pipeline.extras import needed

#: From here on a double does not hold every digit, and Python formats the numbers.
_EXACT = 2.0**53


def number_cells(values: np.ndarray, decimals: int) -> np.ndarray:
    """(..., W) bytes of numbers, rounded to `decimals`; empty for NaN, -0 is 0."""
    values = np.asarray(values, float)
    known = np.isfinite(values)
    scaled = np.rint(np.where(known, values, 0.0) * 10.0**decimals)
    size = float(np.max(np.abs(scaled), initial=0.0))
    if size >= _EXACT:
        texts = [f"{v + 0.0:.{decimals}f}".encode() if np.isfinite(v) else b"" for v in values.flat]
        return text_cells(texts).reshape(*values.shape, -1)
    left = np.abs(scaled).astype(np.int32 if size < 2**31 else np.int64)
    n_digits = max(len(str(int(size))), decimals + 1)
    width = 1 + n_digits + (decimals > 0)
    cells = np.zeros((*values.shape, width), np.uint8)
    cells[..., 0] = np.where(scaled < 0, ord("-"), 0)
    at = width - 1
    for k in range(n_digits):
        if k == decimals and decimals:
            cells[..., at] = ord(".")
            at -= 1
        rest = left // 10
        digit = (left - 10 * rest + ord("0")).astype(np.uint8)
        cells[..., at] = digit if k <= decimals else np.where(left > 0, digit, 0)
        left, at = rest, at - 1
    cells[~known] = 0
    return cells


def text_cells(texts: Sequence[bytes]) -> np.ndarray:
    """(N, W) bytes of N texts without bytes of value 0; writable."""
    width = max(map(len, texts), default=0) or 1
    together = bytearray().join(t.ljust(width, b"\0") for t in texts)
    return np.frombuffer(together, np.uint8).reshape(len(texts), width)


def lines(blocks: Sequence[np.ndarray], separator: str) -> bytes:
    """The lines of a table. A block is a column of cells (N, W), or C columns (N, C, W)."""
    parts = []
    for block in blocks:
        cells = block if block.ndim == 3 else block[:, None]
        ends = np.full((*cells.shape[:2], 1), ord(separator), np.uint8)
        parts.append(np.concatenate([cells, ends], axis=2).reshape(len(cells), -1))
    table = np.concatenate(parts, axis=1)
    table[:, -1] = ord("\n")
    flat = table.ravel()
    return flat[flat != 0].tobytes()


@dataclasses.dataclass(frozen=True)
class Texts:
    """(N,) texts `texts[codes]` with few different ones. A categorical in Parquet, pandas and R."""

    codes: np.ndarray
    texts: tuple[str, ...]

    @classmethod
    def of(cls, values: Sequence[str]) -> Texts:
        texts = tuple(dict.fromkeys(values))
        place = {t: i for i, t in enumerate(texts)}
        return cls(np.array([place[v] for v in values], np.int32), texts)

    @classmethod
    def constant(cls, text: str, n: int) -> Texts:
        return cls(np.zeros(n, np.int32), (text,))

    def __len__(self) -> int:
        return len(self.codes)


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of a table."""

    name: str
    values: np.ndarray | Texts  # (N,) float with NaN for missing, int, bool or `Texts`
    unit: str
    meaning: str

    @property
    def kind(self) -> str:
        """ "text", "integer", "boolean" or "number"."""
        if isinstance(self.values, Texts):
            return "text"
        return {"i": "integer", "b": "boolean"}.get(self.values.dtype.kind, "number")


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of the same length; the name becomes that of the file."""

    name: str
    columns: tuple[Column, ...]

    def __len__(self) -> int:
        return len(self.columns[0].values)


def joined(parts: Sequence[Table]) -> Table:
    """Concatenate tables of the same name and columns. Columns that a part lacks are missing there."""
    if len(parts) == 1:
        return parts[0]
    named = {c.name: c for part in parts for c in part.columns}
    columns = []
    for name, like in named.items():
        pieces = [next((c.values for c in part.columns if c.name == name), None) for part in parts]
        columns.append(dataclasses.replace(like, values=_stacked(pieces, [len(p) for p in parts])))
    return Table(parts[0].name, tuple(columns))


def write_csv(table: Table, path: Path) -> None:
    """Write UTF-8 with commas and decimal points, a header of names, empty cells for missing values, true and false."""
    head = ",".join(_quoted(c.name) for c in table.columns) + "\n"
    # Neighbouring columns of one kind are formatted together.
    kinds = itertools.groupby(table.columns, lambda c: c.kind)
    parts = [block for kind, columns in kinds for block in _cells(kind, list(columns))]
    path.write_bytes(head.encode() + (lines(parts, ",") if len(table) else b""))


def write_parquet(table: Table, path: Path, about: Mapping[str, str]) -> None:
    """Write Parquet: missing numbers are null; each field's metadata has `unit` and `meaning`, the table's `about`.

    Raises `PblError` PACKAGE_MISSING without pyarrow.
    """
    pa: Any = needed("pyarrow", "writing Parquet files")
    parquet: Any = needed("pyarrow.parquet", "writing Parquet files")
    arrays = []
    for c in table.columns:
        if isinstance(c.values, Texts):
            arrays.append(
                pa.DictionaryArray.from_arrays(pa.array(c.values.codes), pa.array(c.values.texts, pa.string()))
            )
        else:
            arrays.append(pa.array(c.values, from_pandas=True))
    fields = [_field(pa, c.name, a.type, c.unit, c.meaning) for c, a in zip(table.columns, arrays, strict=True)]
    made = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=dict(about)))
    # Statistics double the size of few rows. A dictionary of numbers that hardly repeat adds a tenth of the size and a
    # fifth of the time.
    labels = [c.name for c in table.columns if isinstance(c.values, Texts)]
    parquet.write_table(made, path, compression="zstd", write_statistics=False, use_dictionary=labels)


@functools.lru_cache(1000)
def _field(pa: Any, name: str, kind: Any, unit: str, meaning: str) -> Any:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


def dictionary(tables: Sequence[Table]) -> Table:
    """Make the data dictionary: one row for each column of each table."""
    found = [(t.name, c) for t in tables for c in t.columns]
    texts = {
        "table": ([n for n, _ in found], "file without its ending"),
        "column": ([c.name for _, c in found], "name in the header"),
        "type": ([c.kind for _, c in found], "text, integer, boolean or number"),
        "unit": ([c.unit for _, c in found], "empty where there is none"),
        "meaning": ([c.meaning for _, c in found], "what it holds, and which direction is positive"),
    }
    return Table("data_dictionary", tuple(Column(k, Texts.of(v), "", m) for k, (v, m) in texts.items()))


def _stacked(pieces: Sequence[np.ndarray | Texts | None], lengths: Sequence[int]) -> np.ndarray | Texts:
    first = next(p for p in pieces if p is not None)
    if not isinstance(first, Texts):
        filled = [p if isinstance(p, np.ndarray) else np.full(n, np.nan) for p, n in zip(pieces, lengths, strict=True)]
        return np.concatenate(filled)
    texts: dict[str, int] = {}
    codes = []
    for piece, n in zip(pieces, lengths, strict=True):
        own = piece if isinstance(piece, Texts) else Texts.constant("", n)
        number = np.array([texts.setdefault(t, len(texts)) for t in own.texts], np.int32)
        codes.append(number[own.codes] if len(own) else np.zeros(0, np.int32))
    return Texts(np.concatenate(codes), tuple(texts))


def _cells(kind: str, columns: Sequence[Column]) -> list[np.ndarray]:
    if kind in ("number", "integer"):
        return [number_cells(np.stack([np.asarray(c.values) for c in columns], axis=1), 6 if kind == "number" else 0)]
    found = []
    for column in columns:
        values = column.values
        if not isinstance(values, Texts):
            values = Texts(values.astype(np.int32), ("false", "true"))
        found.append(text_cells([_quoted(t).encode() for t in values.texts])[values.codes])
    return found


def _quoted(text: str) -> str:
    text = quoted(text)
    return f'"{text.replace(chr(34), chr(34) * 2)}"' if any(c in text for c in ',"\n\r') else text
