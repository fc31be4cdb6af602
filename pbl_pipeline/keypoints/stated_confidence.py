"""Calibration of a detector's confidence: curves from the stated value to the probability that a point is right.

A stated confidence is a number between 0 and 1 in a scale of the detector's own. A curve turns it into the probability
that the point lies within a stated bound of the true one in the picture. Curves are data with a name and a version
(`data/confidence_curves.json`, made by `python -m research.confidence`) and never change: another
fit is another version, and its name stands in the parameters of the keypoint method.

The stated confidence stays what the fit weighs with (docs/confidence.md says why); the probability is what people are
shown.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from importlib import resources

import numpy as np

from pbl_pipeline.errors import PblError

from .types import Keypoints

#: The bound of all curves: a fraction of the length of the trunk (middle of the shoulders to middle of the hips) in the
#: picture, as it would be seen from the side. The "percentage of correct points" of pose estimation at 0.2.
BOUND_TRUNK = 0.2
_DATA = "data/confidence_curves.json"


@dataclasses.dataclass(frozen=True)
class ConfidenceCurve:
    """A monotone map from stated confidence to probability."""

    name: str  # "blazepose-v1": detector and version
    detector: str  # name of the detector
    bound_trunk: float  # the point counts as right within this fraction of the trunk's length
    #: (K,) knots; linear between them, constant outside.
    stated: np.ndarray
    probability: np.ndarray
    n: int  # points that it was fitted to
    source: str  # the data that it was fitted to, in words
    #: The parameters of the detection that gave these confidences (`KeypointParams` less `confidence_curve`).
    params: dict

    def __call__(self, confidence: np.ndarray) -> np.ndarray:
        """Return probabilities for stated confidences of any shape; 0 for 0, which means that no point was found."""
        confidence = np.asarray(confidence, float)
        return np.where(confidence > 0, np.interp(confidence, self.stated, self.probability), 0.0)


@functools.cache
def confidence_curves() -> dict[str, ConfidenceCurve]:
    """All curves by name."""
    text = resources.files("pbl_pipeline.keypoints").joinpath(_DATA).read_text(encoding="utf-8")
    curves = {}
    for name, c in json.loads(text)["curves"].items():
        stated, probability = np.asarray(c["stated"], float), np.asarray(c["probability"], float)
        if np.any(np.diff(stated) <= 0) or np.any(np.diff(probability) < 0) or not 0 <= probability[0] <= 1:
            raise ValueError(f"{_DATA}: {name} is not a monotone curve")
        curves[name] = ConfidenceCurve(
            name, c["detector"], c["bound_trunk"], stated, probability, c["n"], c["source"], c["params"]
        )
    return curves


def confidence_curve(name: str) -> ConfidenceCurve:
    """The curve of that name. Raises `PblError` SOLVER_UNKNOWN."""
    curves = confidence_curves()
    if name not in curves:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"confidence curve {name!r}",
            expected=f"one of {', '.join(curves)}, or none",
            next_step="choose one of these names in the keypoint parameters, or update the program that reads the file",
        )
    return curves[name]


def probability_within(keypoints: Keypoints) -> np.ndarray | None:
    """(T, J) probability that a point lies within the curve's bound of the true one; None without a curve."""
    if not keypoints.confidence_curve:
        return None
    return confidence_curve(keypoints.confidence_curve)(keypoints.confidence)


def confidence_text(keypoints: Keypoints) -> str:
    """One sentence for people: how sure the points are, and what that is worth."""
    found = keypoints.confidence > 0
    if not found.any():
        return "no point was found"
    stated = f"median {np.median(keypoints.confidence[found]):.2f} as the detector states it"
    probability = probability_within(keypoints)
    if probability is None:
        return f"{stated}; what that is worth was not measured"
    bound = confidence_curve(keypoints.confidence_curve).bound_trunk
    right = float(np.mean(probability[found]))
    return (
        f"{stated}; {right:.0%} of the points within {bound:.0%} of the trunk's length ({keypoints.confidence_curve})"
    )
