"""Visits from the tables as `pbl_pipeline.export` takes them; nothing is computed anew."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import distinct

from . import fit, gdi, keypoints, session, video
from . import gait as gait_tables
from .archive import plain_name
from .method_names import with_keys
from .report import methods_of
from .results import (
    find_session,
    load_fit_checks,
    load_keypoints,
    load_metrics,
    load_session,
    load_trial_fit,
    not_finished,
    of_markers,
    videos_of,
)
from .rows import ReadAhead, Rows, inside, row_of, stored_rows
from .stored_files import file_ref, stored_file
from .studies.slices import chain_of

if TYPE_CHECKING:
    from pbl_pipeline.export import ExportSession, ExportTrial
    from pbl_pipeline.gait import TrialMetrics

#: Visits whose rows are read together: few questions to the database, and memory that does not grow with the visits.
_TOGETHER = 50


def session_of_tables(restriction: Any, *, sensors: bool = True, gait: bool = True) -> ExportSession:
    """The fitted trials of one session; with `sensors` the phones' logs, with `gait` events, cycles and measures.

    Raises
    ------
    PblError
        DB_NOT_FOUND when the session is unknown or not fitted yet, USAGE when several match, PHONE_LOG for a stored log
        that is not the one the keypoints were made with.
    """
    visit, key = find_session(restriction)
    if not key:
        raise not_finished(load_session(restriction), "fit")
    return _session({**visit, **key}, stored_rows, sensors, gait)


def visits_of_tables(restriction: Mapping[str, Any], slice_name: str | None = None) -> list[dict[str, Any]]:
    """The fitted visits that a restriction allows, in the order of subject and session: rows with `subject`,
    `session_label`, `folder` (subject and session as the names of a folder in a folder) and the key of the fit and its
    measures.

    Parameters
    ----------
    restriction
        Subject, session, methods (short names too), `fit_set_kind`.
    slice_name
        The visits that count in this slice alone, with the sets and methods that it was frozen with.

    Raises
    ------
    PblError
        DB_NOT_FOUND for an unknown slice or where no visit is left, USAGE where a visit has several kinds of recordings
        or chains of methods, SOLVER_UNKNOWN and NORM_UNKNOWN.
    """
    sets: Any = fit.current()
    restriction = with_keys(restriction)
    if slice_name is not None:
        chain, counted = chain_of(slice_name)
        restriction, sets = {**restriction, **chain}, fit.FitSelection & inside("fit_set", counted)
    fits = fit.SessionFit.proj("session_id") * fit.FitSet.proj("fit_set_kind") * sets.proj()
    fits = fits * session.Session.proj("subject", "session_label") & restriction
    found = {
        (r["fit_set"], r["fit_method"]): r for r in fits.to_dicts(order_by="subject, session_id, fit_set, fit_method")
    }
    measured: dict[tuple, list[dict[str, Any]]] = {}
    of_sets = (gdi.SessionGdi.proj() & sets.proj() & restriction).to_dicts(order_by="KEY")
    for row in gait_tables.without_uncorrected(of_sets):
        measured.setdefault((row["fit_set"], row["fit_method"]), []).append(row)
    visits = [{**row, **more} for key, row in found.items() for more in measured.get(key, [{}])]
    if not visits:
        raise PblError(
            "DB_NOT_FOUND",
            found="no fitted visit" + (f" for {restriction}" if restriction else ""),
            expected="at least one",
            next_step="`pbl populate`; `pbl list visits` shows what is computed",
        )
    for one, other in itertools.pairwise(visits):
        if one["session_id"] == other["session_id"]:
            differ = [
                k
                for k in ("fit_set_kind", "fit_method", "gait_method", "gdi_method", "norm")
                if one.get(k) != other.get(k)
            ]
            raise PblError(
                "USAGE",
                key=f"subject {one['subject']}, session {one['session_label']}",
                found="results by several chains: " + "; ".join(f"{k} {one.get(k)} and {other.get(k)}" for k in differ),
                expected="one kind of recordings and chain of methods of each visit",
                next_step="name one with --kind or --fit-method, or pass --slice with a slice that was frozen",
            )
    names = distinct(
        [f"{v['subject']}/{plain_name(v['session_label'])}" for v in visits], [v["session_id"] for v in visits]
    )
    return [{**v, "folder": name} for v, name in zip(visits, names, strict=True)]


def sessions_of_tables(
    visits: Sequence[Mapping[str, Any]], *, sensors: bool = True, gait: bool = True
) -> Iterator[tuple[Mapping[str, Any], ExportSession | PblError]]:
    """Each of `visits_of_tables` with what `session_of_tables` returns or raises. One visit is held at a time; the rows
    of some dozen are read together."""
    for start in range(0, len(visits), _TOGETHER):
        some = visits[start : start + _TOGETHER]
        videos = (fit.FitSet.Video & inside("fit_set", [v["fit_set"] for v in some])).to_arrays("video_id")
        rows = ReadAhead(some, videos)
        for visit in some:
            try:
                yield visit, _session(visit, rows, sensors, gait)
            except PblError as error:
                yield visit, error


def _session(visit: Mapping[str, Any], rows: Rows, sensors: bool, gait: bool) -> ExportSession:
    from pbl_pipeline.export import ExportSession

    of_fit = {k: visit[k] for k in fit.SessionFit.primary_key}
    if row_of(fit.FitSet, {"fit_set": visit["fit_set"]}, rows)["fit_set_kind"] == fit.MARKERS:
        raise of_markers(visit["subject"], visit["session_label"])
    methods = methods_of(visit, rows)
    version = row_of(fit.SessionFit, of_fit, rows)["fit_code_version"]
    metrics = load_metrics(visit, rows) if gait and "norm" in visit else None
    numbers = videos_of(of_fit, rows)
    measured = metrics.trials if metrics is not None else (None,) * len(numbers)
    trials = tuple(
        _trial({**of_fit, "video_id": number}, of_trial, methods, version, sensors, rows)
        for number, of_trial in zip(numbers, measured, strict=True)
    )
    return ExportSession(trials, metrics, tuple(load_fit_checks(of_fit, rows)))


def _trial(
    key: Mapping[str, Any],
    measured: TrialMetrics | None,
    methods: dict[str, str],
    version: str,
    sensors: bool,
    rows: Rows,
) -> ExportTrial:
    from pbl_pipeline.export import ExportTrial, log_shift_s
    from pbl_pipeline.video import read_phone_log

    of_video = {"video_id": key["video_id"]}
    member = row_of(fit.FitSet.Video, {"fit_set": key["fit_set"], **of_video}, rows)
    points = load_keypoints({k: member[k] for k in keypoints.Keypoints.primary_key}, rows)
    fitted = load_trial_fit(key, rows)
    log, shift = None, 0.0
    if logs := rows(video.PhoneAttitude, of_video) if sensors else []:
        with stored_file(video.PhoneAttitude(), file_ref(logs[0]["attitude_file"])) as path:
            log = read_phone_log(path)
        shift = log_shift_s(log, points, f"video {key['video_id']}")
    return ExportTrial(
        name=fitted.name,
        fit=fitted,
        keypoints=points,
        measured=measured,
        log=log,
        log_shift_s=shift,
        methods=methods,
        fitted_with=version,
    )
