"""Stated confidence against measured error: what a detector's confidence is worth (docs/confidence.md)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import isotonic_regression

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import BOUND_TRUNK, ConfidenceCurve, Keypoints

from ._point_truth import PointTruth

#: Columns of `reliability_table`.
RELIABILITY_COLUMNS = (
    "detector",
    "dataset",
    "recordings",
    "stated_low",
    "stated_high",
    "stated_mean",
    "n",
    "error_median_trunk",
    "error_90_trunk",
    "error_median_px",
    "error_90_px",
    "error_3d_median_cm",
    "error_3d_90_cm",
    "within_bound",
    "probability_mean",
)
#: Points a knot of a curve stands for at least, in shares of all, and what is added to either outcome of each knot.
_KNOTS, _PRIOR = 24, 1.0


@dataclasses.dataclass(frozen=True)
class PointErrors:
    """Errors of the N points of one recording that a detector found and of which the truth is known.

    Attributes
    ----------
    detector, dataset, recording
        Names.
    stated : (N,)
        Confidence.
    error_px, error_trunk : (N,)
        Distance in the picture, in pixels and as a share of the trunk's length there.
    error_3d_cm : (N,)
        Distance of the points relative to the middle of the hips, NaN where the detector gives no 3D.
    """

    detector: str
    dataset: str
    recording: str
    stated: np.ndarray
    error_px: np.ndarray
    error_trunk: np.ndarray
    error_3d_cm: np.ndarray

    @property
    def title(self) -> str:
        """Dataset and recording, once where the one names the other."""
        return self.dataset if self.recording in self.dataset else f"{self.dataset}, {self.recording}"


def point_errors(keypoints: Keypoints, truth: PointTruth, detector: str, dataset: str, recording: str) -> PointErrors:
    """The errors of a trial. Points beyond the picture and those without truth do not count.

    Raises `PblError` REFERENCE_INPUT where no point is left.
    """
    error_px = np.linalg.norm(keypoints.xy_px - truth.xy_px, axis=-1)
    error_trunk = error_px / truth.trunk_px[:, None]
    hips = [j for j, n in enumerate(keypoints.names) if n.lower() in ("left_hip", "right_hip", "lhip", "rhip")]
    apart = [
        p - p[:, hips].mean(axis=1, keepdims=True) for p in (np.asarray(keypoints.xyz_cam_m, float), truth.xyz_cam_m)
    ]
    error_3d = 100 * np.linalg.norm(apart[0] - apart[1], axis=-1)
    known = (keypoints.confidence > 0) & np.isfinite(error_trunk)
    if not known.any():
        raise PblError(
            "REFERENCE_INPUT",
            found=f"no point of {recording} that both the detector and the truth know",
            expected="the truth of this recording",
            next_step="check that keypoints and truth belong together",
            key=recording,
        )
    return PointErrors(
        detector,
        dataset,
        recording,
        np.asarray(keypoints.confidence, float)[known],
        error_px[known],
        error_trunk[known],
        error_3d[known],
    )


def reliability_table(
    errors: Sequence[PointErrors], curve: ConfidenceCurve | None = None, n_bins: int = 10, bound: float = BOUND_TRUNK
) -> pd.DataFrame:
    """Rows of bins of stated confidence with equally many points, for each detector and dataset.

    Columns: `RELIABILITY_COLUMNS`. `within_bound` is the measured share of points within `bound` trunk lengths,
    `probability_mean` what `curve` says of them (NaN without one).
    """
    rows = []
    for detector, dataset in sorted({(e.detector, e.dataset) for e in errors}):
        own = [e for e in errors if (e.detector, e.dataset) == (detector, dataset)]
        stated, px, trunk, cm = (
            np.concatenate([getattr(e, f) for e in own]) for f in ("stated", "error_px", "error_trunk", "error_3d_cm")
        )
        for index in np.array_split(np.argsort(stated, kind="stable"), min(n_bins, len(stated))):
            has_3d = cm[index][np.isfinite(cm[index])]
            rows.append(
                (
                    detector,
                    dataset,
                    len(own),
                    stated[index[0]],
                    stated[index[-1]],
                    stated[index].mean(),
                    len(index),
                    *np.percentile(trunk[index], (50, 90)),
                    *np.percentile(px[index], (50, 90)),
                    *(np.percentile(has_3d, (50, 90)) if len(has_3d) else (np.nan, np.nan)),
                    np.mean(trunk[index] <= bound),
                    np.nan if curve is None else curve(stated[index]).mean(),
                )
            )
    return pd.DataFrame(rows, columns=list(RELIABILITY_COLUMNS))


def fit_curve(
    errors: Sequence[PointErrors], name: str, params: dict | None = None, bound: float = BOUND_TRUNK
) -> ConfidenceCurve:
    """The monotone curve (isotonic regression) through the shares of points within `bound`.

    Every recording weighs the same, however long it is. The points are pooled into `_KNOTS` bins of equal weight, each
    with one point more on either side of the bound (so nothing is ever certain), and the bins made monotone.

    Raises `PblError` REFERENCE_INPUT for errors of several detectors, or too few points.
    """
    detectors = sorted({e.detector for e in errors})
    n = sum(len(e.stated) for e in errors)
    if len(detectors) != 1 or n < 10 * _KNOTS:
        raise PblError(
            "REFERENCE_INPUT",
            found=f"{n} points of {', '.join(detectors) or 'no detector'}",
            expected=f"one detector and {10 * _KNOTS} points or more",
            next_step="take more recordings",
        )
    stated = np.concatenate([e.stated for e in errors])
    right = np.concatenate([e.error_trunk <= bound for e in errors]).astype(float)
    weight = np.concatenate([np.full(len(e.stated), n / len(errors) / len(e.stated)) for e in errors])
    order = np.argsort(stated, kind="stable")
    stated, right, weight = stated[order], right[order], weight[order]
    part = np.minimum((np.cumsum(weight) - 0.5 * weight) / weight.sum() * _KNOTS, _KNOTS - 1).astype(int)
    total = np.bincount(part, weight, _KNOTS)
    share = (np.bincount(part, weight * right, _KNOTS) + _PRIOR) / (total + 2 * _PRIOR)
    middle = np.bincount(part, weight * stated, _KNOTS) / np.maximum(total, 1e-12)
    keep = total > 0
    probability = isotonic_regression(share[keep], weights=total[keep]).x
    knots, first = np.unique(np.round(middle[keep], 4), return_index=True)
    source = "; ".join(f"{e.title} ({len(e.stated)} points)" for e in errors)
    return ConfidenceCurve(
        name, detectors[0], bound, knots, np.round(probability[first], 4), n, source, dict(params or {})
    )


@dataclasses.dataclass(frozen=True)
class CurveScore:
    """How well probabilities say what happens in a recording; lower is better.

    brier: mean squared difference of probability and outcome (0 or 1). gap: mean probability less the share within
    the bound. Of the stated confidence taken as a probability, and of a curve that never saw the recording.
    """

    recording: str
    within: float
    brier_stated: float
    brier_curve: float
    gap_stated: float
    gap_curve: float


def leave_one_out(errors: Sequence[PointErrors], bound: float = BOUND_TRUNK) -> list[CurveScore]:
    """For each dataset the score of a curve fitted to the others: recordings of one movement are not independent."""
    scores = []
    for dataset in dict.fromkeys(e.dataset for e in errors):
        curve = fit_curve([e for e in errors if e.dataset != dataset], "others", bound=bound)
        for e in (e for e in errors if e.dataset == dataset):
            right, p = (e.error_trunk <= bound).astype(float), curve(e.stated)
            scores.append(
                CurveScore(
                    e.title,
                    float(right.mean()),
                    float(np.mean((e.stated - right) ** 2)),
                    float(np.mean((p - right) ** 2)),
                    float(e.stated.mean() - right.mean()),
                    float(p.mean() - right.mean()),
                )
            )
    return scores


def save_curve(curve: ConfidenceCurve, path: str | Path) -> None:
    """Add the curve to a file of curves.

    Raises `PblError` FILE_FORMAT where the file holds another curve of this name: a curve never changes.
    """
    path = Path(path)
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"curves": {}}
    row = {
        "detector": curve.detector,
        "bound_trunk": curve.bound_trunk,
        "n": curve.n,
        "source": curve.source,
        "params": curve.params,
        "stated": curve.stated.tolist(),
        "probability": curve.probability.tolist(),
    }
    if known["curves"].get(curve.name, row) != row:
        raise PblError(
            "FILE_FORMAT",
            found=f"another curve {curve.name} in the file",
            expected="a curve that never changes once it has a name",
            next_step="give the new one the next version",
            key=str(path),
        )
    known["curves"][curve.name] = row
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
