"""The reliability of a detector's confidence as CSV and one page with charts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup

import pbl_pipeline
from pbl_pipeline.charts import Axes, nice_ticks
from pbl_pipeline.keypoints import BOUND_TRUNK, ConfidenceCurve
from research.reliability.point_errors import PointErrors, reliability_table

_POINTS, _CURVE, _MEDIAN, _HIGH = "#1f5fbf", "#b4540a", "#1f5fbf", "#8a939c"
_SIZE = (440, 280)


def write_reliability(
    errors: Sequence[PointErrors], folder: str | Path, curve: ConfidenceCurve | None = None, n_bins: int = 10
) -> list[Path]:
    """Write `reliability.csv` (the bins) and `reliability.html` (one row of charts for each detector and dataset).

    The folder is made. Returns the paths; the page is the last.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    table = reliability_table(errors, curve, n_bins)
    csv, page = folder / "reliability.csv", folder / "reliability.html"
    table.to_csv(csv, index=False, float_format="%.5g", lineterminator="\n")
    page.write_text(reliability_html(table, curve), encoding="utf-8")
    return [csv, page]


def reliability_html(table: pd.DataFrame, curve: ConfidenceCurve | None = None) -> str:
    """One page that asks for nothing from elsewhere, from the rows of `reliability_table`."""
    text = (Path(__file__).parent / "reliability.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    groups = []
    for detector, dataset in dict.fromkeys(zip(table["detector"], table["dataset"], strict=True)):
        rows = table.loc[(table["detector"] == detector) & (table["dataset"] == dataset)]
        n = rows["n"].to_numpy()
        groups.append(
            {
                "detector": detector,
                "dataset": dataset,
                "recordings": int(rows["recordings"].to_numpy()[0]),
                "n": int(n.sum()),
                "within": float(np.average(rows["within_bound"].to_numpy(), weights=n)),
                "reliability": reliability_chart(rows, curve),
                "error": error_chart(rows),
                "rows": rows.to_dict("records"),
            }
        )
    return environment.from_string(text).render(
        groups=groups, curve=curve, bound=BOUND_TRUNK, version=pbl_pipeline.__version__
    )


def reliability_chart(rows: pd.DataFrame, curve: ConfidenceCurve | None = None) -> Markup:
    """Measured fraction of points within the bound over stated confidence: dots, with what the curve says as a line. On
    the grey diagonal a stated confidence is the probability."""
    ticks = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    axes = Axes(_SIZE, (0, 1), (0, 1), margin=(40, 10, 10, 26))
    axes.grid(ticks, ticks)
    axes.curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]), _HIGH, 1.2, dash="4 4")
    if curve is not None:
        stated = np.linspace(0.001, 1, 200)
        axes.curve(stated, curve(stated), _CURVE, 2.0)
    for row in rows.to_dict("records"):
        y = float(axes.y(row["within_bound"]))
        axes.line((float(axes.x(row["stated_low"])), y), (float(axes.x(row["stated_high"])), y), _POINTS, 1.2)
        axes.dot(float(axes.x(row["stated_mean"])), y, _POINTS)
    return axes.svg("share of points within the bound over stated confidence")


def error_chart(rows: pd.DataFrame) -> Markup:
    """Median and 90th percentile of the error (percent of the trunk's length) over stated confidence; errors beyond
    the chart stand at its upper edge."""
    most = float(np.clip(rows["error_90_trunk"].max(), 1.25 * BOUND_TRUNK, 1.0))
    ticks = nice_ticks(0.0, 100 * most)
    axes = Axes(_SIZE, (0, 1), (0, ticks[-1]), margin=(40, 10, 10, 26))
    axes.grid([0.0, 0.2, 0.4, 0.6, 0.8, 1.0], ticks, "", "\N{NO-BREAK SPACE}%")
    axes.line(
        (axes.left, float(axes.y(100 * BOUND_TRUNK))), (axes.right, float(axes.y(100 * BOUND_TRUNK))), _CURVE, 1.2
    )
    for column, colour, hollow in (("error_90_trunk", _HIGH, True), ("error_median_trunk", _MEDIAN, False)):
        shown = np.minimum(100 * rows[column].to_numpy(), ticks[-1])
        axes.curve(rows["stated_mean"].to_numpy(), shown, colour, 1.6)
        for x, y in zip(rows["stated_mean"], shown, strict=True):
            axes.dot(float(axes.x(x)), float(axes.y(y)), colour, hollow=hollow)
    return axes.svg("error over stated confidence")
