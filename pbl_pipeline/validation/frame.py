"""Errors of many trials as one table: a row per trial and joint."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import pandas as pd

from .compare import JointError, KinematicErrors
from .reference import CONTRALATERAL, IPSILATERAL, LATERAL, split_side

STATIC, HANDHELD, SEVERAL = "static", "handheld", "several"
_JOINT_FIELDS = tuple(f.name for f in dataclasses.fields(JointError))
_TRIAL_FIELDS = ("lag_s", "rte_m", "residual_2d_px", "residual_3d_cm")
#: The columns that say which trial a row is of.
KEY = ("dataset", "subject", "population", "activity", "camera", "trial", "detector", "solver")
COLUMNS = (
    *KEY,
    "view",
    "joint",
    "side",
    *(f for f in _JOINT_FIELDS if f != "joint"),
    *_TRIAL_FIELDS,
    "trial_median_abs_deg",
)


@dataclasses.dataclass(frozen=True)
class TrialErrors:
    """The errors of one trial and what the trial was. `camera`: "static", "handheld" or "several"."""

    errors: KinematicErrors
    dataset: str
    subject: str
    population: str
    activity: str
    camera: str
    trial: str
    detector: str = ""
    solver: str = ""


def error_frame(rows: Iterable[TrialErrors]) -> pd.DataFrame:
    """One row per trial and joint; no rows give an empty frame with the same columns (`COLUMNS`).

    `joint` is without its side (`hip_flexion`), `side` is `r`, `l` or ``""``. `view` is the side's own; a joint of the
    middle seen from either side has "lateral". Several cameras have no single view (``""``).
    `trial_median_abs_deg` is the trial's error over all joints of `JOINTS_PAPER` (`KinematicErrors.median_abs_deg`).
    """
    out = []
    for row in rows:
        key = {name: getattr(row, name) for name in KEY}
        trial = {name: getattr(row.errors, name) for name in _TRIAL_FIELDS}
        trial["trial_median_abs_deg"] = row.errors.median_abs_deg
        for error in row.errors.joints:
            joint, side = split_side(error.joint)
            values = {f: getattr(error, f) for f in _JOINT_FIELDS if f != "joint"}
            view = _view(row, side)
            out.append({**key, "view": view, "joint": joint, "side": side, **values, **trial})
    return pd.DataFrame(out, columns=list(COLUMNS))


def _view(row: TrialErrors, side: str) -> str:
    if row.camera == SEVERAL:
        return ""
    view = row.errors.view["left" if side == "l" else "right"]
    return LATERAL if not side and view in (IPSILATERAL, CONTRALATERAL) else view
