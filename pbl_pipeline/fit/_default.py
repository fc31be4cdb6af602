"""The method that a fit takes where nobody names one: it follows from what was seen."""

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
