"""Rows back to the library's objects: what a report, a demo or an analyst works with."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.errors import PblError

from . import fit, gait, gdi, keypoints, session, tracking, video
from .chain import before
from .checks import check_values
from .coded_errors import error_code, error_found
from .jobs import jobs_of
from .method_names import with_keys
from .rows import Rows, number, row_of, stored_rows
from .stored_files import file_ref, stored_file
from .usable import unusable

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib
    from pbl_pipeline import tracking as tracking_lib
    from pbl_pipeline.fit import SessionFit, TrialFit
    from pbl_pipeline.keypoints import Keypoints
    from pbl_pipeline.qc import Check
    from pbl_pipeline.video import VideoInfo


@dataclasses.dataclass(frozen=True)
class TrialResults:
    """One recording of a session. What a stage did not produce is None, with a sentence in `problem`."""

    video_id: int
    name: str
    path: Path
    info: VideoInfo | None = None
    tracking: tracking_lib.Tracking | None = None
    choice: tracking_lib.SubjectChoice | None = None
    keypoints: Keypoints | None = None
    fit: TrialFit | None = None
    events: lib.GaitEvents | None = None
    cycles: tuple[lib.GaitCycle, ...] = ()
    problem: str = ""
    is_markers: bool = False


@dataclasses.dataclass(frozen=True)
class FittedTrial:
    """One video of a session that has a fit, and so everything a fit is computed from."""

    video_id: int
    name: str
    path: Path
    info: VideoInfo
    tracking: tracking_lib.Tracking
    choice: tracking_lib.SubjectChoice
    keypoints: Keypoints
    fit: TrialFit
    events: lib.GaitEvents | None
    cycles: tuple[lib.GaitCycle, ...]


@dataclasses.dataclass(frozen=True)
class SessionResults:
    """A visit: its trials in the order of their numbers, the fit and the measures of the current set."""

    session_id: int
    subject: str
    session_label: str
    session_date: datetime.date | None
    trials: tuple[TrialResults, ...]
    fit: SessionFit | None = None
    metrics: lib.GaitMetrics | None = None
    key: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def fitted(self) -> tuple[FittedTrial, ...]:
        """The trials that have a fit, in the order of `fit.trials` and `metrics.trials`.

        Raises `PblError` USAGE where they are laboratory markers: what reads them wants the video, too.
        """
        if any(t.fit is not None and t.is_markers for t in self.trials):
            raise of_markers(self.subject, self.session_label)
        return tuple(_fitted(t) for t in self.trials if t.fit is not None)


def of_markers(subject: str, session_label: str) -> PblError:
    """A `PblError` USAGE: the fit of a session is one of laboratory markers, where a video's is wanted."""
    return PblError(
        "USAGE",
        found=f"laboratory markers of session {session_label!r}",
        expected="the fit of a video",
        next_step="name the kind of the videos, single or rig; measures and curves of markers are in "
        "`schemas.views`, and `pbl fit FILE`, `pbl gait` write theirs as files",
        key=f"subject {subject}",
    )


def find_session(restriction: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """One session (row of Session) and the key of its current fit and of its measures, as far as there are any.

    restriction and errors are those of `load_session`.
    """
    if isinstance(restriction, Mapping):
        restriction = with_keys(restriction)
    found = (session.Session & restriction).to_dicts()
    if not found:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no session for {restriction}",
            expected="a registered session",
            next_step="`pbl ingest` prints subject and session of each video",
        )
    visit = _single(found, "visits", ("subject", "session_label"))
    current = fit.SessionFit * fit.current() * fit.FitSet.proj("fit_set_kind")
    fits = (current & {"session_id": visit["session_id"]} & restriction).proj("fit_set_kind").to_dicts()
    key = (
        _of(fit.SessionFit, _single(fits, "fits", ("fit_set_kind", *fit.SessionFit.primary_key[::-1]))) if fits else {}
    )
    measured = (gdi.SessionGdi & key & restriction).keys() if key else []
    return visit, {**key, **(_single(measured, "results", gdi.SessionGdi.primary_key) if measured else {})}


