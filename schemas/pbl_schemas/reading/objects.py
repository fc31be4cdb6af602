"""Rows back to the objects of the library, one stage at a time; `visits` puts them together."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.qc import in_order
from pbl_pipeline.records import from_row
from pbl_pipeline.results import CycleKinetics, Gdi, GdiCycle, KineticMeasure, Kinetics, Solution, TrialKinetics

from .. import fit, gait, gdi, keypoints, kinetics, tracking, video
from ..gait import load_cycles, load_events
from ..rows import Rows, row_of, stored_rows
from ..stored_files import file_ref, stored_file

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
    with stored_file(ref) as path:
        return Keypoints.load(path)


def load_trial_fit(key: Any, rows: Rows = stored_rows) -> TrialFit:
    """Return the library's `TrialFit` of one row of SessionFit.Trial, by its key or a query of it alone."""
    return fit.load_trial(file_ref(row_of(fit.SessionFit.Trial, _keys(key), rows)["trial_file"]))


def _keys(key: Any) -> Any:
    """Return a query without its other columns, on which DataJoint joins no table; any other restriction unchanged."""
    return key.proj() if hasattr(key, "proj") else key


def load_solution(key: Mapping[str, Any], rows: Rows = stored_rows) -> Solution:
    """The library's `Solution` of one row of SessionFit: how its body was fitted, without the fitted movements."""
    row = row_of(fit.SessionFit, _of(fit.SessionFit, key), rows)
    with stored_file(file_ref(row["session_file"])) as path, np.load(path, allow_pickle=False) as f:
        scale, trace = f["scale"], f["loss_trace"]
    found = from_row(
        Solution,
        row,
        params_hash=row["fit_method_hash"],
        scale=scale,
        loss_trace=trace,
        seconds=float(row["fit_seconds"]),
        software=row["fit_code_version"],
    )
    # NULL for fits older than this column: the trace ends with the last step
    return found if found.iterations is not None else dataclasses.replace(found, iterations=int(trace[-1, 0]))


def load_fit_checks(key: Any, rows: Rows = stored_rows) -> tuple[Check, ...]:
    """The library's `Check`s of one row of SessionFit."""
    return in_order(fit.SessionFit.Check.records(key, rows))


def load_tracking(key: Any) -> tracking_lib.Tracking:
    """The library's `Tracking` of one row."""
    row = (tracking.Tracking & key).fetch1()
    size = (video.VideoInfo & {"video_id": row["video_id"]}).fetch1("width", "height")
    with stored_file(file_ref(row["tracks"])) as path:
        return tracking.load_tracking(path, (int(size[0]), int(size[1])), row["detector"], row["tracking_model_sha256"])


def load_metrics(key: Any, rows: Rows = stored_rows) -> lib.GaitMetrics:
    """The library's `GaitMetrics` of one row of SessionGdi, from the rows of its trials and its own: nothing is
    recomputed but the checks of a trial's cycles."""
    from pbl_pipeline import gait as lib
    from pbl_pipeline.gait.metrics_file import INDEX_CHECKS

    row = row_of(gdi.SessionGdi, key, rows)
    row_key = _of(gdi.SessionGdi, row)
    pace = gdi.pace_of(row_key["gdi_method"], rows)
    trials = tuple(
        dataclasses.replace(
            _trial_metrics({**row_key, "video_id": v}, rows), pooled=video.condition(v, rows).pooled(pace)
        )
        for v in videos_of(row_key, rows)
    )
    pooled = [t for t in trials if t.pooled]
    norm_name, model, params_hash = _index_of(row_key, rows)
    checks = in_order(gdi.SessionGdi.Check.records(row_key, rows))
    index = from_row(
        Gdi,
        row,
        "session_gdi",
        status="PASS" if row["session_gdi"] is not None else "EMPTY",
        n_left=sum(t.gdi.n_left for t in pooled),
        n_right=sum(t.gdi.n_right for t in pooled),
        norm=norm_name,
        model=model,
        params_hash=params_hash,
        cycles=tuple(c for t in pooled for c in t.gdi.cycles),
        qc=tuple(c for c in checks if c.check in INDEX_CHECKS),
        profile=gdi.load_profile(gdi.SessionGdi.Profile, row_key, row, rows),
    )
    measures = _spatiotemporal(
        rows(gdi.SessionGdi.Measure, row_key),
        "session_measure",
        status=row["session_status"],
        reason=row["session_reason"],
        n_cycles_found=sum(t.spatiotemporal.n_cycles_found for t in pooled),
        n_cycles_used=int(row["session_cycles"]),
        n_steps_used=sum(t.spatiotemporal.n_steps_used for t in pooled),
    )
    return lib.GaitMetrics(
        trials=trials,
        status=row["session_status"],
        reason=row["session_reason"],
        spatiotemporal=measures,
        gdi=index,
        qc=tuple(checks),
        params_hash=row["session_params_hash"],
    )


def pooled_cycles(key: Mapping[str, Any], rows: Rows) -> list[lib.GaitCycle]:
    """The library's `GaitMetrics.cycles` of one row of SessionGdi, by its key."""
    pace, out = gdi.pace_of(key["gdi_method"], rows), list[Any]()
    for video_id in videos_of(key, rows):
        of = {**key, "video_id": video_id}
        if video.condition(video_id, rows).pooled(pace):
            name = row_of(fit.SessionFit.Trial, _of(fit.SessionFit.Trial, of), rows)["trial_name"]
            out += load_cycles(_of(gait.GaitEvents, of), name, rows)
    return out


