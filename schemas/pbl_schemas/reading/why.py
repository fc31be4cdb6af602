"""State of one video: every stage with its row, job or error, and the next step."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.words import STAGES

from .. import computed_tables, fit, tracking, video
from ..chain import ON_REQUEST, before, followers
from ..decisions.not_usable import unusable
from ..job_errors import error_code, error_found, error_next_step
from ..jobs import jobs_of
from .status import EMPTY_COLUMNS

_TAKE_BACK = "no fit uses it; `pbl choose {} --usable` takes that back"
DONE, EMPTY, PENDING, RUNNING, ERROR, NOT_YET = "done", "empty", "pending", "being computed", "error", "not yet"


@dataclasses.dataclass(frozen=True)
class Step:
    """One stage of one video. what: one of the words above. method: that names the row. note: origin, error or reason;
    next_step: of an error. camera: the video it is about, where several cameras filmed the trial."""

    table: str
    what: str
    method: str = ""
    note: str = ""
    next_step: str = ""
    camera: int | None = None


@dataclasses.dataclass(frozen=True)
class Why:
    """The state of a video; `verdict` is the sentence that answers the question."""

    video_id: int
    name: str
    path: str
    session_id: int
    steps: list[Step]
    verdict: str

    @property
    def waits(self) -> bool:
        """True if it waits for a worker alone, not for another video, a choice, a retry or a withdrawn mark."""
        left = [s for s in self.steps if s.what != DONE]
        stops = any(s.next_step or s.what in (ERROR, EMPTY) for s in left) or bool(unusable([self.video_id]))
        return bool(left) and not stops and (left[0].table, left[0].what) != ("SessionFit", NOT_YET)


def why(video_id: int) -> Why:
    """Return the state of a registered video in every table. `pbl_schemas.activate()` must have been called. Raises
    `PblError` DB_NOT_FOUND for an unknown video."""
    row = video.registered_video(video_id)
    # One of several cameras: from the fit on the trial counts, before it every camera.
    trial = fit.trial_of(video_id)
    views = fit.videos_of(trial)
    sets = [{"fit_set": s} for s in (fit.FitSet.Video & {"video_id": trial}).to_arrays("fit_set")]
    current = fit.current()
    sets = [{"fit_set": k["fit_set"]} for k in (current & sets).to_dicts()] if sets else []
    steps: list[Step] = []
    # Markers go straight to the fit: nothing is computed before it.
    markers = row["camera_motion"] == video.NO_CAMERA
    for table in [t for t in computed_tables() if not (markers and t in before(fit.SessionFit))]:
        names = table.heading.primary_key
        of_view = "video_id" in names and table in before(fit.TrialInput)
        about = [{"video_id": v} for v in (views if of_view else [trial])] if "video_id" in names else sets
        if "video_id" in names and "fit_set" in names:
            about = [{**s, "video_id": trial} for s in sets]
        if not about:
            steps.append(Step(table.__name__, NOT_YET))
            continue
        several = of_view and len(views) > 1
        for one in [[a] for a in about] if several else [about]:
            found = _steps(table, one) or [Step(table.__name__, NOT_YET)]
            steps += [dataclasses.replace(s, camera=one[0]["video_id"] if several else None) for s in found]
    mark = unusable([video_id]).get(video_id)
    verdict = _verdict(steps, bool(sets)) if mark is None else f"not usable: {mark.text}; {_TAKE_BACK.format(video_id)}"
    return Why(video_id, row["video_name"], row["video_path"], int(row["session_id"]), steps, verdict)


def _steps(table: Any, about: Any) -> list[Step]:
    out = []
    name = table.__name__
    prefix = next(n.removesuffix("_computed") for n in table.heading.names if n.endswith("_computed"))
    for row in (table & about).to_dicts():
        status, values, reason = EMPTY_COLUMNS.get(name, ("", (), None))
        empty = bool(status) and row[status] in values
        waits = row.get("choice_status") == "NEEDS_CHOICE"
        note = f"{row[prefix + '_computed']} on {row[prefix + '_host']} in {row[prefix + '_seconds']:.1f} s"
        if (empty or waits) and (text := row.get(reason or "choice_reason")):
            note = str(text)
        what = EMPTY if empty else "waits for a choice" if waits else DONE
        step = tracking.choose_command(row, "PERSON") if waits else ""
        out.append(Step(name, what, _method(row, table), note, step))
    for row in (jobs_of(table) & about).to_dicts():
        method = _method(row, table)
        if row["status"] == "error":
            message = row["error_message"]
            note = f"{error_code(message)}: {error_found(message)}"
            out.append(Step(name, ERROR, method, note, error_next_step(message)))
        elif row["status"] == "reserved":
            out.append(Step(name, RUNNING, method, f"by {row['host']}:{row['pid']} since {row['reserved_time']}"))
        elif row["status"] == "pending":
            late = f"; put back: {row['error_message']}" if row["error_message"] else ""
            out.append(
                Step(name, PENDING, method, f"priority {row['priority']}, from {row['scheduled_time']} on{late}")
            )
    return out


def _method(row: dict[str, Any], table: Any) -> str:
    return ", ".join(str(row[n]) for n in table.heading.primary_key if n.endswith("_method") or n == "norm")


def _verdict(steps: list[Step], in_a_set: bool) -> str:
    go_on = {t.__name__ for t in computed_tables() if followers(t)}
    for step in steps:
        stage = STAGES.get(step.table, step.table)  # a laboratory adds tables
        if step.camera is not None:
            stage += f" of its camera, video_id {step.camera},"
        if step.what == ERROR:
            return f"{stage} failed ({step.note}); next: {step.next_step}, then pbl retry"
        if step.next_step:
            return f"{stage} {step.what}: {step.note}; next: {step.next_step}"
        if step.what == RUNNING:
            return f"{stage} is being computed {step.note}"
        if step.what == PENDING:
            return f"{stage} waits for a worker ({step.note}); next: pbl worker or pbl populate"
        if step.what == EMPTY and step.table in go_on:
            return f"{stage} ran well and found nothing to go on with: {step.note}"
        if step.what == NOT_YET and step.table not in ON_REQUEST:
            if step.table == "SessionFit" and not in_a_set:
                return "its session is fitted when all of its videos are decided; next: pbl populate plans it"
            return f"{stage} is not queued yet; next: pbl populate, or a worker looks at all tables every minute"
    return "everything is computed"
