"""Errors of many trials as one frame, and the paper's tables from it: what cannot be filled stays empty, with n = 0."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.results import JointError
from pbl_pipeline.shipped import shipped_text

from .compare import KinematicErrors, median_niqr, niqr, normality_p
from .reference import (
    BACK,
    CONTRALATERAL,
    FRONT,
    IPSILATERAL,
    JOINTS_OPENCAP,
    LATERAL,
    MIXED,
    ROWS_PAPER,
    split_side,
)
from .write import Cell, Table, paper_cells

STATIC, HANDHELD, SEVERAL = "static", "handheld", "several"
_JOINT_FIELDS = tuple(f.name for f in dataclasses.fields(JointError) if f.name != "joint")
_TRIAL_FIELDS = ("lag_s", "rte_m", "residual_2d_px", "residual_3d_cm")
#: The columns that say which trial a row is of.
KEY = ("dataset", "subject", "population", "activity", "camera", "trial", "detector", "solver")
COLUMNS = (
    *KEY,
    "view",
    "joint",
    "side",
    *_JOINT_FIELDS,
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
            values = {f: getattr(error, f) for f in _JOINT_FIELDS}
            out.append({**key, "view": _view(row, side), "joint": joint, "side": side, **values, **trial})
    return pd.DataFrame(out, columns=list(COLUMNS))


def _view(row: TrialErrors, side: str) -> str:
    if row.camera == SEVERAL:
        return ""
    view = row.errors.view_left if side == "l" else row.errors.view_right
    return LATERAL if not side and view in (IPSILATERAL, CONTRALATERAL) else view


#: Level of significance (the paper, Statistics).
ALPHA = 0.05
MEDIAN, MEAN, RTE = "Median Absolute Error (deg)", "Mean Absolute Error (deg)", "RTE (cm)"
KNOWN, TRIALS = "Joints compared", "All"
_POPULATIONS = ("control", "neurological", "LLPU", "pediatric")
_ACTIVITIES = ("FSST", "standing", "TUG", "tandem", "walking")
_DATASETS = ("MMMC handheld", "MMMC static", "BML-MoVi static")
#: Titles, notes and decimals of the tables, and other names of the paper's populations and activities, small letters.
_TEXTS = json.loads(shipped_text("validation/data/table_texts.json"))
_OPENCAP = [split_side(j)[0] for j in JOINTS_OPENCAP]


def paper_tables(frame: pd.DataFrame) -> dict[str, Table]:
    """Return the tables of the paper's results on accuracy, filled from the rows of `error_frame`.

    Name -> table: `summary`, `joints_by_dataset`, `joints_by_population`, `by_population`, `by_activity`, `by_view`,
    `view_tests`, `residuals`, `normality`, and of our own `joint_measures` and `by_method`. Values are medians over
    trials (nIQR) unless the title says otherwise; n is the number of trials. An empty frame gives tables of empty
    cells.

    Raises `PblError` REFERENCE_INPUT where the frame lacks columns.
    """
    missing = [c for c in COLUMNS if c not in frame.columns]
    if missing:
        raise PblError(
            "REFERENCE_INPUT",
            found=f"a table of errors without the columns {', '.join(missing)}",
            expected="the columns of error_frame",
            next_step="make the table with pbl_pipeline.validation.error_frame",
        )
    rows = _prepared(frame)
    trials = _trials(rows)
    made = [
        _summary(trials),
        _joints("joints_by_dataset", rows, trials, "recording", _DATASETS),
        _joints("joints_by_population", rows, trials, "population", _POPULATIONS),
        _groups("by_population", trials, "population", _POPULATIONS),
        _groups("by_activity", trials, "activity", _ACTIVITIES),
        _by_view(rows),
        _view_tests(rows[rows["n"] > 0]),
        _residuals(trials),
        _normality(rows[rows["n"] > 0], trials),
        _measures(rows),
        _by_method(trials),
    ]
    return {t.name: t for t in made}


def _prepared(frame: pd.DataFrame) -> Any:
    """Return the rows with the paper's names, their comparison, and dataset and camera in one word."""
    paper = {name.lower(): name for name in (*_POPULATIONS, *_ACTIVITIES)} | _TEXTS["aliases"]
    rows = frame.copy()
    for column in ("population", "activity"):
        rows[column] = [paper.get(str(v).lower(), str(v)) for v in rows[column]]
    rows["recording"] = rows["dataset"].astype(str) + " " + rows["camera"].astype(str)
    # Missing values of the trial are part of what it is: a comparison without RTE is still one comparison.
    which = [*KEY, *_TRIAL_FIELDS, "trial_median_abs_deg"]
    rows["comparison"] = rows.groupby(which, dropna=False, sort=False).ngroup() if len(rows) else []
    return rows


