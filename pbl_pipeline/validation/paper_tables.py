"""The paper's tables from error rows: what the rows cannot fill stays empty, with n = 0."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError

from .frame import COLUMNS, KEY
from .joints import JOINTS_OPENCAP, JOINTS_PAPER, ROWS_PAPER, split_side
from .paper import paper_cells, paper_where
from .statistics import median_niqr, niqr, pearson, smaller
from .table import Cell, Table
from .view import BACK, CONTRALATERAL, FRONT, IPSILATERAL, LATERAL, MIXED

MEDIAN, MEAN, RTE = "Median Absolute Error (deg)", "Mean Absolute Error (deg)", "RTE (cm)"
KNOWN, TRIALS = "Joints compared", "All"
_POPULATIONS = ("control", "neurological", "LLPU", "pediatric")
_ACTIVITIES = ("FSST", "standing", "TUG", "tandem", "walking")
_DATASETS = ("MMMC handheld", "MMMC static", "BML-MoVi static")
#: Other names of the paper's populations and activities, small letters.
_ALIASES = {
    "healthy": "control",
    "controls": "control",
    "neurologic": "neurological",
    "lower limb prosthesis user": "LLPU",
    "paediatric": "pediatric",
    "four square step test": "FSST",
    "four-square steps": "FSST",
    "stand": "standing",
    "timed up and go": "TUG",
    "tandem gait": "tandem",
    "walk": "walking",
    "gait": "walking",
}
_OPENCAP = [split_side(j)[0] for j in JOINTS_OPENCAP]
_PAPER_JOINTS = [split_side(j)[0] for j in JOINTS_PAPER]
_OF_TRIAL = (*KEY, "recording", "comparison", "residual_2d_px", "residual_3d_cm")
_POOLED = "Median Absolute Error: of a trial, over all frames and all of the paper's 22 joints that it knows."
_MEAN = "Mean Absolute Error: of a trial, over OpenCap's joints that it knows (pelvis, hips, knees, ankles, lumbar)."


def paper_tables(frame: pd.DataFrame) -> dict[str, Table]:
    """The tables of the paper's results on accuracy, filled from the rows of `error_frame`.

    Name -> table: `summary`, `joints_by_dataset`, `joints_by_population`, `by_population`, `by_activity`, `by_view`,
    `view_tests`, `residuals`, and of our own `joint_measures` and `by_method`. Values are medians over trials (nIQR)
    unless the title says otherwise; n is the number of trials. An empty frame gives tables of empty cells.

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
        _joints("joints_by_dataset", "by dataset and camera", rows, trials, "recording", _DATASETS),
        _joints("joints_by_population", "by population", rows, trials, "population", _POPULATIONS),
        _groups("by_population", "by population", trials, "population", _POPULATIONS),
        _groups("by_activity", "by activity", trials, "activity", _ACTIVITIES),
        _by_view(rows),
        _view_tests(rows),
        _residuals(trials),
        _measures(rows),
        _by_method(trials),
    ]
    return {t.name: t for t in made}


