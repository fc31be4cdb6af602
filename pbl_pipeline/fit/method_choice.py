"""The method that suits what was seen: taken where nobody names one, and compared with one that is named."""

from __future__ import annotations

from collections.abc import Sequence

from pbl_pipeline.keypoints import MultiView, WorldMarkers

from ._methods import METHODS
from .session import Trial


def default_method(trials: Sequence[Trial]) -> str:
    """Name of the method for these trials: `markers` for those of a laboratory, else as `default_for_points`. Trials
    that differ take the project's default."""
    if all(isinstance(t, WorldMarkers) for t in trials):
        return "markers"
    views = [v for t in trials for v in (t.views if isinstance(t, MultiView) else [t])]
    names = {
        METHODS.default if isinstance(v, WorldMarkers) else default_for_points(v.marker_set, v.root_relative)
        for v in views
    }
    return names.pop() if len(names) == 1 else METHODS.default


def default_for_points(marker_set: str, root_relative: bool) -> str:
    """Name of the method for keypoints of that marker set: `gauss-newton`, which was tuned for MeTRAbs' 87 points with
    3D in the camera's frame, for these; the project's default, with BlazePose's priors, for all else."""
    return "gauss-newton" if (marker_set, root_relative) == ("bml_movi_87", False) else METHODS.default


def unsuited(method: str, points: tuple[str, bool] | None) -> str:
    """What is to be said of a method (its name) that was made for other points than these, "" where it was not.

    `points`: marker set and whether 3D is relative to the root, as of a keypoint method; None for markers of a
    laboratory. The methods of the paper were made for no points in particular, and neither were those of one's own.
    """
    suits = "markers" if points is None else default_for_points(*points)
    if method == suits or method not in _MADE_FOR:
        return ""
    seen = "markers of a laboratory" if points is None else f"points of {points[0]}"
    return f"{method} was made for {_MADE_FOR[method]}, and is asked for {seen}: {suits} suits these"


#: Method -> the points that its priors and weights were made with.
_MADE_FOR = {
    "blazepose": "BlazePose's points",
    "gauss-newton": "MeTRAbs' 87 points with 3D",
    "markers": "markers of a laboratory",
}