def _trials(rows: Any) -> Any:
    """Return one row per comparison: its median and mean absolute error, RTE and how many joints it knows."""
    trials = rows.drop_duplicates("comparison").set_index("comparison", drop=False)
    measured = rows[rows["n"] > 0]
    of_opencap = measured[measured["joint"].isin(_OPENCAP)].groupby("comparison")
    of_paper = measured[measured["joint"].isin(ROWS_PAPER.values())].groupby("comparison")
    methods = zip(trials["detector"].astype(str), trials["solver"].astype(str), strict=True)
    return trials.assign(
        method=[", ".join(filter(None, names)) or "not named" for names in methods],
        median_deg=trials["trial_median_abs_deg"],
        mean_deg=of_opencap["mean_abs_deg"].mean(),
        rte_cm=100 * trials["rte_m"],
        joints=of_paper.size().reindex(trials.index, fill_value=0),
    )


def _summary(trials: Any) -> Table:
    rows = {MEDIAN: _over("median_deg"), MEAN: _over("mean_deg"), RTE: _over("rte_cm"), KNOWN: _over("joints")}
    return _table("summary", _cells(rows, _parts(trials, "recording", _DATASETS)))


def _joints(name: str, rows: Any, trials: Any, column: str, paper_columns: Sequence[str]) -> Table:
    of_joints = _cells(_OF_JOINTS, _parts(rows, column, paper_columns))
    of_trials = _cells({TRIALS: _over("median_deg")}, _parts(trials, column, paper_columns))
    return _table(name, of_joints | of_trials)


def _groups(name: str, trials: Any, column: str, paper_columns: Sequence[str]) -> Table:
    rows = {MEDIAN: _over("median_deg"), MEAN: _mean_over}
    if column == "population":
        rows[f"{MEAN.removesuffix(' (deg)')}, walking (deg)"] = lambda part: _mean_over(
            part[part["activity"] == "walking"]
        )
    return _table(name, _cells(rows, _parts(trials, column, paper_columns) | {TRIALS: trials}))


def _by_view(rows: Any) -> Table:
    views = (FRONT, BACK, IPSILATERAL, CONTRALATERAL, LATERAL, MIXED)
    return _table("by_view", _cells(_OF_JOINTS, _parts(rows[rows["view"] != ""], "view", views)))


def _view_tests(measured: Any) -> Table:
    from scipy import stats

    frontal = measured["view"].isin((FRONT, BACK))
    sagittal = measured["view"].isin((IPSILATERAL, CONTRALATERAL))
    cells = {}
    for label, better, worse, words in (
        ("Hip Flexion", sagittal, frontal, "sagittal against frontal"),
        ("Knee Flexion", sagittal, frontal, "sagittal against frontal"),
        ("Hip Adduction", frontal, sagittal, "frontal against sagittal"),
    ):
        of_joint = measured["joint"] == ROWS_PAPER[label]
        a, b = (measured.loc[of_joint & view, "median_abs_deg"].dropna().to_numpy(float) for view in (better, worse))
        n = measured.loc[of_joint & (better | worse), "comparison"].nunique()
        row = f"{label}: {words} views"
        difference = float(np.median(b) - np.median(a)) if len(a) and len(b) else math.nan
        test: Any = stats.mannwhitneyu(a, b, alternative="less") if min(len(a), len(b)) > 1 else None
        p = math.nan if test is None else float(test.pvalue)
        cells[row, "difference (deg)"], cells[row, "p"] = Cell(difference, n=n), Cell(p, n=n)
    return _table("view_tests", cells)


