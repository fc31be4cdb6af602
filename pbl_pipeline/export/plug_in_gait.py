"""The fitted body under the names of Plug-in Gait: its markers and angles, for programs that look for them."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.body import marker_set
from pbl_pipeline.gait import PLUG_IN_GAIT, PLUG_IN_GAIT_POINTS, angle_series, offset_deg

from .trial import ExportTrial, interpolated

#: The name of the choice.
NAMES = "plug-in-gait"
#: Marker without its side -> place on the body, of the set of laboratory markers.
_PLACES = {"ASI": "ASIS", "PSI": "PSIS", "KNE": "knee", "ANK": "ankle", "HEE": "calc", "TOE": "toe"}
#: The middle between the posterior spines: programs look for it, also where these are there.
_SACRUM = "SACR"
MARKERS = (*(side + name for name in _PLACES for side in "LR"), _SACRUM)
ANGLES = tuple(side + point for point in dict.fromkeys(p for p, _ in PLUG_IN_GAIT_POINTS.values()) for side in "LR")


def markers_m(trial: ExportTrial) -> np.ndarray:
    """Positions (N, len(MARKERS), 3) of the fitted body's anatomical places at the trial's even times, world, m."""
    places, poses, even = marker_set("opencap_35"), trial.poses, trial.even
    columns = [places.names.index(f"{side.lower()}_{place}") for place in _PLACES.values() for side in "LR"]
    at = places.body_index[columns]
    local = places.position_m[columns] * np.asarray(trial.fit.scale, float)[poses.body.scale_index[at], None]
    found = even.position_m[:, at] + np.einsum("njab,jb->nja", even.rotation[:, at], local)
    back = [MARKERS.index(f"{side}PSI") for side in "LR"]
    return np.concatenate([found, found[:, back].mean(axis=1, keepdims=True)], axis=1)


def angles_deg(trial: ExportTrial) -> np.ndarray:
    """Angles (N, len(ANGLES), 3) at the trial's even times, deg: Plug-in Gait's components, signs and pelvis (the line
    of its spines). A component that the body lacks is 0; a point is NaN where an angle of it is.

    Raises `PblError` GAIT_INPUT as `angle_series`.
    """
    series = angle_series(trial.fit, trial.poses)
    out = np.zeros((len(series.time_s), len(ANGLES), 3))
    for side, of_side in (("L", series.left), ("R", series.right)):
        for name, (point, component) in PLUG_IN_GAIT_POINTS.items():
            offset = offset_deg(name, series.angle_model, PLUG_IN_GAIT)
            out[:, ANGLES.index(side + point), component] = of_side[name] + offset
    out[np.isnan(out).any(axis=-1)] = np.nan
    if not trial.even.resampled:
        return out
    return np.stack([interpolated(series.time_s, out[:, k], trial.even.time_s) for k in range(len(ANGLES))], axis=1)