def load_session(restriction: Any) -> SessionResults:
    """Everything the tables hold of one session.

    Parameters
    ----------
    restriction
        What picks one session and, where several methods were used, one chain of methods: a dict such as
        `{"subject": "P017", "session_label": "2026-03-01", "fit_method": "paper-2025"}`; `fit_set_kind` where it has
        recordings of one camera, of several, or markers.

    Raises
    ------
    PblError
        DB_NOT_FOUND when no session matches, USAGE when several sessions or chains match, SOLVER_UNKNOWN and
        NORM_UNKNOWN for methods that there are not.
    """
    if isinstance(restriction, Mapping):
        restriction = with_keys(restriction)
    visit, key = find_session(restriction)
    chain = {"session_id": int(visit["session_id"])}
    session_fit = load_session_fit(key) if key else None
    fit_by_video = dict(zip(videos_of(key), session_fit.trials, strict=True)) if session_fit else {}
    metrics = load_metrics(key) if "norm" in key else None
    # Videos of one camera, of several, and markers are fitted apart: beside a fit of one kind the others are not left
    # out.
    rows = (video.Video & chain).to_dicts(order_by="video_id")
    trial_of = fit.trials_of([int(r["video_id"]) for r in rows])
    if key:
        kind = (fit.FitSet & key).fetch1("fit_set_kind")
        rows = [r for r in rows if _kind_of(r, trial_of) == kind]
    rows = [r for r in rows if trial_of.get(int(r["video_id"]), int(r["video_id"])) == int(r["video_id"])]
    by_name = {t.name: t for t in metrics.trials} if metrics else {}
    trials = tuple(_trial(row, restriction, fit_by_video.get(int(row["video_id"])), by_name) for row in rows)
    return SessionResults(
        session_id=int(visit["session_id"]),
        subject=visit["subject"],
        session_label=visit["session_label"],
        session_date=visit["session_date"],
        trials=trials,
        fit=session_fit,
        metrics=metrics,
        key=key,
    )


def _kind_of(row: Mapping[str, Any], trial_of: Mapping[int, int]) -> str:
    """The kind of set that a recording (row of Video) belongs to."""
    if row["camera_motion"] == video.NO_CAMERA:
        return fit.MARKERS
    return fit.RIG if int(row["video_id"]) in trial_of else fit.SINGLE


def not_finished(found: SessionResults, what: str) -> PblError:
    """A `PblError` DB_NOT_FOUND for a session that lacks `what`, with what is wrong with its trials."""
    problems = "; ".join(f"{t.name}: {t.problem}" for t in found.trials if t.problem)
    return PblError(
        "DB_NOT_FOUND",
        found=f"no finished {what} of session {found.session_label!r}. {problems}".strip(),
        expected="a session that was populated",
        next_step="run `pbl populate`, then `pbl status`",
        key=f"subject {found.subject}",
    )


#: Column -> the option of `pbl report` and `pbl export` that names it.
_OPTIONS = {
    "subject": "--subject",
    "session_label": "--session",
    "fit_set_kind": "--kind",
    "fit_method": "--fit-method",
}


def _single(rows: list[dict], what: str, columns: Sequence[str]) -> dict:
    """The one row; `columns`: what can tell several apart, by which the error names them."""
    if len(rows) == 1:
        return rows[0]
    values = {c: sorted({str(row[c]) for row in rows}) for c in columns}
    differ = [c for c in columns if len(values[c]) > 1]
    first = differ[0]
    ways = [f"`{_OPTIONS[first]} {v}`" for v in values[first][:4]] if first in _OPTIONS else []
    raise PblError(
        "USAGE",
        found=f"{len(rows)} {what} match: " + "; ".join(f"{c} {', '.join(values[c][:8])}" for c in differ),
        expected="one",
        next_step=" or ".join(["add " + ways[0], *ways[1:]]) if ways else f"name one {first} in the restriction",
    )