def _residuals(trials: Any) -> Table:
    from scipy import stats

    cells = {}
    for label, column in (("2D residual (px)", "residual_2d_px"), ("3D residual (cm)", "residual_3d_cm")):
        x, y = trials[[column, "median_deg"]].dropna().to_numpy(float).T
        # Both are continuous, so Pearson and not Spearman (the paper, Statistics).
        known = len(x) > 2 and np.ptp(x) > 0 and np.ptp(y) > 0
        test: Any = stats.pearsonr(x, y) if known else (math.nan, math.nan)
        r, p = map(float, test)
        cells[label, "median"] = _over(column)(trials)
        cells[label, "Pearson r"], cells[label, "p"] = Cell(r, n=len(x)), Cell(p, n=len(x))
    return _table("residuals", cells)


def _normality(measured: Any, trials: Any) -> Table:
    cells = {}
    within, across = "trials rejected (share)", "between trials, p"
    for label, joint in ROWS_PAPER.items():
        part = measured[measured["joint"] == joint]
        tested = part.dropna(subset=["normal_p"])
        rejected = float((tested["normal_p"] < ALPHA).mean()) if len(tested) else math.nan
        cells[label, within] = Cell(rejected, n=tested["comparison"].nunique())
        cells[label, across] = Cell(normality_p(part["median_abs_deg"]), n=part["comparison"].nunique())
    medians = trials["median_deg"].dropna()
    cells[TRIALS, within], cells[TRIALS, across] = Cell(), Cell(normality_p(medians), n=len(medians))
    return _table("normality", cells)


def _measures(rows: Any) -> Table:
    columns = {
        "median |error| (deg)": "median_abs_deg",
        "mean |error| (deg)": "mean_abs_deg",
        "bias (deg)": "bias_deg",
        "sd without bias (deg)": "sd_deg",
        "correlation": "correlation",
        "inside 90 %": "within_90",
    }
    cells = {(r, c): _over(field, joint)(rows) for r, joint in ROWS_PAPER.items() for c, field in columns.items()}
    return _table("joint_measures", cells)


def _by_method(trials: Any) -> Table:
    parts = {method: trials[trials["method"] == method] for method in dict.fromkeys(trials["method"])}
    columns = {MEDIAN: _over("median_deg"), MEAN: _over("mean_deg"), RTE: _over("rte_cm")}
    cells = {(method, column): cell(part) for method, part in parts.items() for column, cell in columns.items()}
    return _table("by_method", cells)


def _parts(frame: Any, column: str, paper: Sequence[str]) -> dict[str, Any]:
    """Return the parts of a frame by the values of a column: first those that the paper does not have, because they are
    what the reader came for, then the paper's."""
    own = sorted({str(v) for v in frame[column]} - set(paper))
    return {name: frame[frame[column] == name] for name in (*own, *paper)}


_Cell = Callable[[Any], Cell]


def _cells(rows: Mapping[str, _Cell], columns: Mapping[str, Any]) -> dict[tuple[str, str], Cell]:
    return {(row, name): cell(part) for row, cell in rows.items() for name, part in columns.items()}


def _over(column: str, joint: str = "") -> _Cell:
    """Return a function from rows (of a joint) to their median; n counts comparisons, not sides."""
    return functools.partial(_median_over, column=column, joint=joint)


def _median_over(part: Any, column: str, joint: str) -> Cell:
    known = (part[part["joint"] == joint] if joint else part).dropna(subset=[column])
    return Cell(*median_niqr(known[column].to_numpy(float)), n=known["comparison"].nunique())


def _mean_over(trials: Any) -> Cell:
    values = trials["mean_deg"].dropna().to_numpy(float)
    return Cell(float(values.mean()) if len(values) else math.nan, niqr(values), n=len(values))


_OF_JOINTS = {label: _over("median_abs_deg", joint) for label, joint in ROWS_PAPER.items()}


def _table(name: str, cells: Mapping[tuple[str, str], Cell]) -> Table:
    paper = paper_cells(name)
    filled = {}
    for (row, column), cell in cells.items():
        n = cell.n if math.isfinite(cell.value) else 0
        filled[row, column] = Cell(cell.value, cell.spread, n, paper.get(row, {}).get(column, ""))
    return Table(name, cells=filled, **_TEXTS["tables"][name])
