"""Runs each case in separate processes, gathers the figures and prints them as text."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.temporary import new_folder

from .cases import Case, Data

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Programs:
    """Modules that make the data of a case and that measure it, each in a separate process."""

    data: str = "pbl_pipeline.bench.data"
    case: str = "pbl_pipeline.bench.case"


def run_cases(
    cases: Sequence[Case],
    timeout_s: float,
    note: Callable[[str], None] = lambda _: None,
    programs: Programs = Programs(),
) -> Iterator[Row]:
    """Return a row for each case as soon as it is done: the case and the figures of both stages, or `error`.

    Stage "cold" is a new process with an empty cache of compiled programs, which stage "warm" finds. `note` is called
    with what is done next.

    Raises `PblError` INTERNAL: the data could not be made.
    """
    with new_folder() as root:
        for number, case in enumerate(cases):
            note(f"{number + 1}/{len(cases)} {case.label}")
            folder = _data_folder(root, case.data, programs.data)
            stage = functools.partial(_stage, programs.case, case, folder, root / f"cache{number}", root, timeout_s)
            cold = stage("cold")
            warm = {} if "error" in cold else stage("warm")
            yield _row(case, cold, warm)


def _row(case: Case, cold: Row, warm: Row) -> Row:
    row = {"label": case.label, **dataclasses.asdict(case), **warm}
    # The time of a refused fit is not the time of a fit.
    row["cold_seconds"] = None if "error" in cold else cold.get("first_seconds")
    row["start_seconds"] = row.pop("first_seconds", None)
    for key in ("host_bytes", "device_bytes"):
        row[key] = max((v for v in (cold.get(key), warm.get(key)) if v is not None), default=None)
        row[f"warm_{key}"] = warm.get(key)
    for key in ("error", "error_text", "device", "cores", "jax"):
        value = cold.get(key) or warm.get(key)
        if value:
            row[key] = value
    return row


def _data_folder(root: Path, data: Data, program: str) -> Path:
    folder = root / "data" / data.key
    if not folder.exists():
        command = [sys.executable, "-m", program, str(folder), json.dumps(dataclasses.asdict(data))]
        # Off the accelerator: what is measured later should find it free.
        made = subprocess.run(command, env=os.environ | {"JAX_PLATFORMS": "cpu"}, capture_output=True, text=True)
        if made.returncode != 0:
            raise PblError(
                "INTERNAL",
                found=made.stderr.strip().splitlines()[-1] if made.stderr.strip() else f"exit {made.returncode}",
                expected="the benchmark's data",
                next_step="report the whole text",
                key=data,
            )
    return folder


def _stage(program: str, case: Case, folder: Path, cache: Path, root: Path, timeout_s: float, stage: str) -> Row:
    result = root / "result.json"
    result.unlink(missing_ok=True)
    spec = {
        "case": dataclasses.asdict(case),
        "folder": str(folder),
        "result": str(result),
        "stage": stage,
        "started": time.time(),
    }
    return measured(program, spec, timeout_s, {"JAX_COMPILATION_CACHE_DIR": str(cache)})


def measured(program: str, spec: Row, timeout_s: float, variables: Mapping[str, str] = {}) -> Row:
    """Return what a program measured in a separate process and wrote to the file `spec["result"]`, or `error`.

    `variables`: of its environment, beside those of this process.
    """
    command = [sys.executable, "-m", program, json.dumps(spec)]
    try:
        done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return {"error": f"over {timeout_s:g} s"}
    result = Path(spec["result"])
    if result.exists():
        # JSON has no NaN: unknown values are null in the file.
        return json.loads(result.read_text(encoding="utf-8"), parse_constant=lambda _: None)
    return {"error": f"died, exit {done.returncode}", "error_text": done.stderr[-2000:]}


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