def videos_of(key: Mapping[str, Any], rows: Rows = stored_rows) -> list[int]:
    """Numbers of the trials of a fit, in the order of its `trials`."""
    return [int(r["video_id"]) for r in rows(fit.SessionFit.Trial, _of(fit.SessionFit, key))]


def _of(table: Any, key: Mapping[str, Any]) -> dict[str, Any]:
    """What of a key belongs to a table."""
    return {name: key[name] for name in table.primary_key if name in key}


def load_keypoints(key: Any, rows: Rows = stored_rows) -> Keypoints:
    """The library's `Keypoints` of one row, named by its key or by a query that holds it alone."""
    from pbl_pipeline.keypoints import Keypoints

    ref = file_ref(row_of(keypoints.Keypoints, _keys(key), rows)["keypoints_file"])
    with stored_file(keypoints.Keypoints(), ref) as path:
        return Keypoints.load(path)


def load_trial_fit(key: Any, rows: Rows = stored_rows) -> TrialFit:
    """The library's `TrialFit` of one row of SessionFit.Trial, named by its key or by a query that holds it alone."""
    from pbl_pipeline.fit import TrialFit

    ref = file_ref(row_of(fit.SessionFit.Trial, _keys(key), rows)["trial_file"])
    with stored_file(fit.SessionFit(), ref) as path:
        return TrialFit.load(path)


def _keys(key: Any) -> Any:
    """A query without its other columns, by which DataJoint joins no table; any other restriction as it is."""
    return key.proj() if hasattr(key, "proj") else key


def load_session_fit(key: Any) -> SessionFit:
    """The library's `SessionFit` of one row, its trials in the order of their video numbers."""
    from pbl_pipeline.fit import SessionFit

    row = row_of(fit.SessionFit, key)
    with stored_file(fit.SessionFit(), file_ref(row["session_file"])) as path, np.load(path, allow_pickle=False) as f:
        arrays = {k: f[k] for k in f.files}
    trials = tuple(load_trial_fit({**key, "video_id": v}) for v in videos_of(key))
    return SessionFit(
        trials=trials,
        scale=arrays["scale"],
        site_offset_m=arrays["site_offset_m"],
        loss_trace=arrays["loss_trace"],
        # null for fits of before these were recorded: the trace ends with the last step, convergence is unknown
        iterations=int(arrays["loss_trace"][-1, 0] if row["fit_iterations"] is None else row["fit_iterations"]),
        converged=None if row["fit_converged"] is None else bool(row["fit_converged"]),
        solver=row["solver"],
        params_hash=row["fit_method_hash"],
        seconds=float(row["fit_seconds"]),
        compile_seconds=float(row["compile_seconds"]),
        device=row["compute_device"],
        qc=tuple(load_fit_checks(key)),
    )


def load_fit_checks(key: Any, rows: Rows = stored_rows) -> list[Check]:
    """The library's `Check`s of one row of SessionFit."""
    return _checks(rows(fit.SessionFit.Check, key), "fit")


def load_info(key: Any) -> VideoInfo:
    """The library's `VideoInfo` of one video."""
    row = (video.Video * video.VideoInfo & key).fetch1()
    return video.info_of_row(row, row["frame_time"].load())


def load_tracking(key: Any) -> tracking_lib.Tracking:
    """The library's `Tracking` of one row."""
    row = (tracking.Tracking & key).fetch1()
    size = (video.VideoInfo & {"video_id": row["video_id"]}).fetch1("width", "height")
    with stored_file(tracking.Tracking(), file_ref(row["tracks"])) as path:
        return tracking.load_tracking(path, (int(size[0]), int(size[1])), row["detector"], row["tracking_model_sha256"])


