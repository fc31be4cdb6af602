"""Gait measures read back from `metrics.json` (docs/files.md), with the events and curves in the files beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.files import check_numbers, load_npz, texts_of
from pbl_pipeline.paramset import structured
from pbl_pipeline.qc import EMPTY, PASS, Check
from pbl_pipeline.results.cycles import Curves, GaitCycle
from pbl_pipeline.results.events import GaitEvent, GaitEvents
from pbl_pipeline.results.index import Gdi, GdiCycle, MovementProfile, numbers_of
from pbl_pipeline.results.measures import Measure

from ._cycles import REPORT_PERCENT
from .cycle_measures import MEASURES, Spatiotemporal
from .metrics import GaitMetrics, TrialMetrics
from .tasks import TRIAL_MEASURES


def curve_table(curves: Sequence[Mapping[str, np.ndarray]], names: Sequence[str]) -> np.ndarray:
    """Return the curves of C cycles, (C, K, P) float32 of the K `names`; those that a cycle lacks are NaN."""
    unknown = np.full(len(REPORT_PERCENT), np.nan, np.float32)
    rows = [[of_cycle.get(name, unknown) for name in names] for of_cycle in curves]
    return np.asarray(rows, np.float32).reshape(len(curves), len(names), len(unknown))


def known_curves(names: Sequence[str], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the known curves by name of one cycle of a `curve_table`. rows: (K, P)."""
    return {name: curve for name, curve in zip(names, rows, strict=True) if np.isfinite(curve).all()}


def save_curves(cycles: Sequence[GaitCycle], path: Path) -> None:
    """Write the curves of all cycles and their standard deviations to one .npz (float32); unknown curves are NaN."""
    curves, curves_sd, error_models = ([getattr(c, field) for c in cycles] for field in Curves._fields)
    names = sorted({name for of_cycle in curves for name in of_cycle})
    np.savez_compressed(
        path,
        cycle_no=np.asarray([c.number for c in cycles], np.int16),
        names=np.asarray(names, dtype=str),
        percent=np.asarray(REPORT_PERCENT, np.float32),
        curve=curve_table(curves, names),
        curve_sd=curve_table(curves_sd, names),
        error_model=np.asarray(error_models, dtype=str),
    )


def load_curves(path: Path) -> dict[int, Curves]:
    """Return the curves by cycle number. Raises `PblError` FILE_MISSING, FILE_FORMAT."""
    again = "`pbl gait *.fit.npz --out metrics.json` writes them again"
    data = load_npz(path, ("curve_sd", "error_model"), needed=("cycle_no", "names", "curve"), next_step=again)
    names = texts_of(path, data, "names")
    curves = data["curve"]
    sd = data.get("curve_sd", np.full_like(curves, np.nan))  # absent in files of version 0.1 and before
    shape = (data["cycle_no"].size, len(names), None)
    check_numbers(path, {"curve": curves, "curve_sd": sd}, {"curve": shape, "curve_sd": shape})
    errors = texts_of(path, data, "error_model") if "error_model" in data else [""] * shape[0]  # since version 0.2
    rows = zip(data["cycle_no"].ravel(), curves, sd, errors, strict=True)
    return {int(n): Curves(known_curves(names, a), known_curves(names, b), error) for n, a, b, error in rows}


#: Checks of the index among the checks of a trial or session; the others are of its measures.
INDEX_CHECKS = ("gdi_cycles", "gdi_explained", "norm_convention", "passes_agree")
#: Rounding of the times in events.csv (s).
_ROUNDED_S = 1e-3


def metrics_of(
    content: Mapping[str, Any],
    events: Mapping[str, Sequence[GaitEvent]],
    curves: Mapping[str, Mapping[int, Curves]],
) -> GaitMetrics:
    """Return the measures that `GaitMetrics.to_dict` wrote.

    Parameters
    ----------
    content
        Of metrics.json. Files of version 0.1 lack the facts about events and cycles of a trial: it then has no cycles.
    events, curves
        By the name of the trial: what events.csv and cycles.npz hold.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError
        The content is not that of a metrics.json.
    """
    session, model = content["session"], str(content["gdi_model"])
    trials = tuple(_trial(t, model, events.get(t["name"], ()), curves.get(t["name"], {})) for t in content["trials"])
    checks = checks_of(session)
    n_before = int(session.get("qc_before_gait", len(checks)))
    of_events = {c for t in trials for c in t.events.qc}
    own = tuple(c for c in checks[n_before:] if c not in of_events)
    cycles = tuple(c for t in trials if t.pooled for c in t.gdi.cycles)
    return GaitMetrics(
        trials=trials,
        status=str(session["status"]),
        reason=str(session["reason"]),
        spatiotemporal=_spatiotemporal(session, sum(t.spatiotemporal.n_steps_used for t in trials if t.pooled)),
        gdi=_index(session, model, own, cycles),
        qc=own,
        params_hash=str(content["params_hash"]),
        before=checks[:n_before],
    )


