"""Visits from the tables as the library's `Visit`, and their reports; nothing is recomputed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError, as_said, joined, said
from pbl_pipeline.names import distinct
from pbl_pipeline.records import from_row
from pbl_pipeline.results import SubjectChoice, VideoInfo
from pbl_pipeline.texts import LANGUAGES

from .. import fit, gait, gdi, keypoints, privacy, session, tracking, video
from ..chain import before
from ..decisions.not_usable import unusable
from ..gait import load_cycles
from ..job_errors import stored_error
from ..jobs import jobs_of
from ..method_names import with_keys
from ..operations.archive import plain_name
from ..rows import ReadAhead, Rows, grouped, inside, row_of, stored_rows
from ..stored_files import file_ref, read_stored
from .objects import (
    load_fit_checks,
    load_keypoints,
    load_kinetics,
    load_metrics,
    load_solution,
    load_trial_fit,
    videos_of,
)
from .slice_rows import chain_of

if TYPE_CHECKING:
    from pbl_pipeline.video import PhoneLog
    from pbl_pipeline.visit import Recording, Visit

#: Visits whose rows are read together: few questions to the database, and memory that does not grow with the visits.
_TOGETHER = 50
#: Column -> the option of `pbl report` and `pbl export` that names it.
_OPTIONS = {
    "subject": "--subject",
    "session_label": "--session",
    "fit_set_kind": "--kind",
    "fit_method": "--fit-method",
}


def find_visit(restriction: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return one session (row of Session) and the key of its current fit and measures, as far as there are any.

    `restriction` and errors are those of `load_visit`.
    """
    if isinstance(restriction, Mapping):
        restriction = session.as_registered(with_keys(restriction))
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
    key: dict[str, Any] = {}
    if fits:
        key = dict(_single(fits, "fits", ("fit_set_kind", *fit.SessionFit.primary_key[::-1])))
        measured = (gdi.SessionGdi & _of(fit.SessionFit, key) & restriction).keys()
        if measured:
            key |= _single(measured, "results", gdi.SessionGdi.primary_key)
    return visit, key


def load_visit(restriction: Any, *, measures: bool = True) -> Visit:
    """Return everything that the tables hold of one visit. Arrays are loaded on first access.

    Raises `PblError` DB_NOT_FOUND when no session matches, USAGE when several sessions or chains match, SOLVER_UNKNOWN
    and NORM_UNKNOWN for unknown methods.

    Parameters
    ----------
    restriction
        Restriction to one session and, where several methods were used, one chain of methods: a dict such as
        `{"subject": "P017", "session_label": "2026-03-01", "fit_method": "paper-2025"}`; `fit_set_kind` where it has
        recordings of one camera, of several, or markers.
    measures
        Also events, cycles, measures, index and forces.
    """
    found, key = find_visit(restriction)
    videos = (video.Video & {"session_id": found["session_id"]}).to_dicts(order_by="video_id")
    rows = ReadAhead([key], [int(r["video_id"]) for r in videos]) if key else stored_rows
    return _visit({**found, **key}, videos, rows, measures)


def fitted_visit(restriction: Any, *, gait: bool = True, whole: bool = False) -> Visit:
    """Return a visit that has a fit: with its measures where `gait`, and not without them where `whole`. Raises what
    `load_visit` raises, and `PblError` DB_NOT_FOUND if it is not computed yet."""
    visit = load_visit(restriction, measures=gait)
    if visit.solution is None or (whole and visit.measures is None):
        left_out = [r for r in visit.left_out if r.problem]
        problems = joined([said("{name}: {why}", name=r.name, why=as_said(r.problem)) for r in left_out], "; ")
        what = (
            "no finished fit and measures of session '{visit}'." if whole else "no finished fit of session '{visit}'."
        )
        raise PblError(
            "DB_NOT_FOUND",
            found=joined([said(what, visit=visit.label), problems], " "),
            expected="a session that was populated",
            next_step="run `pbl populate`, then `pbl status`",
            key=f"subject {visit.subject}",
        )
    return visit


