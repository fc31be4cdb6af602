"""The figures of a benchmark as text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

from .run import Row

Column = tuple[str, Callable[[Row], str]]


def table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """Aligned columns, the first to the left and the others to the right; a row that failed ends with its code."""
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


def solver_name(row: Row) -> str:
    """The solver, and its number of steps where it is not the paper's."""
    return row["solver"] + (f" {row['adam_steps']:,} steps" if row.get("adam_steps") else "")


def rate(row: Row) -> float | None:
    return row["batch"] / row["warm_seconds"] if row.get("warm_seconds") else None


def mega(value: float | None) -> str:
    """Bytes as millions, `-` where there are none."""
    return "-" if value is None else f"{value / 1e6:,.0f}"


def _held(row: Row) -> float | None:
    return accuracy(row, "camera_deg") if row["data"]["motion"] == "handheld" else None


_TIMES: list[Column] = [
    ("cold s", lambda r: number(r["cold_seconds"])),
    ("start s", lambda r: number(r["start_seconds"])),
    ("warm s", lambda r: number(r.get("warm_seconds"), 3)),
]
_MEMORY: list[Column] = [
    ("host MB", lambda r: mega(r["host_bytes"])),
    ("device MB", lambda r: mega(r["device_bytes"])),
]
_ERRORS: list[Column] = [
    ("all deg", lambda r: number(accuracy(r, "all_deg"))),
    ("main deg", lambda r: number(accuracy(r, "main_deg"))),
    ("camera deg", lambda r: number(_held(r))),
    ("loss", lambda r: number(r.get("paper_loss"))),
]

COLUMNS: dict[str, list[Column]] = {
    "speed": [
        ("solver", solver_name),
        ("trials", lambda r: str(r["data"]["n_trials"])),
        ("camera", lambda r: r["data"]["motion"]),
        ("batch", lambda r: str(r["batch"])),
        *_TIMES,
        ("sessions/s", lambda r: number(rate(r))),
        *_MEMORY,
        *_ERRORS,
    ],
    "long": [
        ("solver", solver_name),
        ("camera", lambda r: r["data"]["motion"]),
        ("frames", lambda r: f"{r['data']['n_frames']:,}"),
        *_TIMES,
        *_MEMORY,
        *_ERRORS,
    ],
    "robust": [
        ("solver", solver_name),
        ("camera", lambda r: r["data"]["motion"]),
        ("trouble", lambda r: r["data"]["trouble"]),
        ("warm s", lambda r: number(r.get("warm_seconds"), 3)),
        *_ERRORS,
        ("sd all", lambda r: number(accuracy(r, "sd_all_deg"))),
        ("sd toe", lambda r: number(accuracy(r, "sd_affected_deg"))),
        ("sd in span", lambda r: number(accuracy(r, "sd_span_deg"))),
        ("sd outside", lambda r: number(accuracy(r, "sd_outside_deg"))),
        ("unknown in span", lambda r: _percent(accuracy(r, "unknown_share_span"))),
    ],
}

TITLES = {
    "speed": "The benchmark's trials: 300 frames at 30 Hz, 87 markers",
    "long": "One long walk: 87 markers at 30 Hz",
    "robust": "With trouble: 30 % outliers, a toe marker never seen, nothing seen from 4.5 to 5.5 s",
}


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.3g} %"


def text(rows: Sequence[Row]) -> str:
    """All tables, what the columns mean, failed checks and errors."""
    parts = []
    for section, columns in COLUMNS.items():
        own = [r for r in rows if r["section"] == section]
        if own:
            parts.append(f"{TITLES[section]}\n{table(own, columns)}")
    notes = [_note(r) for r in rows]
    parts += [n for n in notes if n]
    return "\n\n".join([*parts, _meaning(rows)])


def _note(row: Row) -> str:
    said = [f"{c}: {o}" for c, o in (row.get("checks") or {}).items()]
    if row.get("batch_difference_rad") is not None:
        said.append(f"largest difference to the session alone {row['batch_difference_rad']:.1e} rad")
    if accuracy(row, "clock_ms") is not None and row["data"]["motion"] == "handheld":
        said.append(f"clock offset wrong by {number(accuracy(row, 'clock_ms'), 1)} ms")
    if (accuracy(row, "unknown_share") or 0) > 0:
        said.append(f"without a result: {_percent(accuracy(row, 'unknown_share'))} of the frames")
    if row.get("error_text"):
        said.append(str(row["error_text"]).strip())
    return f"{row['label']}\n  " + "\n  ".join(said) if said else ""


def _meaning(rows: Sequence[Row]) -> str:
    first = next((r for r in rows if "device" in r), None)
    where = f"{first['device']}, {first['cores']} cores, jax {first['jax']}. " if first else ""
    short = any(r.get("adam_steps") for r in rows)
    words = (
        f"{where}cold: empty cache, new process; start: cache on disk, new process; both from the start of the process "
        "to the first result. warm: same process, best. MB: peak of the process, compiling included, and on the "
        "device. all: mean over the paper's joints of the median absolute error of each in a trial, mean over trials "
        "and seeds; main: hips, knees, ankles, lumbar. loss: the paper's objective."
        + (" Steps as shown, not the paper's: nothing is extrapolated." if short else "")
    )
    return textwrap.fill(words, 120)