def _trial(
    content: Mapping[str, Any], model: str, events: Sequence[GaitEvent], curves: Mapping[int, Curves]
) -> TrialMetrics:
    name, checks = str(content["name"]), checks_of(content)
    return TrialMetrics(
        name=name,
        status=str(content["status"]),
        reason=str(content["reason"]),
        events=_events(content, events, checks),
        cycles=tuple(_cycle(c, name, curves) for c in content.get("gait_cycles", ())),
        spatiotemporal=_spatiotemporal(content),
        gdi=_index(content, model, checks, None),
        qc=checks,
        pooled=bool(content.get("pooled", True)),
    )


def _events(content: Mapping[str, Any], events: Sequence[GaitEvent], checks: Sequence[Check]) -> GaitEvents:
    told = content.get("events")
    if told is None:  # version 0.1
        status = PASS if events else EMPTY
        return GaitEvents(status, tuple(events), "" if events else str(content["reason"]), "unknown", "", "fit")
    found = structured({**told, "events": ()}, GaitEvents)
    numbered = (dataclasses.replace(e, bout=_bout(e.time_s, found.walking_s)) for e in events)
    return dataclasses.replace(found, events=tuple(numbered))


def _bout(time_s: float, bouts: Sequence[tuple[float, float]]) -> int:
    return next((i for i, (a, b) in enumerate(bouts) if a - _ROUNDED_S <= time_s <= b + _ROUNDED_S), 0)


def _cycle(content: Mapping[str, Any], trial: str, curves: Mapping[int, Curves]) -> GaitCycle:
    known = curves.get(int(content["number"]), Curves({}, {}, ""))
    return structured({**content, "trial": trial, **known._asdict()}, GaitCycle)


def _spatiotemporal(content: Mapping[str, Any], n_steps: int = 0) -> Spatiotemporal:
    known = (n for n in TRIAL_MEASURES if n in content)
    measures = {n: None if content[n] is None else structured(content[n], Measure) for n in known}
    counts, used = content["cycles"], bool(content["cycles"]["used"])
    reasons = {n: str(r) for n, r in content["reasons"].items() if n != "gdi"}
    return Spatiotemporal(
        status=PASS if used else EMPTY,
        reason="" if used else reasons.get(MEASURES[0], ""),  # without cycles every measure has this reason
        measures=measures,
        reasons=reasons,
        n_cycles_found=int(counts["found"]),
        n_cycles_used=int(counts["used"]),
        n_steps_used=int(counts.get("steps", n_steps)),
    )


def _index(content: Mapping[str, Any], model: str, checks: Sequence[Check], cycles: Sequence[GdiCycle] | None) -> Gdi:
    """Return the index of a trial or session. `cycles`: those of a session's trials, None for those in the content."""
    told, profile = content["gdi"], content.get("profile_deg")
    own = tuple(structured(c, GdiCycle) for c in told.get("cycles", ())) if cycles is None else tuple(cycles)
    known = None if profile is None else structured(profile, MovementProfile)
    numbers = numbers_of(told)
    return Gdi(
        **numbers,
        status=PASS if numbers["mean"] is not None else EMPTY,
        reason=str(content["reasons"].get("gdi", "")),
        n=int(told["n"]),
        n_left=int(told.get("n_left", sum(c.side == "left" for c in own))),
        n_right=int(told.get("n_right", sum(c.side == "right" for c in own))),
        norm=str(told["norm"]),
        model=model,
        params_hash=str(told.get("params_hash", "")),
        cycles=own,
        qc=tuple(c for c in checks if c.check in INDEX_CHECKS),
        profile=known,
    )


def checks_of(content: Mapping[str, Any]) -> tuple[Check, ...]:
    """Return the checks of a trial or session."""
    return tuple(structured(c, Check) for c in content["qc"])
