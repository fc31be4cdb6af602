"""The curves of a trial's gait cycles as one .npz: `<name>.cycles.npz` beside a fit, and the same in the store."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers, load_npz, texts_of

from ._cycles import REPORT_PERCENT, GaitCycle


class Curves(NamedTuple):
    """Known curves of one cycle and their standard deviations by name, each (P,) degrees, and the name of the model of
    their error (`GaitCycle.error_model`)."""

    deg: dict[str, np.ndarray]
    sd_deg: dict[str, np.ndarray]
    error_model: str = ""


def save_curves(cycles: Sequence[GaitCycle], path: Path) -> None:
    """Write the curves of all cycles and their standard deviations to one .npz (float32); unknown curves are NaN."""
    percent = np.asarray(REPORT_PERCENT, np.float32)
    names = sorted({name for c in cycles for name in c.curves})
    unknown = np.full(len(percent), np.nan, np.float32)

    def table(of: Callable[[GaitCycle], Mapping[str, np.ndarray]]) -> np.ndarray:
        rows = [[of(c).get(name, unknown) for name in names] for c in cycles]
        return np.asarray(rows, np.float32).reshape(len(cycles), len(names), len(percent))

    np.savez_compressed(
        path,
        cycle_no=np.asarray([c.number for c in cycles], np.int16),
        names=np.asarray(names, dtype=str),
        percent=percent,
        curve=table(lambda c: c.curves),
        curve_sd=table(lambda c: c.curves_sd),
        error_model=np.asarray([c.error_model for c in cycles], dtype=str),
    )


def load_curves(path: Path) -> dict[int, Curves]:
    """Return the curves by cycle number. Raises `PblError` FILE_MISSING, FILE_FORMAT."""
    data = load_npz(path, ("cycle_no", "names", "curve", "curve_sd", "error_model"))
    if missing := {"cycle_no", "names", "curve"} - data.keys():
        raise PblError(
            "FILE_FORMAT",
            found=f"no {', '.join(sorted(missing))}",
            expected="curves of gait cycles as `pbl run` writes them",
            next_step="`pbl gait *.fit.npz --out metrics.json` writes them again",
            key=str(path),
        )
    names = texts_of(path, data, "names")
    curves = data["curve"]
    sd = data.get("curve_sd", np.full_like(curves, np.nan))  # absent in files of version 0.1 and before
    shape = (data["cycle_no"].size, len(names), None)
    check_numbers(path, {"curve": curves, "curve_sd": sd}, {"curve": shape, "curve_sd": shape})

    errors = texts_of(path, data, "error_model") if "error_model" in data else [""] * shape[0]  # since version 0.2

    def known(rows: np.ndarray) -> dict[str, np.ndarray]:
        return {name: curve for name, curve in zip(names, rows, strict=True) if np.isfinite(curve).all()}

    rows = zip(data["cycle_no"].ravel(), curves, sd, errors, strict=True)
    return {int(n): Curves(known(a), known(b), error) for n, a, b, error in rows}