def list_fitted(restriction: Mapping[str, Any], slice_name: str | None = None) -> list[dict[str, Any]]:
    """Return the fitted visits that a restriction allows, in the order of subject and session.

    Rows with `subject`, `session_label`, `folder` (subject and session as the names of a folder in a folder) and the
    key of the fit and its measures.

    Raises `PblError` DB_NOT_FOUND for an unknown slice or where no visit is left, USAGE where a visit has several kinds
    of recordings or chains of methods, SOLVER_UNKNOWN and NORM_UNKNOWN.

    `restriction`: subject, session, methods (short names too), `fit_set_kind`. `slice_name`: the visits that count in
    this slice alone, with the sets and methods that it was frozen with.
    """
    sets: Any = fit.current()
    restriction = session.as_registered(with_keys(restriction))
    if slice_name is not None:
        chain, counted = chain_of(slice_name)
        restriction, sets = {**restriction, **chain}, fit.FitSelection().restrict(counted, semantic_check=False)
    fits = fit.SessionFit.proj("session_id") * fit.FitSet.proj("fit_set_kind") * sets.proj()
    fits = fits * session.Session.proj("subject", "session_label", "session_date") & restriction
    found = {
        (r["fit_set"], r["fit_method"]): r for r in fits.to_dicts(order_by="subject, session_id, fit_set, fit_method")
    }
    of_sets = (gdi.SessionGdi.proj() & sets.proj() & restriction).to_dicts(order_by="KEY")
    measured = grouped(((row["fit_set"], row["fit_method"]), row) for row in of_sets)
    visits = [{**row, **more} for key, row in found.items() for more in measured.get(key, [{}])]
    if not visits:
        raise PblError(
            "DB_NOT_FOUND",
            found="no fitted visit" + (f" for {restriction}" if restriction else ""),
            expected="at least one",
            next_step="`pbl populate`; `pbl list visits` shows what is computed",
        )
    chain_columns = ("fit_set_kind", "fit_method", "gait_method", "gdi_method", "norm")
    for one, other in itertools.pairwise(visits):
        if one["session_id"] == other["session_id"]:
            differ = [k for k in chain_columns if one.get(k) != other.get(k)]
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


def load_visits(
    listed: Sequence[Mapping[str, Any]], *, measures: bool = True
) -> Iterator[tuple[Mapping[str, Any], Visit | PblError]]:
    """Yield each row of `list_fitted` with what `load_visit` returns or raises.

    One visit is held at a time; the rows of some dozen are read together.
    """
    for start in range(0, len(listed), _TOGETHER):
        some = listed[start : start + _TOGETHER]
        videos = video.Video & inside("session_id", {int(v["session_id"]) for v in some})
        of_sessions = grouped((int(row["session_id"]), row) for row in videos.to_dicts(order_by="video_id"))
        rows = ReadAhead(some, [int(r["video_id"]) for of_one in of_sessions.values() for r in of_one])
        for one in some:
            try:
                yield one, _visit(one, of_sessions[int(one["session_id"])], rows, measures)
            except PblError as error:
                yield one, error


def load_recording(video_id: int) -> Recording:
    """Return one recording with the fit that is shown of it (`fit.trial_key`) and its newest events and cycles.

    They may be there before the measures are. Raises `PblError` DB_NOT_FOUND for an unknown number.
    """
    row, key = video.registered_video(video_id), fit.trial_key(video_id)
    recording = _recording(row, key, stored_rows)
    events = None if key is None else gait.newest_events(key)
    if events is None:
        return recording
    # Corrected events immediately, before anything is computed from them.
    counting = gait.events_of(row_of(gait.GaitEvents, events), gait.correction_of(events))
    cycles = load_cycles(events, recording.name) if gait.GaitCycle & events else ()
    return dataclasses.replace(recording, events=counting, cycles=tuple(cycles))