def load_choice(key: Any) -> tracking_lib.SubjectChoice:
    """The library's `SubjectChoice` of one row."""
    from pbl_pipeline.tracking import SubjectChoice

    row = (tracking.SubjectChoice & key).fetch1()
    nan = float("nan")
    return SubjectChoice(
        status=row["choice_status"],
        person_id=None if row["chosen_person_id"] is None else int(row["chosen_person_id"]),
        score=nan if row["choice_score"] is None else float(row["choice_score"]),
        runner_up_id=None if row["runner_up_id"] is None else int(row["runner_up_id"]),
        runner_up_score=nan if row["runner_up_score"] is None else float(row["runner_up_score"]),
        scores={int(k): nan if v is None else float(v) for k, v in row["choice_scores"].items()},
        reason=row["choice_reason"],
    )


def load_events(key: Any, rows: Rows = stored_rows) -> lib.GaitEvents:
    """The library's `GaitEvents` that the cycles of a trial were made from: detected ones, or corrected by hand."""
    return gait.load_events(key, rows)


def load_cycles(key: Any, trial: str, rows: Rows = stored_rows) -> tuple[lib.GaitCycle, ...]:
    """The library's `GaitCycle`s of one row, with their curves."""
    return tuple(gait.load_cycles(key, trial, rows))


def _checks(rows: Sequence[Mapping[str, Any]], prefix: str) -> list[Check]:
    from pbl_pipeline.qc import Check

    return [Check(*check_values(prefix, row)) for row in rows]


