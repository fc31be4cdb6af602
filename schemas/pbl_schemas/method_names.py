"""Lookup of methods by key (`blazepose-v5`) and short name (`blazepose`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from . import fit, gait, gdi, keypoints, kinetics, tracking
from .method_rows import stored_keys

#: Column of a method -> table of the methods, table of the results.
_RESULTS = {
    "tracking_method": (tracking.TrackingMethod, tracking.Tracking),
    "keypoint_method": (keypoints.KeypointMethod, keypoints.Keypoints),
    "fit_method": (fit.FitMethod, fit.SessionFit),
    "gait_method": (gait.GaitEventMethod, gait.GaitEvents),
    "gdi_method": (gdi.GdiModel, gdi.GDI),
    "norm": (gdi.NormativeSet, gdi.GDI),
    "kinetics_method": (kinetics.KineticsMethod, kinetics.Kinetics),
}


def with_keys(restriction: Mapping[str, Any]) -> dict[str, Any]:
    """Return a restriction of results with the short names of its methods (and normative set) replaced by keys:
    `blazepose` becomes that of its newest version with results, else of the newest.

    Raises `PblError` SOLVER_UNKNOWN, NORM_UNKNOWN.
    """
    out = dict(restriction)
    for column in out.keys() & _RESULTS.keys():
        if isinstance(out[column], str):
            keys = keys_named(column, out[column])
            results = _RESULTS[column][1]
            out[column] = next((key for key in keys if results & {column: key}), keys[0])
    return out


def keys_named(column: str, name: str) -> list[str]:
    """Keys of the methods (column `fit_method`, ...) or normative sets (`norm`) that a key or a short name means, the
    newest version first. Raises `PblError` SOLVER_UNKNOWN, NORM_UNKNOWN."""
    return gdi.norm_keys(name) if column == "norm" else stored_keys(_RESULTS[column][0], name)