def methods_of(key: Mapping[str, Any], rows: Rows = stored_rows) -> dict[str, str]:
    """Return name and version of the method behind each stage up to the fit, by a key of a fit or result.

    Of several cameras also their names. The methods of the gait stand in its measures.
    """
    members = rows(fit.FitSet.Video, {"fit_set": key["fit_set"]})
    member = members[0]
    cameras = sorted({r["rig_camera"] for m in members for r in rows(video.RigView, {"video_id": m["video_id"]})})
    ahead = {"Tracking": member["tracking_method"], "Keypoints": member["keypoint_method"]}
    found = {stage: method or fit.LABORATORY for stage, method in ahead.items()} | {"Fit": key["fit_method"]}
    if cameras:
        found = {"Cameras": ", ".join(cameras), **found}
    return found


# ----------------------------------------------------------------------------------------------------------- one visit
def _visit(found: Mapping[str, Any], videos: Sequence[dict[str, Any]], rows: Rows, measures: bool) -> Visit:
    """Return a visit: row of its session with the key of its fit and measures, rows of its videos."""
    from pbl_pipeline.visit import Visit

    day = found["session_date"]
    about = {"subject": found["subject"], "label": found["session_label"], "date": "" if day is None else str(day)}
    fit_key = _of(fit.SessionFit, found)
    if not fit_key:
        return Visit(tuple(_recording(row, None, rows) for row in videos), **about)
    # Videos of one camera, of several, and markers are fitted apart: beside a fit of one kind the others are not left
    # out.
    kind = row_of(fit.FitSet, {"fit_set": fit_key["fit_set"]}, rows)["fit_set_kind"]
    views = [v for row in videos for v in rows(video.RigView, {"video_id": int(row["video_id"])})]
    trial_of = {int(v["video_id"]): int(v["rig_trial"]) for v in views}
    leads = {
        n: row for row in videos if trial_of.get(n := int(row["video_id"]), n) == n and _kind_of(row, trial_of) == kind
    }
    fitted = videos_of(fit_key, rows)
    recordings = [_recording(leads[n], {**fit_key, "video_id": n}, rows) for n in fitted]
    recordings += [_recording(row, None, rows) for n, row in leads.items() if n not in fitted]
    key = {k: found[k] for k in gdi.SessionGdi.primary_key if k in found}
    visit = Visit(
        tuple(recordings),
        load_solution(fit_key, rows),
        load_fit_checks(fit_key, rows),
        kind=kind,
        methods=methods_of(key, rows),
        key=key,
        **about,
    )
    if not measures or "norm" not in key:
        return visit
    return dataclasses.replace(visit.with_measures(load_metrics(key, rows)), kinetics=load_kinetics(key, rows))


def _recording(row: Mapping[str, Any], key: Mapping[str, Any] | None, rows: Rows) -> Recording:
    """Return a recording: row of its video, and key of its fit, None if it has none."""
    from pbl_pipeline.visit import Recording

    number = int(row["video_id"])
    of_video = {"video_id": number}
    markers = row["camera_motion"] == video.NO_CAMERA
    about: dict[str, Any] = {
        "path": None if markers else Path(row["video_path"]),
        "condition": video.condition(number, rows),
        "number": number,
    }
    if probed := rows(video.VideoInfo, of_video):
        about["video"] = from_row(VideoInfo, {**row, **probed[0]}, time_s=probed[0]["frame_time"].load())
    if key is None:
        choices = rows(tracking.SubjectChoice, of_video)
        choice = from_row(SubjectChoice, choices[0]) if len(choices) == 1 else None
        detected = rows(keypoints.Keypoints, of_video)
        if len(detected) == 1:
            points = {k: detected[0][k] for k in keypoints.Keypoints.primary_key}
            about["load_keypoints"] = functools.partial(load_keypoints, points, rows)
        return Recording(Path(row["video_name"]).stem, choice=choice, problem=_problem(number, choice), **about)
    member = row_of(fit.FitSet.Video, {"fit_set": key["fit_set"], **of_video}, rows)
    if member["keypoint_method"]:
        points = {k: member[k] for k in keypoints.Keypoints.primary_key}
        choice = row_of(tracking.SubjectChoice, _of(tracking.SubjectChoice, points), rows)
        about["choice"] = from_row(SubjectChoice, choice)
        about["load_keypoints"] = functools.partial(load_keypoints, points, rows)
        about["load_log"] = functools.partial(_log_of, number, points, rows)
    name = row_of(fit.SessionFit.Trial, key, rows)["trial_name"]
    return Recording(name, load_fit=functools.partial(load_trial_fit, key, rows), **about)


