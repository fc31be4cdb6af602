"""Stated confidence against measured error: what a detector's confidence is worth (research/reports)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import BOUND_TRUNK, ConfidenceCurve, Keypoints
from research.reliability.point_truth import PointTruth

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
        Distance in the picture, in pixels and as a fraction of the trunk's length there.
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

    Columns: `RELIABILITY_COLUMNS`. `within_bound` is the measured fraction of points within `bound` trunk lengths,
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
