"""Runs cases, each in processes of its own, and gathers their figures."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError

from .plan import Case, Data

Row = dict[str, Any]


def run_cases(cases: Sequence[Case], timeout_s: float, note: Callable[[str], None] = lambda _: None) -> Iterator[Row]:
    """One row per case, as soon as it is done: the case itself and the figures of both stages; `error` where it failed.

    Each case starts with an empty folder for compiled programs: stage "cold" fills it, stage "warm" finds it. `note` is
    told what is done next.

    Raises
    ------
    PblError
        INTERNAL: the data could not be made.
    """
    with tempfile.TemporaryDirectory(prefix="pbl-bench-") as name:
        root = Path(name)
        for number, case in enumerate(cases):
            note(f"{number + 1}/{len(cases)} {label(case)}")
            folder = _data_folder(root, case.data)
            cache = root / f"cache{number}"
            cold = _stage(case, "cold", folder, cache, root, timeout_s)
            warm = {} if "error" in cold else _stage(case, "warm", folder, cache, root, timeout_s)
            yield _row(case, cold, warm)


def label(case: Case) -> str:
    """A case in words."""
    data = case.data
    parts = [case.solver, f"{data.n_trials} trial{'s' * (data.n_trials > 1)} x {data.n_frames} frames", data.motion]
    parts += [f"batch {case.batch}"] * (case.batch > 1) + [data.trouble] * (data.trouble != "none")
    return ", ".join(parts)


def _row(case: Case, cold: Row, warm: Row) -> Row:
    row = {"label": label(case), **dataclasses.asdict(case), **warm}
    # How long a refusal took is no figure of a fit.
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


def _data_folder(root: Path, data: Data) -> Path:
    folder = root / "data" / data.key
    if not folder.exists():
        command = [sys.executable, "-m", "pbl_pipeline.bench._data", str(folder), json.dumps(dataclasses.asdict(data))]
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


def _stage(case: Case, stage: str, folder: Path, cache: Path, root: Path, timeout_s: float) -> Row:
    result = root / "result.json"
    result.unlink(missing_ok=True)
    spec = {
        "case": dataclasses.asdict(case),
        "folder": str(folder),
        "result": str(result),
        "stage": stage,
        "started": time.time(),
    }
    command = [sys.executable, "-m", "pbl_pipeline.bench._case", json.dumps(spec)]
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return {"error": f"over {timeout_s:g} s"}
    if result.exists():
        # NaN is no JSON: what is not known is null in the file that people read.
        return json.loads(result.read_text(encoding="utf-8"), parse_constant=lambda _: None)
    return {"error": f"died, exit {done.returncode}", "error_text": done.stderr[-2000:]}