def _log_of(number: int, points: Mapping[str, Any], rows: Rows) -> tuple[PhoneLog, float] | None:
    """Return the stored log of the phone and what added to its times gives the video's (s); None without one."""
    from pbl_pipeline.keypoints import log_shift_s
    from pbl_pipeline.video import read_phone_log

    stored = rows(video.PhoneAttitude, {"video_id": number})
    if not stored:
        return None
    log = read_stored(file_ref(stored[0]["attitude_file"]), read_phone_log)
    return log, log_shift_s(log, load_keypoints(points, rows), f"video {number}")


def _kind_of(row: Mapping[str, Any], trial_of: Mapping[int, int]) -> str:
    if row["camera_motion"] == video.NO_CAMERA:
        return fit.MARKERS
    return fit.RIG if int(row["video_id"]) in trial_of else fit.SINGLE


def _problem(video_id: int, choice: SubjectChoice | None) -> str:
    """Return why a recording has no fit, in a sentence."""
    if mark := unusable([video_id]):
        return f"not usable: {mark[video_id].text}"
    for table in before(fit.SessionFit):
        for row in (jobs_of(table).errors & {"video_id": video_id}).to_dicts():
            return stored_error(row["error_message"]).short()
    if choice is not None and choice.status not in tracking.CHOSEN:
        return choice.reason
    return "not computed yet"


def _of(table: Any, key: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a key belongs to a table; empty if it lacks a part."""
    found = {name: key[name] for name in table.primary_key if name in key}
    return found if len(found) == len(table.primary_key) else {}


def _single(rows: list[dict], what: str, columns: Sequence[str]) -> dict:
    """Return the one row; `columns`: what can tell several apart, by which the error names them."""
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


def write_visit(restriction: Any, out: Path, language: str = LANGUAGES[0]) -> list[Path]:
    """Write the files of `pbl_pipeline.pipeline.write_results` for one visit, the report in a language; nothing is
    recomputed.

    Raises `PblError` DB_NOT_FOUND when the visit is unknown or not computed yet, USAGE when several match; what
    `to_show` raises; VIDEO_MISSING when a recording is no longer where it was.
    """
    # The library's drawing half is heavy; commands that only look at rows do not pay for it.
    from pbl_pipeline.pipeline import write_results

    with contextlib.ExitStack() as open_files:
        return write_results(out, to_show(fitted_visit(restriction, whole=True), open_files), language=language)


def to_show(visit: Visit, open_files: contextlib.ExitStack) -> Visit:
    """Return a visit of the tables with the recordings whose pictures may be shown.

    `open_files` holds the de-identified copies where PBL_DEIDENTIFY is set: close it when all is drawn. Raises, where
    it is set, `PblError` DB_NOT_FOUND without a de-identified copy, HEAD_NOT_FOUND if nothing was covered in it.
    """
    recordings = tuple(
        dataclasses.replace(r, shown=open_files.enter_context(privacy.shown(r.number)))
        if r.fitted and r.path is not None and r.number is not None
        else r
        for r in visit.recordings
    )
    return dataclasses.replace(visit, recordings=recordings)
