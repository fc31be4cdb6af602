"""The fit method that suits the points: the default if none is named, and a warning if a named one does not suit."""

from __future__ import annotations

from collections.abc import Sequence

from pbl_pipeline.keypoints import MultiView, WorldMarkers

from .methods import METHODS
from .session import Trial

#: Marker set of a trial's keypoints and whether their 3D is relative to the root; None for laboratory markers.
Points = tuple[str, bool] | None


def default_fit(*points: Points, solver: str | None = None) -> str:
    """Return the name of the method for trials with these points; every default of the fit is resolved here.

    `markers` for a laboratory's markers, `gauss-newton` for MeTRAbs' 87 points with 3D in the camera's frame, for which
    it was tuned, and the project's default, with BlazePose's priors, for all others and for mixed trials. If that
    method is of another solver than `solver`, the first method of that solver.
    """
    suited = {_suited(p) for p in points}
    name = suited.pop() if len(suited) == 1 else METHODS.default
    of_solver = (n for n in (name, METHODS.default, *METHODS) if solver is None or METHODS[n].family.name == solver)
    return next(of_solver)


def points_of(trials: Sequence[Trial]) -> list[Points]:
    """Return the points of each view of each trial, as `default_fit` takes them."""
    views = [v for t in trials for v in (t.views if isinstance(t, MultiView) else [t])]
    return [None if isinstance(v, WorldMarkers) else (v.marker_set, v.root_relative) for v in views]


def unsuited(method: str, points: Points) -> str:
    """Return a warning if a method (its name) was made for other points than these, else "".

    Methods of the paper and of a laboratory are not for particular points.
    """
    suits = _suited(points)
    if _MADE_FOR.get(method) in (None, _MADE_FOR[suits]):
        return ""
    seen = "markers of a laboratory" if points is None else f"points of {points[0]}"
    return f"{method} was made for {_MADE_FOR[method]}, and is asked for {seen}: {suits} suits these"


def _suited(points: Points) -> str:
    if points is None:
        return "markers"
    return "gauss-newton" if points == ("bml_movi_87", False) else METHODS.default


#: Method -> the points that its priors and weights were made with.
_MADE_FOR = {
    "blazepose": "BlazePose's points",
    "blazepose-measured": "BlazePose's points",
    "gauss-newton": "MeTRAbs' 87 points with 3D",
    "markers": "markers of a laboratory",
}
