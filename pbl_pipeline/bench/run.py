"""Runs each case in separate processes and gathers the figures."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import subprocess
import sys
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