def _prepared(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows with the paper's names, the comparison they belong to, and dataset and camera in one word."""
    rows = frame.copy()
    for column in ("population", "activity"):
        rows[column] = [_named(str(v)) for v in rows[column]]
    rows["recording"] = rows["dataset"].astype(str) + " " + rows["camera"].astype(str)
    # Missing values of the trial are part of what it is: a comparison without RTE is still one comparison.
    which = [*KEY, "lag_s", "rte_m", "residual_2d_px", "residual_3d_cm", "trial_median_abs_deg"]
    rows["comparison"] = rows.groupby(which, dropna=False, sort=False).ngroup() if len(rows) else []
    return rows


def _named(text: str) -> str:
    paper = {name.lower(): name for name in (*_POPULATIONS, *_ACTIVITIES)}
    return _ALIASES.get(text.lower()) or paper.get(text.lower()) or text


def _trials(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per comparison: its median and mean absolute error, RTE, residuals and how many joints it knows."""
    out = []
    for comparison in range(1 + int(max(_numbers(rows, "comparison"), default=-1))):
        part = _pick(rows, rows["comparison"] == comparison)
        first: dict[str, Any] = part.iloc[0].to_dict()
        measured = _pick(part, part["n"] > 0)
        opencap = _numbers(_pick(measured, measured["joint"].isin(_OPENCAP)), "mean_abs_deg")
        out.append(
            {
                **{k: first[k] for k in _OF_TRIAL},
                "method": ", ".join(str(first[k]) for k in ("detector", "solver") if str(first[k])) or "not named",
                "median_deg": first["trial_median_abs_deg"],
                "mean_deg": float(opencap.mean()) if opencap.size else math.nan,
                "rte_cm": 100 * first["rte_m"],
                "joints": len(_pick(measured, measured["joint"].isin(_PAPER_JOINTS))),
            }
        )
    return pd.DataFrame(out, columns=[*_OF_TRIAL, "method", "median_deg", "mean_deg", "rte_cm", "joints"])


def _summary(trials: pd.DataFrame) -> Table:
    columns = _columns(_DATASETS, trials["recording"])
    cells = {}
    for column in columns:
        part = _pick(trials, trials["recording"] == column)
        cells[MEDIAN, column] = _over(part, "median_deg")
        cells[MEAN, column] = _over(part, "mean_deg")
        cells[RTE, column] = _over(part, "rte_cm")
        cells[KNOWN, column] = _over(part, "joints")
    return _table(
        "summary",
        "Errors by dataset and camera, median over trials (nIQR)",
        (MEDIAN, MEAN, RTE, KNOWN),
        columns,
        cells,
        f"{_POOLED} {_MEAN} RTE: mean distance of the pelvis' path after alignment; the phone's own way is not "
        f"observed, so it says little of a phone that is carried along. {KNOWN}: of the 22; an error over fewer of "
        "them is another measure.",
        {KNOWN: 0},
    )


def _joints(
    name: str, by: str, rows: pd.DataFrame, trials: pd.DataFrame, column: str, paper_columns: Sequence[str]
) -> Table:
    columns = _columns(paper_columns, trials[column])
    cells = {}
    for c in columns:
        part = _pick(rows, (rows[column] == c) & (rows["n"] > 0))
        for label, joint in ROWS_PAPER.items():
            cells[label, c] = _over_sides(_pick(part, part["joint"] == joint), "median_abs_deg")
        cells[TRIALS, c] = _over(_pick(trials, trials[column] == c), "median_deg")
    return _table(
        name,
        f"Median absolute error of each joint {by} (deg), median over trials (nIQR)",
        (*ROWS_PAPER, TRIALS),
        columns,
        cells,
        f"Left and right of a trial count as two values of one trial. Row {TRIALS} is the {_POOLED}",
    )


def _groups(name: str, by: str, trials: pd.DataFrame, column: str, paper_columns: Sequence[str]) -> Table:
    columns = (*_columns(paper_columns, trials[column]), TRIALS)
    walking = f"{MEAN.removesuffix(' (deg)')}, walking (deg)"
    labels = (MEDIAN, MEAN, walking) if column == "population" else (MEDIAN, MEAN)
    cells = {}
    for c in columns:
        part = trials if c == TRIALS else _pick(trials, trials[column] == c)
        cells[MEDIAN, c] = _over(part, "median_deg")
        cells[MEAN, c] = _mean_over(part, "mean_deg")
        cells[walking, c] = _mean_over(_pick(part, part["activity"] == "walking"), "mean_deg")
    cells = {key: cell for key, cell in cells.items() if key[0] in labels}
    return _table(
        name,
        f"Errors {by}: median over trials of the median absolute error, mean over trials of the mean absolute error "
        "(each with nIQR)",
        labels,
        columns,
        cells,
        f"{_POOLED} {_MEAN} The paper quotes 4.1 deg for OpenCap, healthy walking.",
    )


def _by_view(rows: pd.DataFrame) -> Table:
    columns = _columns((FRONT, BACK, IPSILATERAL, CONTRALATERAL, LATERAL, MIXED), rows.loc[rows["view"] != "", "view"])
    cells = {}
    for c in columns:
        part = _pick(rows, (rows["view"] == c) & (rows["n"] > 0))
        for label, joint in ROWS_PAPER.items():
            cells[label, c] = _over_sides(_pick(part, part["joint"] == joint), "median_abs_deg")
    return _table(
        "by_view",
        "Median absolute error of each joint by the camera's view (deg), median over trials (nIQR)",
        tuple(ROWS_PAPER),
        columns,
        cells,
        "ipsilateral: the camera is on the side of the joint. lateral: a joint of the middle seen from a side. The "
        "paper shows these errors only as a figure (Fig. 4 C).",
    )


def _view_tests(rows: pd.DataFrame) -> Table:
    frontal = rows["view"].isin((FRONT, BACK))
    sagittal = rows["view"].isin((IPSILATERAL, CONTRALATERAL))
    labels, cells = [], {}
    for label, better, worse, words in (
        ("Hip Flexion", sagittal, frontal, "sagittal against frontal"),
        ("Knee Flexion", sagittal, frontal, "sagittal against frontal"),
        ("Hip Adduction", frontal, sagittal, "frontal against sagittal"),
    ):
        of_joint = (rows["joint"] == ROWS_PAPER[label]) & (rows["n"] > 0)
        a, b = _pick(rows, of_joint & better), _pick(rows, of_joint & worse)
        difference, p = smaller(_numbers(a, "median_abs_deg"), _numbers(b, "median_abs_deg"))
        n = len({*_numbers(a, "comparison"), *_numbers(b, "comparison")})
        row = f"{label}: {words} views"
        labels.append(row)
        cells[row, "difference (deg)"], cells[row, "p"] = Cell(difference, n=n), Cell(p, n=n)
    return _table(
        "view_tests",
        "Is an angle better in the view of its plane? Difference of the medians (deg) and one-sided Mann-Whitney U",
        tuple(labels),
        ("difference (deg)", "p"),
        cells,
        "Positive: the first kind of view has the smaller error. Sides of one trial are not independent, so p is too "
        "small where there are few trials.",
        {"p": 4},
    )


def _residuals(trials: pd.DataFrame) -> Table:
    cells, error = {}, _numbers(trials, "median_deg")
    for label, column in (("2D residual (px)", "residual_2d_px"), ("3D residual (cm)", "residual_3d_cm")):
        r, p, n = pearson(_numbers(trials, column), error)
        cells[label, "median"] = _over(trials, column)
        cells[label, "Pearson r"], cells[label, "p"] = Cell(r, n=n), Cell(p, n=n)
    return _table(
        "residuals",
        "Residuals of the fit, median over trials (nIQR), and their correlation with the median absolute error",
        ("2D residual (px)", "3D residual (cm)"),
        ("median", "Pearson r", "p"),
        cells,
        "Two continuous variables: Pearson. n: trials; fewer than three give no correlation.",
        {"p": 4},
    )


def _measures(rows: pd.DataFrame) -> Table:
    columns = {
        "median |error| (deg)": "median_abs_deg",
        "mean |error| (deg)": "mean_abs_deg",
        "bias (deg)": "bias_deg",
        "sd without bias (deg)": "sd_deg",
        "correlation": "correlation",
        "inside 90 %": "within_90",
    }
    measured = _pick(rows, rows["n"] > 0)
    cells = {}
    for label, joint in ROWS_PAPER.items():
        part = _pick(measured, measured["joint"] == joint)
        for column, field in columns.items():
            cells[label, column] = _over_sides(part, field)
    return _table(
        "joint_measures",
        "All measures of each joint, median over trials (nIQR)",
        tuple(ROWS_PAPER),
        tuple(columns),
        cells,
        "bias: fit - reference. inside 90 %: share of the frames inside the fit's 90 % interval. All datasets.",
    )


def _by_method(trials: pd.DataFrame) -> Table:
    methods = tuple(dict.fromkeys(trials["method"]))
    cells = {}
    for method in methods:
        part = _pick(trials, trials["method"] == method)
        for column, field in ((MEDIAN, "median_deg"), (MEAN, "mean_deg"), (RTE, "rte_cm")):
            cells[method, column] = _over(part, field)
    return _table(
        "by_method",
        "Errors by detector and solver, median over trials (nIQR)",
        methods,
        (MEDIAN, MEAN, RTE),
        cells,
        "The other tables hold all methods together: select rows of one method before making them.",
    )


def _columns(paper: Sequence[str], found: Iterable[str]) -> tuple[str, ...]:
    """Ours that the paper does not have, then the paper's: ours are what the reader came for."""
    own = sorted({str(v) for v in found} - set(paper))
    return (*own, *paper)


def _pick(frame: pd.DataFrame, mask: Any) -> pd.DataFrame:
    return frame.loc[np.asarray(mask, bool), :]


def _numbers(frame: pd.DataFrame, column: str) -> np.ndarray:
    return np.asarray(frame[column], float)


def _over(trials: pd.DataFrame, column: str) -> Cell:
    values = _numbers(trials, column)
    return Cell(*median_niqr(values), n=int(np.isfinite(values).sum()))


def _mean_over(trials: pd.DataFrame, column: str) -> Cell:
    values = _numbers(trials, column)
    values = values[np.isfinite(values)]
    return Cell(float(values.mean()) if values.size else math.nan, niqr(values), n=int(values.size))


def _over_sides(rows: pd.DataFrame, column: str) -> Cell:
    """Over the values of both sides; n counts trials, not sides."""
    values, of_trial = _numbers(rows, column), _numbers(rows, "comparison")
    return Cell(*median_niqr(values), n=len(set(of_trial[np.isfinite(values)])))


def _table(
    name: str,
    title: str,
    rows: Sequence[str],
    columns: Sequence[str],
    cells: Mapping[tuple[str, str], Cell],
    note: str,
    digits: dict[str, int] | None = None,
) -> Table:
    """With the paper's figures put in."""
    paper = paper_cells(name)
    filled = {}
    for (row, column), cell in cells.items():
        text = paper.get(row, {}).get(column, "")
        known = math.isfinite(cell.value)
        filled[row, column] = Cell(cell.value, cell.spread, cell.n if known else 0, text)
    return Table(name, title, tuple(rows), tuple(columns), filled, paper_where(name), note, digits or {})
