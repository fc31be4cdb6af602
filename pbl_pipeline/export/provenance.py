"""What an export says of its origin: software, commit, methods, model. Nothing of the person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pbl_pipeline.body import Body
from pbl_pipeline.code_version import code_version
from pbl_pipeline.fit import METHODS, TrialFit
from pbl_pipeline.gait import EVENT_METHODS, GDI_METHODS
from pbl_pipeline.methods import Stage

from .trial import ExportTrial


def origin_of(trial: ExportTrial, body: Body) -> dict[str, str]:
    """Name to text, plain ASCII without line ends: how the trial was computed, for headers and `export.json`."""
    fit, source = trial.fit, trial.methods
    lines = {
        "software": f"pbl-pipeline {code_version()}",
        "model": f"{body.name} version {body.version} (sha256 {fit.body_sha256[:12]})",
        "marker_set": fit.marker_set,
        "fit_method": source.get("Fit") or fit_method(fit),
        "fit_parameters": fit.params_hash,
        "vertical": fit.orientation_source,
    }
    if trial.measured is not None:
        events = trial.measured.events
        by_hand = ", corrected by hand" if events.corrected else ""
        lines["event_method"] = _named(EVENT_METHODS, events.method, events.params_hash) + by_hand
        gdi = trial.measured.gdi
        lines["index_method"] = f"{_named(GDI_METHODS, gdi.model, gdi.params_hash)}, norm {gdi.norm}"
    if trial.keypoints is not None and trial.keypoints.origin:
        lines["keypoints_by"] = trial.keypoints.origin
    for stage in ("Tracking", "Keypoints"):
        if stage in source:
            lines[f"{stage.lower()}_method"] = source[stage]
    if trial.fitted_with:
        lines["fitted_with"] = trial.fitted_with
    return {k: one_line(v) for k, v in lines.items()}


def fit_method(fit: TrialFit) -> str:
    """Solver and paramset of a fit, the paramset by its name where this version ships it."""
    named = next((m.key for m in METHODS.values() if m.hash == fit.params_hash), "")
    return f"{fit.solver}, {named}" if named else f"{fit.solver}, parameters {fit.params_hash}"


def _named(stage: Stage[Any], name: str, sha: str) -> str:
    """Return a method by its key where this version ships it, else by its name and hash."""
    return next((m.key for m in stage.values() if m.hash == sha), f"{name} ({sha})")


def one_line(text: str) -> str:
    """Text for a header: one line of ASCII."""
    return " ".join(text.encode("ascii", "replace").decode().split())


def summary(trial: ExportTrial) -> Mapping[str, object]:
    """The trial's frames in numbers, for `export.json`."""
    time = np.asarray(trial.fit.time_s, float)
    return {"frames": len(time), "frames_with_a_pose": int(trial.known.sum()), "seconds": float(time[-1] - time[0])}
