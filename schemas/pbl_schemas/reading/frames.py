"""Joined queries for analysts, as pandas tables. `pbl_schemas.activate()` must have been called."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from pymysql.converters import escape_string

from pbl_pipeline.records import from_row, names
from pbl_pipeline.results import Gdi, JointError
from pbl_pipeline.results.fits import TrialFigures
from pbl_pipeline.results.measures import interval_90

from .. import fit, gait, gdi, kinetics, lab, qc, session, study, tracking, validation, video
from ..datajoint_setup import dj
from ..stored_files import file_ref, read_stored

if TYPE_CHECKING:
    import pandas as pd

    from pbl_pipeline.validation import TrialErrors


#: Measures whose mean stands in the row of a trial; of a visit after `session_`.
_MEANS = [column for column, _ in gait.MEASURE_COLUMNS.values()][:6]
_SESSION_COLUMNS = (
    *("session_status", "session_reason", "session_cycles", *(f"session_{name}" for name in _MEANS)),
    *names(Gdi, "session_gdi", without=("status", "reason")),
)


def current_sets() -> Any:
    """Sets of recordings that are the newest of their session and kind, with subject and session."""
    sets = fit.FitSet.proj("session_id", "fit_set_kind", "fit_set_n")
    return fit.current() * sets * session.Session.proj("subject", "session_label", "session_date")


def newest_sets() -> Any:
    """Keys of the sets that are the newest of their session and kind, by method of the fit, with `session_id` and
    `fit_set_kind`."""
    return fit.FitSet.proj("session_id", "fit_set_kind") * fit.current().proj()


def _sessions() -> Any:
    return session.Session.proj("subject", "session_label", "session_date") * lab.Subject.proj("population")


def session_summary(restriction: Any = True) -> pd.DataFrame:
    """One row per visit, kind of recordings (`fit_set_kind`: single, rig, markers) and chain of methods: cadence,
    stride time, index, worst quality check.

    Columns carry the units of their tables (docs/tables.md): cadence steps/min, times s, stance and swing percent,
    residuals px and cm.
    """
    fits = fit.SessionFit.proj("fit_residual_2d", "fit_residual_3d", "fit_outcome")
    measures = gdi.SessionGdi.proj(*_SESSION_COLUMNS)
    quality = qc.SessionQc.proj("qc_outcome", "qc_worst")
    rows = frame_of(current_sets() * fits * measures * quality & restriction)
    return rows.sort_values("session_id", kind="stable", ignore_index=True)


def visit_frame(restriction: Any = True, chain: Any = True) -> pd.DataFrame:
    """One row per visit of a study, kind of recordings and chain of methods, also visits that have no measures: what it
    is in the study, measures and index of the current set, and every clinical score as a column of its instrument's
    name.

    `restriction` of the visits: `study.Visit`, subject, session label and date, population. `chain` of the methods
    and the kind, such as `{"fit_method": "blazepose-v5", "fit_set_kind": "single"}`, where the tables hold several
    chains.
    """
    visits = study.Visit * _sessions() & restriction
    sets = newest_sets()
    if restriction is not True:
        sets = sets & visits.proj()
    measures = sets * gdi.SessionGdi.proj(*_SESSION_COLUMNS, "session_gps", "session_gdi_reason") & chain
    rows = frame_of(visits).merge(frame_of(measures), how="left", on="session_id")
    rows = rows.merge(score_frame(restriction), how="left", on="session_id")
    return rows.sort_values(["subject", "session_date", "session_id"], ignore_index=True)


def score_frame(restriction: Any = True) -> pd.DataFrame:
    """Clinical scores as one row per visit (`session_id`) and a column per instrument that any visit has.

    The rows are turned by the server. `restriction`: of sessions, subjects and visits.
    """
    scores = study.ClinicalScore()
    if restriction is not True:
        scores = scores & (_sessions() * study.Visit & restriction).proj()
    names = sorted((dj.U("instrument") & scores).to_arrays("instrument"))
    # DataJoint's names have no capitals and begin with a letter: numbers there, the instruments' names here.
    wide = {f"score_{i}": f"max(if(instrument = '{escape_string(n)}', score_value, null))" for i, n in enumerate(names)}
    found = frame_of(dj.U("session_id").aggr(scores, **wide)) if names else frame_of(scores.proj())
    return found.rename(columns={f"score_{i}": n for i, n in enumerate(names)})[["session_id", *names]]


def frame_of(query: Any) -> Any:
    """The rows of a query as a frame of pandas, keys as columns, of numbers, texts and dates only.

    A third of the time of DataJoint's `to_pandas`, which looks at each value whether it has to be decoded.
    """
    import pandas as pd

    return pd.DataFrame(list(query.cursor().fetchall()), columns=list(query.heading.names))


def force_frame(restriction: Any = True) -> pd.DataFrame:
    """One row per visit, chain of methods and measure of forces and joint moments (`force_measure`, with its unit), of
    the current sets: mean of both sides with its 90 % interval (`force_low`, `force_high`), both sides, asymmetry;
    null if unknown, with the reason in `force_missing`."""
    forces = kinetics.Kinetics.proj("forces_status", "forces_code", "forces_mass", "forces_aid", "forces_residual")
    found = frame_of(current_sets() * forces * kinetics.Kinetics.Measure & restriction)
    bounds = [interval_90(*v) or (math.nan, math.nan) for v in zip(found["force_mean"], found["force_sd"], strict=True)]
    found = found.assign(force_low=[low for low, _ in bounds], force_high=[high for _, high in bounds])
    return found.sort_values(["session_id", "force_measure"], kind="stable", ignore_index=True)


def index_frame() -> pd.DataFrame:
    """One row per visit, kind of recordings, method and norm of the index, with the columns of
    `pbl_pipeline.validation.INDEX_COLUMNS`: `norm_kind` is the kind whose cycles the norm was built from."""
    import pandas as pd

    from pbl_pipeline.validation import INDEX_COLUMNS

    found = current_sets() * gdi.SessionGdi.proj("session_gdi_unshrunk") * gdi.NormativeSet.proj("norm_query")
    rows = found.to_dicts(order_by="session_id")
    renamed = [
        {
            **row,
            "kind": row["fit_set_kind"],
            "method": row["gdi_method"],
            "norm_kind": ((row["norm_query"] or {}).get("methods") or {}).get("fit_set_kind", ""),
            "index": row["session_gdi_unshrunk"],
        }
        for row in rows
    ]
    return pd.DataFrame(renamed, columns=list(INDEX_COLUMNS))


def cycle_frame(restriction: Any = True, chain: Any = True) -> pd.DataFrame:
    """One row per gait cycle that is used, with its index: of the current fits of the visits of `restriction`, as for
    `visit_frame`. Times in s, lengths in m; `activity` and `pace` say what is done in its video ("unknown" where it is
    not stated). Set-based: no file is read.
    """
    sets = newest_sets()
    sets = sets & (_sessions() & restriction).proj() if restriction is not True else sets
    return cycle_rows(sets, chain)


def cycle_rows(sets: Any, chain: Any) -> Any:
    """The frame of `cycle_frame` for sets of videos (with `session_id`). `pool`: the pace that pools the cycle."""
    columns = ("cycle_side", "cycle_start", "cycle_foot_up", "cycle_end", "cycle_stride_length", "cycle_step_length")
    cycles = (gait.GaitCycle.Cycle & {"cycle_used": True}).proj(*columns)
    found = frame_of(cycles * gdi.GDI.Cycle.proj("cycle_gdi") * sets & chain)
    done = video.conditions(fit.FitSet.Video & sets)
    for name in ("activity", "pace"):
        found[name] = found["video_id"].map({k: getattr(c, name) for k, c in done.items()})
    found["pool"] = found["video_id"].map({k: c.pool for k, c in done.items()})
    return found


def cycle_curves(restriction: Any = True) -> pd.DataFrame:
    """Mean joint-angle curves of each visit beside the normal band at the person's speed.

    One row per visit, chain of methods, side, angle and percent of the cycle, with the columns of
    `pbl_pipeline.gait.curve_frame` (degrees) and `normal_matched`: how the band was matched ("speed", "cadence" or "").
    Reads the stored curves of these visits.
    """
    import pandas as pd

    from pbl_pipeline import gait as lib

    names = ["subject", "session_label", "session_id", "fit_set", "fit_method", "gait_method", "gdi_method", "norm"]
    parts = [pd.DataFrame(columns=[*names, *lib.CURVE_FRAME_COLUMNS, "normal_matched"])]
    visits = current_sets() * fit.SessionFit.proj("fit_scale") * gdi.SessionGdi.proj("session_status")
    for row in (visits & {"session_status": "PASS"} & restriction).to_dicts(order_by="session_id"):
        key = {k: row[k] for k in gdi.SessionGdi.primary_key}
        measures = gdi.SessionGdi.Measure.measures(key)[0]
        leg_m = lib.leg_length_m(row["fit_scale"])
        bands = lib.normal_bands(measures, leg_m)
        done, pace = video.conditions(fit.SessionFit.Trial & key), gdi.pace_of(key["gdi_method"])
        keys = (gait.GaitCycle & key).keys()
        cycles = [c for k in keys if done[k["video_id"]].pooled(pace) for c in gait.load_cycles(k)]
        frame = lib.curve_frame(cycles, bands).assign(normal_matched=bands.matched)
        parts.append(pd.DataFrame({n: [row[n]] * len(frame) for n in names}).join(frame))
    return pd.concat([p for p in parts if len(p)] or parts, ignore_index=True)


def trial_summary(restriction: Any = True) -> pd.DataFrame:
    """One row per fitted video: residuals, where the vertical comes from, events, measures and index of the trial."""
    trials = fit.SessionFit.Trial.proj(*names(TrialFigures, "trial"))
    events = gait.GaitEvents.proj("events_status", "events_reason", "n_events")
    cycles = gait.GaitCycle.proj("n_cycles", "n_cycles_used")
    measures = gait.Spatiotemporal.proj(*_MEANS)
    index = gdi.GDI.proj(*names(Gdi, "gdi", without=("status", "reason")))
    joined = current_sets() * trials * events * cycles * measures * index
    return (joined & restriction).to_pandas(order_by="video_id").reset_index()


def video_summary(restriction: Any = True) -> pd.DataFrame:
    """One row per video that was tracked: who was chosen, why, and how well she was seen."""
    probed = video.VideoInfo.proj("duration", "n_frames", "fps")
    chosen = tracking.SubjectChoice.proj("choice_status", "chosen_person_id", "choice_score", "choice_reason")
    named = video.Video.proj("session_id", "video_name") * session.Session.proj("subject", "session_label")
    return (named * probed * chosen & restriction).to_pandas(order_by="video_id").reset_index()


def quality_summary(restriction: Any = True) -> pd.DataFrame:
    """Return all checks of the current visits that are not PASS, with value, threshold and advice."""
    checks = qc.SessionQc.Check & "qc_check_outcome != 'PASS'"
    return (current_sets() * checks & restriction).to_pandas(order_by="session_id, qc_no").reset_index()


def validation_frame(restriction: Any = True) -> pd.DataFrame:
    """Errors of the current fits against the current references, one row per trial, reference and joint.

    The frame of `pbl_pipeline.validation.error_frame`: errors in degrees, lag in s, RTE in m, residuals in px and cm.
    Dataset, population, activity and camera are those of the reference, the subject and the video.
    """
    from pbl_pipeline.validation import error_frame

    return error_frame(row for _, row in _compared(restriction))


def validation_curves(frame: pd.DataFrame) -> pd.DataFrame:
    """Joint angles of fit and reference over the same gait cycles, for the trials in a `validation_frame`.

    The frame of `pbl_pipeline.validation.cycle_curves` (degrees at 0, 1, ..., 100 % of each used cycle), with the
    methods in `trial`. Reads the stored fits and references of these trials.
    """
    import pandas as pd

    from pbl_pipeline import validation as lib

    wanted = set(zip(frame["trial"], frame["detector"], frame["solver"], strict=True))
    parts = [pd.DataFrame(columns=list(lib.CURVE_COLUMNS))]
    for key, row in _compared():
        if (row.trial, row.detector, row.solver) not in wanted:
            continue
        trial = fit.load_trial(file_ref((fit.SessionFit.Trial & key).fetch1("trial_file")))
        references = validation.ReferenceKinematics
        truth = read_stored(file_ref((references & key).fetch1("reference_file")), lib.Reference.load)
        for method in dict.fromkeys(r["gait_method"] for r in (gait.GaitCycle & key).proj().to_dicts()):
            of_method = {**key, "gait_method": method}
            cycles = [
                gait.cycle_of_row(r, trial.name)
                for r in (gait.GaitCycle.Cycle & of_method).to_dicts(order_by="cycle_no")
            ]
            curves = lib.cycle_curves(trial, truth, cycles, row.errors)
            parts.append(curves.assign(trial=", ".join((row.trial, row.detector, row.solver, method))))
    return pd.concat([p for p in parts if len(p)] or parts, ignore_index=True)


def _compared(restriction: Any = True) -> Iterator[tuple[dict[str, Any], TrialErrors]]:
    """Key and `TrialErrors` of each current fit against each current reference of its video."""
    from pbl_pipeline.validation import KinematicErrors, TrialErrors

    references = validation.ReferenceKinematics & {"reference_current": True}
    compared = (
        validation.KinematicError
        * references.proj("dataset", "reference_name", "reference_source", "reference_convention")
        * fit.current().proj()
        * fit.SessionFit.Trial.proj("trial_name", "trial_residual_2d", "trial_residual_3d")
        * fit.FitSet.Video.proj("keypoint_method")
        * video.Video.proj("session_id", "activity", "camera_motion")
        * session.Session.proj("subject")
        * lab.Subject.proj("population")
    ) & restriction
    names = validation.KinematicError.primary_key
    joints: dict[tuple, list[JointError]] = {}
    for row in (validation.KinematicError.Joint & compared.proj()).to_dicts(order_by="KEY"):
        joints.setdefault(tuple(row[k] for k in names), []).append(from_row(JointError, row))
    found = compared.to_dicts(order_by="video_id, fit_set, fit_method, reference")
    n_references = Counter((row["fit_set"], row["fit_method"], row["video_id"]) for row in found)
    for row in found:
        # The number, because files of several visits may have one name.
        trial = f"{row['video_id']} {row['trial_name']}"
        if n_references[row["fit_set"], row["fit_method"], row["video_id"]] > 1:
            trial += f" against {row['reference_source']}"
        key = {k: row[k] for k in names}
        about = TrialErrors(
            errors=from_row(KinematicErrors, row, joints=tuple(joints.get(tuple(key.values()), ()))),
            # One of several cameras stands still, fitted together with the others or alone.
            camera="handheld" if row["camera_motion"] == "handheld" else "static",
            trial=trial,
            detector=row["keypoint_method"] or fit.LABORATORY,
            solver=row["fit_method"],
            **{k: row[k] for k in ("dataset", "subject", "population", "activity")},
        )
        yield key, about