def _trial_metrics(key: Mapping[str, Any], rows: Rows) -> lib.TrialMetrics:
    from pbl_pipeline import gait as lib

    name = row_of(fit.SessionFit.Trial, _of(fit.SessionFit.Trial, key), rows)["trial_name"]
    of_trial = _of(gait.GaitEvents, key)
    counts = row_of(gait.GaitCycle, of_trial, rows)
    row = row_of(gait.Spatiotemporal, of_trial, rows)
    events = load_events(of_trial, rows)
    measures = _spatiotemporal(
        rows(gait.Spatiotemporal.Measure, of_trial),
        "measure",
        status=row["measures_status"],
        reason=row["measures_reason"],
        n_cycles_found=int(counts["n_cycles"]),
        n_cycles_used=int(counts["n_cycles_used"]),
        n_steps_used=int(row["n_steps_used"]),
    )
    index, cycles = load_gdi(key, name, rows), tuple(load_cycles(of_trial, name, rows))
    reason = events.reason or measures.reason
    return lib.TrialMetrics(
        name=name,
        status="EMPTY" if reason else "PASS",
        reason=reason,
        events=events,
        cycles=cycles,
        spatiotemporal=measures,
        gdi=index,
        qc=(*events.qc, *lib.cycle_checks(measures, cycles), *index.qc),
    )


def load_gdi(key: Any, trial: str, rows: Rows = stored_rows) -> Gdi:
    """The library's `Gdi` of one row of GDI."""
    row = row_of(gdi.GDI, key, rows)
    norm_name, model, params_hash = _index_of(row, rows)
    sides = {int(r["cycle_no"]): r["cycle_side"] for r in rows(gait.GaitCycle.Cycle, _of(gait.GaitCycle, row))}
    cycles = tuple(
        from_row(GdiCycle, r, trial=trial, number=int(r["cycle_no"]), side=sides[int(r["cycle_no"])])
        for r in rows(gdi.GDI.Cycle, key)
    )
    return from_row(
        Gdi,
        row,
        "gdi",
        n_left=sum(c.side == "left" for c in cycles),
        n_right=sum(c.side == "right" for c in cycles),
        norm=norm_name,
        model=model,
        params_hash=params_hash,
        cycles=cycles,
        qc=in_order(gdi.GDI.Check.records(key, rows)),
        profile=gdi.load_profile(gdi.GDI.Profile, key, row, rows),
    )


def load_kinetics(key: Mapping[str, Any], rows: Rows = stored_rows) -> Kinetics | None:
    """The library's `Kinetics` of one row of SessionGdi, of several methods the one that was computed last; None if
    there are none."""
    from pbl_pipeline import kinetics as lib

    found = rows(kinetics.Kinetics, _of(gdi.SessionGdi, key))
    if not found:
        return None
    row = max(found, key=lambda r: r["forces_computed"])
    row_key = _of(kinetics.Kinetics, row)
    stored = {r["force_measure"]: r for r in rows(kinetics.Kinetics.Measure, row_key)}
    measures, reasons = {}, {}
    for name in (n for n in lib.MEASURES if n in stored):
        own = stored[name]
        if own["force_mean"] is None:
            reasons[name] = own["force_missing"]
            continue
        measures[name] = from_row(KineticMeasure, own, "force")
    return from_row(
        Kinetics,
        row,
        measures=measures,
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
        with stored_file(file_ref(row["trial_forces"])) as path:
            series, curves = load_arrays(path)
    cycles = {int(r["cycle_no"]): r for r in rows(gait.GaitCycle.Cycle, _of(gait.GaitCycle, row))}

    def cycle(own: Mapping[str, Any]) -> CycleKinetics:
        number_of = int(own["cycle_no"])
        about = gait.cycle_of_row(cycles[number_of], "")
        return CycleKinetics(
            number_of,
            about.side,
            about.used,
            measures={n: float(own[n]) for n in lib.MEASURES if own[n] is not None},
            missing=own["forces_missing"],
            **curves.get(number_of, {}),
        )

    of_trial = {**_of(kinetics.Kinetics, row), "video_id": row["video_id"]}
    return from_row(
        TrialKinetics,
        row,
        name=row_of(fit.SessionFit.Trial, _of(fit.SessionFit.Trial, row), rows)["trial_name"],
        cycles=tuple(cycle(r) for r in rows(kinetics.Kinetics.Cycle, of_trial)),
        series=series,
    )


def _index_of(key: Mapping[str, Any], rows: Rows) -> tuple[str, str, str]:
    """Names of the norm and the index, and the hash of the index with this norm."""
    from pbl_pipeline.paramset import Paramset

    norm = row_of(gdi.NormativeSet, {"norm": key["norm"]}, rows)["norm_name"]
    row = row_of(gdi.GdiModel, {"gdi_method": key["gdi_method"]}, rows)
    name, params = row["gdi_method_name"], {**row["gdi_params"], "norm": norm}
    return norm, name, Paramset(gdi.GdiModel.stage, name, int(row["gdi_method_version"]), params).hash


def _spatiotemporal(rows: list[dict], prefix: str, **fields: Any) -> lib.Spatiotemporal:
    """The library's `Spatiotemporal` from the rows of a Measure part table, measures in the library's order."""
    from pbl_pipeline import gait as lib

    by_name = {row[prefix]: row for row in rows}
    measures, reasons = {}, {}
    for name in (*lib.TRIAL_MEASURES, *sorted(set(by_name) - set(lib.TRIAL_MEASURES))):
        if name not in by_name:
            continue
        row = by_name[name]
        measures[name] = gait.measure_of_row(row, prefix)
        if row[f"{prefix}_missing"]:
            reasons[name] = row[f"{prefix}_missing"]
    return lib.Spatiotemporal(measures=measures, reasons=reasons, **fields)
