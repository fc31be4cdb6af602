"""Rows back to the objects of the library, one stage at a time; `visits` puts them together."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline.files import load_npz
from pbl_pipeline.qc import in_order
from pbl_pipeline.records import from_row
from pbl_pipeline.results import CycleKinetics, Gdi, GdiCycle, Kinetics, MovementProfile, Solution, TrialKinetics

from .. import fit, gait, gdi, keypoints, kinetics, tracking, video
from ..gait import load_cycles, load_events
from ..rows import Rows, row_of, stored_rows
from ..stored_files import file_ref, read_stored

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib
    from pbl_pipeline import tracking as tracking_lib
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.keypoints import Keypoints
    from pbl_pipeline.qc import Check


def videos_of(key: Mapping[str, Any], rows: Rows = stored_rows) -> list[int]:
    """Numbers of the trials of a fit, in the order of its `trials`."""
    return [int(r["video_id"]) for r in rows(fit.SessionFit.Trial, _of(fit.SessionFit, key))]


def _of(table: Any, key: Mapping[str, Any]) -> dict[str, Any]:
    return {name: key[name] for name in table.primary_key}


def load_keypoints(key: Any, rows: Rows = stored_rows) -> Keypoints:
    """Return the library's `Keypoints` of one row, by its key or a query of it alone."""
    from pbl_pipeline.keypoints import Keypoints

    ref = file_ref(row_of(keypoints.Keypoints, _keys(key), rows)["keypoints_file"])
    return read_stored(ref, Keypoints.load)


def load_trial_fit(key: Any, rows: Rows = stored_rows) -> TrialFit:
    """Return the library's `TrialFit` of one row of SessionFit.Trial, by its key or a query of it alone."""
    return fit.load_trial(file_ref(row_of(fit.SessionFit.Trial, _keys(key), rows)["trial_file"]))


def _keys(key: Any) -> Any:
    """Return a query without its other columns, on which DataJoint joins no table; any other restriction unchanged."""
    return key.proj() if hasattr(key, "proj") else key


def load_solution(key: Mapping[str, Any], rows: Rows = stored_rows) -> Solution:
    """The library's `Solution` of one row of SessionFit: how its body was fitted, without the fitted movements."""
    row = row_of(fit.SessionFit, _of(fit.SessionFit, key), rows)
    arrays = read_stored(file_ref(row["session_file"]), lambda path: load_npz(path, needed=("scale", "loss_trace")))
    origin = {"params_hash": row["fit_method_hash"], "software": row["fit_code_version"], "seconds": row["fit_seconds"]}
    found = from_row(Solution, row, **origin, **arrays)
    # NULL for fits older than this column: the trace ends with the last step
    steps = found.loss_trace[-1, 0] if found.iterations is None else found.iterations
    return dataclasses.replace(found, iterations=int(steps))


def load_fit_checks(key: Any, rows: Rows = stored_rows) -> tuple[Check, ...]:
    """The library's `Check`s of one row of SessionFit."""
    return in_order(fit.SessionFit.Check.records(key, rows))


def load_tracking(key: Any) -> tracking_lib.Tracking:
    """The library's `Tracking` of one row."""
    return tracking.load_tracking(*tracking.tracks_of(key))


def load_metrics(key: Any, rows: Rows = stored_rows) -> lib.GaitMetrics:
    """The library's `GaitMetrics` of one row of SessionGdi, from the rows of its trials and its own: nothing is
    recomputed but the checks of a trial's cycles."""
    from pbl_pipeline import gait as lib
    from pbl_pipeline.gait.metrics_file import INDEX_CHECKS

    row = row_of(gdi.SessionGdi, key, rows)
    row_key = _of(gdi.SessionGdi, row)
    pace = gdi.pace_of(row_key["gdi_method"], rows)
    trials = tuple(_trial_metrics({**row_key, "video_id": v}, pace, rows) for v in videos_of(row_key, rows))
    pooled = [t for t in trials if t.pooled]
    checks = in_order(gdi.SessionGdi.Check.records(row_key, rows))
    cycles = [c for t in pooled for c in t.gdi.cycles]
    own = tuple(c for c in checks if c.check in INDEX_CHECKS)
    status = "EMPTY" if row["session_gdi"] is None else "PASS"
    index = _index(gdi.SessionGdi, row, "session_gdi", cycles, rows, qc=own, status=status)
    measures = lib.Spatiotemporal(
        row["session_status"],
        row["session_reason"],
        *gdi.SessionGdi.Measure.measures(row_key, lib.TRIAL_MEASURES, rows),
        n_cycles_found=sum(t.spatiotemporal.n_cycles_found for t in pooled),
        n_cycles_used=int(row["session_cycles"]),
        n_steps_used=sum(t.spatiotemporal.n_steps_used for t in pooled),
    )
    return from_row(lib.GaitMetrics, row, trials=trials, spatiotemporal=measures, gdi=index, qc=checks)


def pooled_cycles(key: Mapping[str, Any], rows: Rows) -> list[lib.GaitCycle]:
    """The library's `GaitMetrics.cycles` of one row of SessionGdi, by its key."""
    pace, out = gdi.pace_of(key["gdi_method"], rows), list[Any]()
    for video_id in videos_of(key, rows):
        of = {**key, "video_id": video_id}
        if video.condition(video_id, rows).pooled(pace):
            name = row_of(fit.SessionFit.Trial, _of(fit.SessionFit.Trial, of), rows)["trial_name"]
            out += load_cycles(_of(gait.GaitEvents, of), name, rows)
    return out


