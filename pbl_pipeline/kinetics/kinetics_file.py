"""Kinetics as files: `kinetics.json` of a visit and `<name>.kinetics.npz` of each trial (docs/files.md)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.files import check_numbers, load_npz, texts_of
from pbl_pipeline.gait import REPORT_PERCENT
from pbl_pipeline.gait.metrics_file import curve_table, known_curves
from pbl_pipeline.paramset import structured
from pbl_pipeline.records import plain
from pbl_pipeline.results import CycleKinetics, Kinetics, Series, TrialKinetics

from .joints import MOMENTS
from .types import CURVES

_SERIES = tuple(f.name for f in dataclasses.fields(Series))
_OF_CYCLES = ("cycle_no", "names", "percent", "curve", "curve_sd")


def content_of(kinetics: Kinetics) -> dict[str, Any]:
    """Return the content of kinetics.json."""
    own = ("status", "code", "reason", "mass_kg", "residual_bw", "method", "params_hash")
    return {
        **_own(kinetics, *own),
        "measures": {name: m.to_dict() for name, m in kinetics.measures.items()},
        "reasons": dict(kinetics.reasons),
        "qc": plain(kinetics.qc),
        "trials": [
            {**_own(t, "name", "status", "code", "reason"), "cycles": [_cycle(c) for c in t.cycles]}
            for t in kinetics.trials
        ],
    }


def _cycle(cycle: CycleKinetics) -> dict[str, Any]:
    measures = {name: round(v, 5) for name, v in cycle.measures.items()}
    return {**_own(cycle, "number", "side", "used"), "measures": measures, "missing": cycle.missing}


def _own(found: Any, *names: str) -> dict[str, Any]:
    return {name: getattr(found, name) for name in names}


def save_content(kinetics: Kinetics, path: Path) -> None:
    """Write kinetics.json."""
    path.write_text(json.dumps(content_of(kinetics), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def kinetics_of(content: Mapping[str, Any], arrays: Mapping[str, tuple[Series | None, Mapping]]) -> Kinetics:
    """Return the kinetics of a kinetics.json. `arrays`: by trial, what `load_arrays` returned.

    Raises KeyError, TypeError, ValueError, AttributeError where the content is not that of a kinetics.json.
    """
    trials = []
    for told in content["trials"]:
        series, curves = arrays.get(told["name"], (None, {}))
        cycles = [{**c, **curves.get(c["number"], {})} for c in told["cycles"]]
        trials.append(dataclasses.replace(structured({**told, "cycles": cycles}, TrialKinetics), series=series))
    measures = {name: {k: v for k, v in told.items() if k != "interval"} for name, told in content["measures"].items()}
    found = structured({**content, "measures": measures, "trials": ()}, Kinetics)
    return dataclasses.replace(found, trials=tuple(trials))


def save_arrays(trial: TrialKinetics, path: Path) -> None:
    """Write a trial's forces and moments over time, and its cycles' curves, to one .npz (float32, time_s float64)."""
    over_time = {}
    if trial.series is not None:
        over_time = {n: np.asarray(getattr(trial.series, n), float if n == "time_s" else np.float32) for n in _SERIES}
    np.savez_compressed(
        path,
        allow_pickle=False,
        cycle_no=np.asarray([c.number for c in trial.cycles], np.int16),
        names=np.asarray(CURVES, dtype=str),
        percent=np.asarray(REPORT_PERCENT, np.float32),
        curve=curve_table([c.curves for c in trial.cycles], CURVES),
        curve_sd=curve_table([c.curves_sd for c in trial.cycles], CURVES),
        **over_time,
    )


def load_arrays(path: Path) -> tuple[Series | None, dict[int, dict[str, Any]]]:
    """Return forces and moments over time, and by number of the cycle its `curves` and `curves_sd`.

    Raises `PblError` FILE_MISSING, FILE_FORMAT.
    """
    data = load_npz(path, _SERIES, needed=_OF_CYCLES)
    n, names = data["cycle_no"].size, texts_of(path, data, "names")
    curves = {k: (n, len(names), None) for k in ("curve", "curve_sd")}
    check_numbers(path, data, curves)
    series = None
    if set(_SERIES) <= data.keys():
        t, j = data["time_s"].size, len(MOMENTS)
        shapes: dict[str, tuple[int | None, ...]] = {
            "time_s": (t,),
            "force_bw": (t, 2, 3),
            "centre_m": (t, 2, 3),
            "moment_nm_per_kg": (t, 2, j),
            "power_w_per_kg": (t, 2, j),
            "residual_bw": (t, 3),
            "residual_nm_per_kg": (t, 3),
            "centre_of_mass_m": (t, 3),
            "ahead": (t, 2),
            "knee_adduction_nm_per_kg": (t, 2),
        }
        check_numbers(path, data, shapes)
        series = Series(**{name: np.asarray(data[name], float) for name in _SERIES})
    rows = zip(data["cycle_no"].ravel(), data["curve"], data["curve_sd"], strict=True)
    return series, {int(i): {"curves": known_curves(names, a), "curves_sd": known_curves(names, b)} for i, a, b in rows}