def load_metrics(key: Any, rows: Rows = stored_rows) -> lib.GaitMetrics:
    """The library's `GaitMetrics` of one row of SessionGdi, from the rows of its trials and its own: nothing is
    computed anew but the checks of a trial's cycles."""
    from pbl_pipeline import gait as lib

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
    norm_name, model = _names(row_key, rows)
    checks = _checks(rows(gdi.SessionGdi.Check, row_key), "gdi")
    index = lib.Gdi(
        status="PASS" if row["session_gdi"] is not None else "EMPTY",
        reason=row["session_gdi_reason"],
        left=number(row["session_gdi_left"]),
        right=number(row["session_gdi_right"]),
        mean=number(row["session_gdi"]),
        sd=number(row["session_gdi_sd"]),
        minimal_change=number(row["session_gdi_minimal_change"]),
        n=int(row["session_gdi_n"]),
        n_left=sum(t.gdi.n_left for t in pooled),
        n_right=sum(t.gdi.n_right for t in pooled),
        norm=norm_name,
        model=model,
        params_hash=row["session_gdi_method_hash"],
        cycles=tuple(c for t in pooled for c in t.gdi.cycles),
        qc=tuple(c for c in checks if c.check in _INDEX_CHECKS),
        profile=gdi.profile_of_rows(rows(gdi.SessionGdi.Profile, row_key), row, "session"),
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


#: Checks of the index among the checks of a session; the others are of the measures.
_INDEX_CHECKS = ("gdi_cycles", "gdi_explained", "norm_convention")


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
    index, cycles = load_gdi(key, name, rows), load_cycles(of_trial, name, rows)
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


def load_gdi(key: Any, trial: str, rows: Rows = stored_rows) -> lib.Gdi:
    """The library's `Gdi` of one row of GDI."""
    from pbl_pipeline import gait as lib

    row = row_of(gdi.GDI, key, rows)
    norm_name, model = _names(row, rows)
    sides = {int(r["cycle_no"]): r["cycle_side"] for r in rows(gait.GaitCycle.Cycle, _of(gait.GaitCycle, row))}
    cycles = tuple(
        lib.GdiCycle(
            trial=trial,
            number=int(r["cycle_no"]),
            side=sides[int(r["cycle_no"])],
            gdi=float(r["cycle_gdi"]),
            z=float(r["cycle_z"]),
            explained=float(r["cycle_explained"]),
        )
        for r in rows(gdi.GDI.Cycle, key)
    )
    return lib.Gdi(
        status=row["gdi_status"],
        reason=row["gdi_reason"],
        left=number(row["gdi_left"]),
        right=number(row["gdi_right"]),
        mean=number(row["gdi"]),
        sd=number(row["gdi_sd"]),
        minimal_change=number(row["gdi_minimal_change"]),
        n=int(row["gdi_n"]),
        n_left=sum(c.side == "left" for c in cycles),
        n_right=sum(c.side == "right" for c in cycles),
        norm=norm_name,
        model=model,
        params_hash=row["gdi_method_hash"],
        cycles=cycles,
        qc=tuple(_checks(rows(gdi.GDI.Check, key), "index")),
        profile=gdi.profile_of_rows(rows(gdi.GDI.Profile, key), row, "gdi"),
    )


def _names(key: Mapping[str, Any], rows: Rows) -> tuple[str, str]:
    norm = row_of(gdi.NormativeSet, {"norm": key["norm"]}, rows)["norm_name"]
    return norm, row_of(gdi.GdiModel, {"gdi_method": key["gdi_method"]}, rows)["gdi_method_name"]


def _spatiotemporal(rows: list[dict], prefix: str, **fields: Any) -> lib.Spatiotemporal:
    """The library's `Spatiotemporal` from the rows of a Measure part table, measures in the library's order."""
    from pbl_pipeline import gait as lib

    by_name = {row[prefix]: row for row in rows}
    measures, reasons = {}, {}
    for name in (*lib.MEASURES, *sorted(set(by_name) - set(lib.MEASURES))):
        if name not in by_name:
            continue
        row = by_name[name]
        measures[name] = gait.measure_of_row(row, prefix)
        if row[f"{prefix}_missing"]:
            reasons[name] = row[f"{prefix}_missing"]
    return lib.Spatiotemporal(measures=measures, reasons=reasons, **fields)


def _trial(
    row: Mapping[str, Any], restriction: Any, fitted: TrialFit | None, metrics: Mapping[str, lib.TrialMetrics]
) -> TrialResults:
    key = {"video_id": int(row["video_id"])}
    name = fitted.name if fitted is not None else Path(row["video_name"]).stem
    markers = row["camera_motion"] == video.NO_CAMERA
    out = TrialResults(key["video_id"], name, Path(row["video_path"]), fit=fitted, is_markers=markers)
    found: dict[str, Any] = {}
    if video.VideoInfo & key:
        found["info"] = load_info(key)
    chain = tracking.Tracking & key & restriction
    if chain:
        track_key = _single(chain.keys(), "trackings", chain.primary_key)
        found["tracking"] = load_tracking(track_key)
        if tracking.SubjectChoice & track_key:
            found["choice"] = load_choice(track_key)
    points = (keypoints.Keypoints & key & restriction).keys()
    if points:
        found["keypoints"] = load_keypoints(_single(points, "keypoints", keypoints.Keypoints.primary_key))
    if fitted is not None and name in metrics:
        found["events"], found["cycles"] = metrics[name].events, metrics[name].cycles
    return dataclasses.replace(out, **found, problem=_problem(key, found.get("choice"), fitted))


def _fitted(trial: TrialResults) -> FittedTrial:
    names = [f.name for f in dataclasses.fields(FittedTrial)]
    values = {name: getattr(trial, name) for name in names}
    absent = [name for name, value in values.items() if value is None and name != "events"]
    assert not absent, f"foreign keys of a fit ensure {absent}"
    return FittedTrial(**values)


def _problem(key: Mapping[str, Any], choice: tracking_lib.SubjectChoice | None, fitted: TrialFit | None) -> str:
    """Why a video has no fit, in a sentence."""
    if fitted is not None:
        return ""
    if mark := unusable([key["video_id"]]):
        return f"not usable: {mark[key['video_id']].text}"
    for table in before(fit.SessionFit):
        for row in (jobs_of(table).errors & key).to_dicts():
            message = row["error_message"]
            return f"{table.__name__}: {error_code(message)}, {error_found(message)}"
    if choice is not None and choice.status not in tracking.CHOSEN:
        return choice.reason
    return "not computed yet"