def _trial_metrics(key: Mapping[str, Any], pace: str, rows: Rows) -> lib.TrialMetrics:
    from pbl_pipeline import gait as lib

    name = row_of(fit.SessionFit.Trial, _of(fit.SessionFit.Trial, key), rows)["trial_name"]
    of_trial = _of(gait.GaitEvents, key)
    row = {**row_of(gait.GaitCycle, of_trial, rows), **row_of(gait.Spatiotemporal, of_trial, rows)}
    events = load_events(of_trial, rows)
    measures, reasons = gait.Spatiotemporal.Measure.measures(of_trial, lib.TRIAL_MEASURES, rows)
    measures = from_row(lib.Spatiotemporal, row, measures=measures, reasons=reasons)
    cycles = load_cycles(of_trial, name, rows)
    sides = {c.number: c.side for c in cycles}
    scores = rows(gdi.GDI.Cycle, key)
    scored = [from_row(GdiCycle, r, trial=name, side=sides[int(r["cycle_no"])]) for r in scores]
    checks = in_order(gdi.GDI.Check.records(key, rows))
    index = _index(gdi.GDI, row_of(gdi.GDI, key, rows), "gdi", scored, rows, qc=checks)
    pooled = video.condition(key["video_id"], rows).pooled(pace)
    return lib.TrialMetrics.of(name, events, cycles, measures, index, pooled)


def load_kinetics(key: Mapping[str, Any], rows: Rows = stored_rows) -> Kinetics | None:
    """The library's `Kinetics` of one row of SessionGdi, of several methods the one that was computed last; None if
    there are none."""
    from pbl_pipeline import kinetics as lib

    computed = rows(kinetics.Kinetics, _of(gdi.SessionGdi, key))
    if not computed:
        return None
    row = max(computed, key=lambda r: r["forces_computed"])
    row_key = _of(kinetics.Kinetics, row)
    measures, reasons = kinetics.Kinetics.Measure.measures(row_key, lib.MEASURES, rows)
    return from_row(
        Kinetics,
        row,
        measures={n: m for n, m in measures.items() if m is not None},
        reasons=reasons,
        method=row["kinetics_method"],
        params_hash=row["forces_method_hash"],
        trials=tuple(_trial_kinetics(r, rows) for r in rows(kinetics.Kinetics.Trial, row_key)),
        qc=in_order(kinetics.Kinetics.Check.records(row_key, rows)),
    )


def _trial_kinetics(row: Mapping[str, Any], rows: Rows) -> TrialKinetics:
    """The library's `TrialKinetics` of a row of Kinetics.Trial."""
    from pbl_pipeline import kinetics as lib
    from pbl_pipeline.kinetics.kinetics_file import load_arrays

    series, curves = None, {}
    if row["trial_forces"] is not None:
        series, curves = read_stored(file_ref(row["trial_forces"]), load_arrays)
    cycles = {r["cycle_no"]: r for r in rows(gait.GaitCycle.Cycle, _of(gait.GaitCycle, row))}

    def cycle(own: Mapping[str, Any]) -> CycleKinetics:
        about = cycles[own["cycle_no"]]
        measures = {n: float(own[n]) for n in lib.MEASURES if own[n] is not None}
        of_file = curves.get(int(own["cycle_no"]), {})
        side, used = about["cycle_side"], bool(about["cycle_used"])
        return from_row(CycleKinetics, own, side=side, used=used, measures=measures, **of_file)

    of_trial = {**_of(kinetics.Kinetics, row), "video_id": row["video_id"]}
    return from_row(
        TrialKinetics,
        row,
        name=row_of(fit.SessionFit.Trial, _of(fit.SessionFit.Trial, row), rows)["trial_name"],
        cycles=tuple(cycle(r) for r in rows(kinetics.Kinetics.Cycle, of_trial)),
        series=series,
    )


def _index(table: Any, row: Mapping[str, Any], prefix: str, cycles: Sequence[GdiCycle], rows: Rows, **more: Any) -> Gdi:
    """Index of a row of GDI or SessionGdi, with its profile; `more`: fields that are not columns of the row."""
    from pbl_pipeline.gait import NINE_ANGLES
    from pbl_pipeline.paramset import Paramset

    norm = row_of(gdi.NormativeSet, {"norm": row["norm"]}, rows)["norm_name"]
    method = row_of(gdi.GdiModel, {"gdi_method": row["gdi_method"]}, rows)
    name, params = method["gdi_method_name"], {**method["gdi_params"], "norm": norm}
    scores = {s.angle: s for s in table.Profile.records(_of(table, row), rows)}
    left, right = (
        {a: v for a in (*NINE_ANGLES, *scores) if a in scores and (v := getattr(scores[a], side)) is not None}
        for side in ("left", "right")
    )
    profile = from_row(MovementProfile, row, table.Profile.prefix, left=left, right=right) if scores else None
    return from_row(
        Gdi,
        row,
        prefix,
        n_left=sum(c.side == "left" for c in cycles),
        n_right=sum(c.side == "right" for c in cycles),
        norm=norm,
        model=name,
        params_hash=Paramset(gdi.GdiModel.stage, name, int(method["gdi_method_version"]), params).hash,
        cycles=tuple(cycles),
        profile=profile,
        **more,
    )
