"""The figures of a benchmark as text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .run import Row

Column = tuple[str, Callable[[Row], str]]


def table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """Return aligned columns, the first to the left, the others to the right; a row that failed ends with its code."""
    cells = [[title for title, _ in columns], *([get(r) for _, get in columns] for r in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    lines = []
    for line, row in zip(cells, [None, *rows], strict=True):
        text = "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))
        )
        lines.append(text + (f"  {row['error']}" if row and "error" in row else ""))
    lines.insert(1, "-" * (sum(widths) + 2 * (len(widths) - 1)))
    return "\n".join(x.rstrip() for x in lines)


def number(value: Any, digits: int = 2) -> str:
    """A number with a few significant digits, `-` where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.{digits if abs(value) < 100 else 0}f}"


def accuracy(row: Row, key: str) -> float | None:
    """A mean over the trials of a row, or None."""
    value = (row.get("accuracy") or {}).get(key)
    return value if value is not None and math.isfinite(value) else None


def method_name(row: Row) -> str:
    """Name of the fit method of a row, of the file where it was one."""
    return Path(row["method"]).stem


def rate(row: Row) -> float | None:
    """Sessions a second of the warm runs, or None."""
    return row["batch"] / row["warm_seconds"] if row.get("warm_seconds") else None


def mega(value: float | None) -> str:
    """Bytes as millions, `-` where there are none."""
    return "-" if value is None else f"{value / 1e6:,.0f}"


#: Columns of every table of fits: times and memory, then errors.
TIMES: list[Column] = [
    ("cold s", lambda r: number(r["cold_seconds"])),
    ("start s", lambda r: number(r["start_seconds"])),
    ("warm s", lambda r: number(r.get("warm_seconds"), 3)),
    ("sessions/s", lambda r: number(rate(r))),
    ("host MB", lambda r: mega(r["host_bytes"])),
    ("device MB", lambda r: mega(r["device_bytes"])),
]
ERRORS: list[Column] = [
    ("all deg", lambda r: number(accuracy(r, "all_deg"))),
    ("main deg", lambda r: number(accuracy(r, "main_deg"))),
]
COLUMNS: list[Column] = [
    ("method", method_name),
    ("trials", lambda r: str(r["data"]["n_trials"])),
    ("batch", lambda r: str(r["batch"])),
    *TIMES,
    *ERRORS,
]


def fit_text(rows: Sequence[Row]) -> str:
    """Return the table of the fit, failed checks and errors by row, and what the columns mean."""
    parts = [table(rows, COLUMNS), *filter(None, map(notes, rows))]
    return "\n\n".join([*parts, meaning(rows)])


def notes(row: Row) -> str:
    """Return what a row has to say beside its figures: checks that did not pass, and its error; "" for nothing."""
    found = [f"{c}: {o}" for c, o in (row.get("checks") or {}).items()]
    if row.get("batch_difference_rad") is not None:
        found.append(f"largest difference to the session alone {row['batch_difference_rad']:.1e} rad")
    unknown = accuracy(row, "unknown_share") or 0
    if unknown > 0:
        found.append(f"without a result: {100 * unknown:.3g} % of the frames")
    if row.get("error_text"):
        found.append(str(row["error_text"]).strip())
    return f"{row['label']}\n  " + "\n  ".join(found) if found else ""


def meaning(rows: Sequence[Row], more: str = "") -> str:
    """Return what the columns mean, and the machine of the rows."""
    first = next((r for r in rows if "device" in r), None)
    where = f"{first['device']}, {first['cores']} cores, jax {first['jax']}. " if first else ""
    return textwrap.fill(
        f"{where}cold: empty cache, new process; start: cache on disk, new process; both from the start of the process "
        "to the first result. warm: same process, best. MB: peak of the process, compiling included, and on the "
        "device. all: mean over the paper's joints of the median absolute error of each in a trial, mean over trials "
        f"and people; main: hips, knees, ankles, lumbar. {more}".strip(),
        120,
    )
