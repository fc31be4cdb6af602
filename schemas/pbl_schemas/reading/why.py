"""State of one video: every stage with its row, job or error, and the next step."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from pbl_pipeline.words import STAGES

from .. import computed_tables, fit, tracking, video
from ..chain import ON_REQUEST, before, followers
from ..decisions.not_usable import unusable
from ..job_errors import stored_error
from ..jobs import jobs_of
from ..rows import inside
from .status import EMPTY_COLUMNS

_TAKE_BACK = "no fit uses it; `pbl choose {} --usable` takes that back"
DONE, EMPTY, PENDING, RUNNING, ERROR, NOT_YET = "done", "empty", "pending", "being computed", "error", "not yet"


@dataclasses.dataclass(frozen=True)
class Step:
    """One stage of one video. what: one of the words above. method: that names the row. note: origin, error or reason;
    next_step and code: of an error, or of a choice that is waited for. camera: the video it is about, where several
    cameras filmed the trial."""

    table: str
    what: str
    method: str = ""
    note: str = ""
    next_step: str = ""
    camera: int | None = None
    code: str = ""


@dataclasses.dataclass(frozen=True)
class Why:
    """The state of a video; `verdict` is the sentence that answers the question."""

    video_id: int
    name: str
    path: str
    session_id: int
    steps: list[Step]
    verdict: str
    marked: bool  # as not usable

    @property
    def stops(self) -> bool:
        """True if it does not go on by itself: it failed, has no person, waits for a choice, or is marked."""
        ends = {t.__name__ for t in before(fit.SessionFit)}  # events that are empty are measured all the same
        left = [s for s in self.steps if s.what != DONE]
        empty = any(s.what == EMPTY and s.table in ends for s in left)
        return self.marked or empty or any(s.next_step or s.what == ERROR for s in left)

    @property
    def stopped(self) -> Step | None:
        """The step that failed or waits for a choice, if none before it still goes on."""
        step = next((s for s in self.steps if s.code or s.what in (RUNNING, PENDING)), None)
        return step if step and step.code and not self.marked else None

    @property
    def waits(self) -> bool:
        """True if it waits for a worker alone, not for another video, a choice, a retry or a withdrawn mark."""
        left = [s for s in self.steps if s.what != DONE]
        return bool(left) and not self.stops and (left[0].table, left[0].what) != ("SessionFit", NOT_YET)


def why(video_id: int) -> Why:
    """Return the state of a registered video in every table. `pbl_schemas.activate()` must have been called. Raises
    `PblError` DB_NOT_FOUND for an unknown video."""
    return whys([video_id])[video_id]


def whys(videos: Iterable[int]) -> dict[int, Why]:
    """Return `why` of videos by their numbers, with as many queries for one as for hundreds. Raises as `why`."""
    numbers = [int(v) for v in videos]
    if not numbers:
        return {}
    rows = {int(row["video_id"]): row for row in (video.Video & inside("video_id", numbers)).to_dicts()}
    if unknown := [v for v in numbers if v not in rows]:
        raise video.unknown_video(unknown[0])
    # One of several cameras: from the fit on the trial counts, before it every camera.
    of_camera = fit.trials_of(numbers)
    trials = {v: of_camera.get(v, v) for v in numbers}
    views = {t: [int(r["video_id"]) for r in of] or [t] for t, of in fit.views_of(list(trials.values())).items()}
    sets: dict[int, list[str]] = {t: [] for t in views}
    members = fit.FitSet.Video.proj() & inside("video_id", sets) & fit.current().proj()
    for member in members.to_dicts(order_by="fit_set"):
        sets[int(member["video_id"])].append(str(member["fit_set"]))
    names_of_sets = {name for of in sets.values() for name in of}
    of_videos = inside("video_id", {v for of in views.values() for v in of})
    found = {t: _steps(t, inside("fit_set", names_of_sets) if _of_set(t) else of_videos) for t in computed_tables()}
    marks, go_on = unusable(numbers), {t.__name__ for t in found if followers(t)}
    out = {}
    for number in numbers:
        row, trial = rows[number], trials[number]
        steps: list[Step] = []
        # Markers go straight to the fit: nothing is computed before it.
        markers = row["camera_motion"] == video.NO_CAMERA
        for table in [t for t in found if not (markers and t in before(fit.SessionFit))]:
            about: list[tuple[str | None, int | None]]
            of_video = "video_id" in table.heading.primary_key
            about = [(name, trial if of_video else None) for name in sets[trial]]
            if not _of_set(table):
                about = [(None, v) for v in (views[trial] if table in before(fit.TrialInput) else [trial])]
            several = not _of_set(table) and len(about) > 1
            for one in [[a] for a in about] if several else [about]:
                # The rows of all sets, then their jobs.
                own = [s for of in found[table] for a in one for s in of.get(a, ())]
                own = own or [Step(table.__name__, NOT_YET)]
                steps += [dataclasses.replace(s, camera=one[0][1]) for s in own] if several else own
        if (mark := marks.get(number)) is None:
            verdict = _verdict(steps, bool(sets[trial]), go_on)
        else:
            verdict = f"not usable: {mark.text}; {_TAKE_BACK.format(number)}"
        of_row = (row["video_name"], row["video_path"], int(row["session_id"]))
        out[number] = Why(number, *of_row, steps, verdict, mark is not None)
    return out


def _of_set(table: Any) -> bool:
    return "fit_set" in table.heading.primary_key


#: Steps of a table's rows or jobs by the set and the video in its key (None where it has no such column).
_Steps = dict[tuple[str | None, int | None], list[Step]]


def _steps(table: Any, where: Any) -> tuple[_Steps, _Steps]:
    """Return the steps of the rows of a table and of its jobs."""
    rows, jobs = _Steps(), _Steps()
    name, key = table.__name__, table.heading.primary_key
    prefix = next(n.removesuffix("_computed") for n in table.heading.names if n.endswith("_computed"))
    status, values, reason = EMPTY_COLUMNS.get(name, ("", (), None))
    columns = [f"{prefix}_{n}" for n in ("computed", "host", "seconds")] + [c for c in (status, reason) if c]
    stored = (table.proj(*columns) & where).to_dicts(order_by="KEY")
    waiting = [int(row["video_id"]) for row in stored if row.get("choice_status") == "NEEDS_CHOICE"]
    several = tracking.with_several_methods(waiting)

    def add(to: _Steps, row: Mapping[str, Any], what: str, note: str, next_step: str = "", code: str = "") -> None:
        about = row.get("fit_set"), int(row["video_id"]) if "video_id" in key else None
        to.setdefault(about, []).append(Step(name, what, _method(row, table), note, next_step, code=code))

    for row in stored:
        empty = bool(status) and row[status] in values
        waits = row.get("choice_status") == "NEEDS_CHOICE"
        note = f"{row[prefix + '_computed']} on {row[prefix + '_host']} in {row[prefix + '_seconds']:.1f} s"
        if (empty or waits) and (text := row.get(reason or "")):
            note = str(text)
        what = EMPTY if empty else "waits for a choice" if waits else DONE
        asked = (tracking.choose_command(row, "PERSON", several), "SUBJECT_NEEDS_CHOICE") if waits else ()
        add(rows, row, what, note, *asked)
    columns = ["status", "error_message", "host", "pid", "reserved_time", "priority", "scheduled_time"]
    for row in (jobs_of(table).proj(*columns) & where).to_dicts(order_by="KEY"):
        if row["status"] == "error":
            error = stored_error(row["error_message"])
            add(jobs, row, ERROR, error.short(), error.next_step, error.code)
        elif row["status"] == "reserved":
            add(jobs, row, RUNNING, f"by {row['host']}:{row['pid']} since {row['reserved_time']}")
        elif row["status"] == "pending":
            late = f"; put back: {row['error_message']}" if row["error_message"] else ""
            add(jobs, row, PENDING, f"priority {row['priority']}, from {row['scheduled_time']} on{late}")
    return rows, jobs


def _method(row: Mapping[str, Any], table: Any) -> str:
    return ", ".join(str(row[n]) for n in table.heading.primary_key if n.endswith("_method") or n == "norm")


def _verdict(steps: list[Step], in_a_set: bool, go_on: Collection[str]) -> str:
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
