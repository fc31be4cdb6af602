"""Decisions about results, each with a row of its author, time, and the previous state."""

from __future__ import annotations

import dataclasses
import datetime
import functools
from collections.abc import Callable, Mapping
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label
from pbl_pipeline.qc import CADENCE
from pbl_pipeline.words import UNUSABLE

from .. import fit, gait, qc, session, tracking, video
from ..jobs import jobs_of
from ..plan import locked, plan_anew, queues_before_fit
from ..review import Decision, Viewing
from ..rows import delete_below, moment, utc_now
from ..transactions import after_commit, in_transaction, next_id, repeated
from . import not_usable
from .candidates import selection_of
from .not_usable import Unusable


@dataclasses.dataclass(frozen=True)
class Decided:
    """A row of Decision."""

    number: int
    what: str
    by: str
    at: datetime.datetime
    about: Mapping[str, Any]
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    reason: str
    video_id: int | None

    @property
    def moves(self) -> list[tuple[str, str, float | None, float | None]]:
        """Gait events that a decision changed: side, kind, time (s) before (None: added) and after (None: removed).

        Of a side and kind, times are matched in order where as many are gone as are new.
        """
        if "events" not in self.before or "events" not in self.after:
            return []
        was, now = ({(s, k, t) for t, s, k in about["events"]} for about in (self.before, self.after))
        out: list[tuple[str, str, float | None, float | None]] = []
        for side, kind in sorted({e[:2] for e in was ^ now}):
            gone, new = (sorted(t for s, k, t in only if (s, k) == (side, kind)) for only in (was - now, now - was))
            if len(gone) == len(new):
                out += [(side, kind, a, b) for a, b in zip(gone, new, strict=True)]
            else:
                out += [(side, kind, t, None) for t in gone] + [(side, kind, None, t) for t in new]
        return out


def decisions(session_id: int) -> tuple[Decided, ...]:
    """Return the decisions about a visit and its videos, the last first."""
    videos = [{"video_id": int(v)} for v in (video.Video & {"session_id": session_id}).to_arrays("video_id")]
    rows = (Decision & [{"session_id": session_id}, *videos]).to_dicts(order_by="decision_id DESC")
    return tuple(_decided(row) for row in rows)


def last_decision(video_id: int, what: str) -> int:
    """Return the number of the last decision of a kind about a recording, 0 if there is none."""
    of_kind = Decision & {"video_id": video_id, "decision_what": what}
    return max((int(n) for n in of_kind.to_arrays("decision_id")), default=0)


def person_state(video_id: int, tracking_method: str) -> str:
    """Return a text for the state of the choice in a video that each decision changes, also one by `pbl choose`."""
    key = {"video_id": video_id, "tracking_method": tracking_method}
    last = last_decision(video_id, "person")
    by_hand = (tracking.SubjectOverride & key).to_arrays("override_person_id")
    chosen = (tracking.SubjectChoice & key).to_arrays("chosen_person_id")
    return f"{last}-{by_hand[0] if len(by_hand) else ''}-{chosen[0] if len(chosen) else ''}"


@repeated
def decide_person(
    video_id: int, person: int, tracking_method: str | None = None, by: str = "", seen: str | None = None
) -> dict[str, int]:
    """Measure `person` of a video: write the override, delete the results of another person, add a Decision.

    All in one transaction. An error row of the choice (a number that did not exist) becomes pending again.

    Raises `PblError` DECIDED_MEANWHILE if the state is another one by now; SUBJECT_UNKNOWN_PERSON; what
    `selection_of` raises.

    Returns the number of deleted rows by table, which the next populate recomputes.

    `tracking_method`: tracking in which the person has this number; needed where several methods track the video.
    `seen`: `person_state` of the page on which it was decided; None if nothing was shown.
    """
    selection = selection_of(video_id, tracking_method)
    failed = jobs_of(tracking.SubjectChoice)  # declares the job table, which would end a transaction
    session_id = int((video.Video & {"video_id": video_id}).fetch1("session_id"))
    with locked(session_id):  # concurrent decisions wait here
        if seen is not None and person_state(video_id, selection["tracking_method"]) != seen:
            raise meanwhile(video_id, "person")
        rows = (tracking.SubjectChoice & selection).to_dicts()
        before = {"status": rows[0]["choice_status"], "person": rows[0]["chosen_person_id"]} if rows else {}
        tracking.set_override(selection, person)
        (failed.errors & selection).delete_quick()
        deleted = tracking.drop_outdated_choices(selection)
        about = {"tracking_method": selection["tracking_method"]}
        record("person", by, about, before, {"person": person}, video_id=video_id)
        queue_visit(session_id)
    return deleted


def usable_state(video_id: int) -> str:
    """Return a text for the mark of a recording that each decision changes."""
    marked = (video.NotUsable & {"video_id": video_id}).to_dicts()
    return f"{last_decision(video_id, 'usable')}-{marked[0]['unusable_reason'] if marked else ''}"


def mark_not_usable(video_id: int, reason: str, note: str = "", by: str = "", seen: str | None = None) -> None:
    """Leave a recording out, with a row of Decision: one transaction.

    Where several cameras filmed the trial, all of its videos are marked. Sets of fits that hold it cease to be current,
    and the session is planned without it: exactly what depends on it is pending. Nothing is deleted, so taking it back
    brings back what was computed; frozen slices stay as they are.

    Raises `PblError` USAGE for an unknown reason, "other" without words, or a note of more than 500 characters;
    DB_NOT_FOUND for an unknown recording; DECIDED_MEANWHILE if `seen` is another state than the tables'.

    `reason`, `note`: one of `words.UNUSABLE`, and more in free words (no names), which "other" asks for. `seen`:
    `usable_state` of the page on which it was decided; None: not compared.
    """
    note = " ".join(note.split())
    check_label("note", note, 500)
    if reason not in UNUSABLE or (reason == "other" and not note):
        raise PblError(
            "USAGE",
            found="the reason 'other' without words" if reason == "other" else f"the reason {reason!r}",
            expected=f"a reason of the list ({', '.join(UNUSABLE)}); with 'other' also words of your own",
            next_step="choose a reason, and say more in the note; nothing was changed",
            key=f"video_id={video_id}",
        )
    _decide_usable(video_id, {"unusable_reason": reason, "unusable_note": note, "unusable_by": by}, by, seen)


def take_back(video_id: int, by: str = "", seen: str | None = None) -> None:
    """Use a recording again that was marked as not usable, with a row of Decision: one transaction.

    The session is planned with it again; what was computed with it before is there immediately. Not marked: nothing
    happens. Raises `PblError` as `mark_not_usable`.
    """
    _decide_usable(video_id, None, by, seen)


@repeated
def _decide_usable(video_id: int, mark: dict[str, str] | None, by: str, seen: str | None) -> None:
    session_id = int(video.registered_video(video_id)["session_id"])
    failed = queues_before_fit()
    with locked(session_id):
        if seen is not None and usable_state(video_id) != seen:
            raise meanwhile(video_id, "usable")
        before = not_usable.unusable([video_id]).get(video_id)
        if mark is None and before is None:
            return
        # Of several cameras all: their trial is fitted with every view or not at all.
        views = [{"video_id": v} for v in fit.videos_of(fit.trial_of(video_id))]
        (video.NotUsable & views).delete_quick()
        if mark is not None:
            video.NotUsable.insert({**view, **mark, "unusable_created": utc_now()} for view in views)
        after = not_usable.unusable([video_id]).get(video_id)
        reason = after.note if after else ""
        record("usable", by, {}, _said(before), _said(after), reason, video_id=video_id)
        plan_anew(session_id, failed)
        queue_visit(session_id)


def _said(mark: Unusable | None) -> dict[str, str]:
    return {"usable": "yes"} if mark is None else {"usable": "no", "why": mark.reason}


@repeated
def accept_check(key: Mapping[str, Any], number: int, by: str, reason: str) -> None:
    """Accept a check of a visit that asks for attention, with one's name and a reason.

    It holds for this result: when the checks are computed again, they ask again. Accepted already: nothing happens.
    An unusual cadence is accepted although it failed: the cycles that it left out are deleted with their dependent
    results, and the next populate uses them; it holds while the recordings have this cadence.

    Raises `PblError` DB_NOT_FOUND if there is no such check (any longer), USAGE for one that is not WARN, and without
    a reason or with one of more than 500 characters.

    `key`, `number`: key of SessionQc and `qc_no` of the check. `by`, `reason`: who accepts it, and why (no names).
    """
    reason = " ".join(reason.split())
    if not 0 < len(reason) <= 500:
        raise PblError(
            "USAGE",
            found=f"a reason of {len(reason)} characters" if reason else "no reason",
            expected="1 to 500 characters: why this result can be used all the same",
            next_step="write the reason into the field beside the check; nothing was accepted",
        )
    key = {k: key[k] for k in qc.SessionQc.primary_key}
    session_id = int((fit.FitSet & key).fetch1("session_id"))
    with locked(session_id):
        rows = (qc.SessionQc.proj("qc_computed") * qc.SessionQc.Check & key & {"qc_no": number}).to_dicts()
        if not rows:
            raise PblError(
                "DB_NOT_FOUND",
                found=f"no check {number} of this result",
                expected="a check that the page shows",
                next_step="load the page again: it may have been computed anew",
                key=f"session_id={session_id}",
            )
        outcome, check = rows[0]["qc_check_outcome"], rows[0]["qc_check"]
        if not may_be_accepted(check, outcome):
            raise PblError(
                "USAGE",
                found=f"the check {check} is {outcome}",
                expected="a check that asks for attention (WARN)",
                next_step="what failed is not accepted: it is recorded or computed again",
                key=f"session_id={session_id}",
            )
        if number in accepted(key):
            return
        about = {**key, "computed": str(rows[0]["qc_computed"]), "qc_no": number, "check": check}
        refused = _refused_cadences(key) if outcome == "FAIL" else {}
        if refused:
            about["cadence"] = {str(trial["video_id"]): cadence for trial, cadence in refused}
        record("check", by, about, {"outcome": outcome}, {"outcome": "accepted"}, reason, session_id=session_id)
        delete_below(gait.GaitCycle, [trial for trial, _ in refused])
        queue_visit(session_id)


def may_be_accepted(check: str, outcome: str) -> bool:
    """Return whether a person can accept a check: one that asks for attention, and an unusual cadence."""
    return outcome == "WARN" or (outcome, check) == ("FAIL", CADENCE)


def _refused_cadences(key: Mapping[str, Any]) -> list[tuple[dict[str, Any], float]]:
    """Return the trials of a result (keys of GaitCycle) whose cycles are left out for their cadence, and that
    cadence (steps/min)."""
    from pbl_pipeline.gait import refused_cadence

    of_result = {k: key[k] for k in gait.GaitCycle.primary_key if k in key}
    found = []
    for trial in (gait.GaitCycle & of_result).proj().to_dicts():
        cycles = [gait.cycle_of_row(r, "") for r in (gait.GaitCycle.Cycle & trial).to_dicts(order_by="cycle_no")]
        if (cadence := refused_cadence(cycles)) is not None:
            found.append((trial, cadence))
    return found


def accepted(key: Mapping[str, Any]) -> dict[int, Decided]:
    """Checks of a result (key of SessionQc) that were accepted since it was computed, by `qc_no`."""
    key = {k: key[k] for k in qc.SessionQc.primary_key}
    checks = qc.SessionQc.Check * qc.SessionQc.proj("qc_computed") * fit.FitSet.proj("session_id")
    rows = (checks & key & {"qc_check_outcome": "WARN"}).to_dicts()
    if not rows:
        return {}
    found = (Decision & {"session_id": rows[0]["session_id"], "decision_what": "check"}).to_dicts()
    own = [d for d in found if key.items() <= d["decision_about"].items()]
    return {int(row["qc_no"]): _decided(d) for row in rows for d in own if is_accepted(row, d["decision_about"])}


def is_accepted(row: Mapping[str, Any], about: Mapping[str, Any]) -> bool:
    """Return whether a check that asks for attention (row of SessionQc.Check with `qc_computed`) is the one that a
    decision about the same result accepted. An unusual cadence that does not fail was accepted, also before the checks
    were computed."""
    if CADENCE == row["qc_check"] == about["check"] and "cadence" in about:
        return True
    return (str(row["qc_computed"]), int(row["qc_no"])) == (about["computed"], int(about["qc_no"]))


def accepted_sql(check: str, checks: str, of_visit: str) -> str:
    """Condition in SQL: a check is one that `is_accepted` of any decision about its visit. The arguments are aliases of
    SessionQc.Check, SessionQc and a table with `session_id`."""
    about = "JSON_VALUE(d.decision_about, '$.{}')".format
    same = " AND ".join(f"{about(k)} = {check}.{k}" for k in qc.SessionQc.primary_key)
    cadence = f"{check}.qc_check = '{CADENCE}' AND {about('check')} = '{CADENCE}'"
    return (
        f"EXISTS (SELECT 1 FROM {Decision.full_table_name} d WHERE d.session_id = {of_visit}.session_id"  # noqa: S608
        f" AND d.decision_what = 'check' AND {same} AND (({cadence}"
        " AND JSON_CONTAINS_PATH(d.decision_about, 'one', '$.cadence'))"
        f" OR ({about('computed')} = CAST({checks}.qc_computed AS CHAR) AND {about('qc_no')} = {check}.qc_no)))"
    )


#: Functions that queue what a decision about a visit (session_id) made computable.
QUEUE: list[Callable[[int], object]] = []


def queue_visit(session_id: int) -> None:
    """Queue what a decision made computable of a visit, once it is committed, so that pages and workers see it."""
    for queue in QUEUE:
        after_commit(functools.partial(queue, session_id))


def record(what: str, by: str, about: dict, before: dict, after: dict, reason: str = "", **of: int) -> None:
    """Insert a row of Decision; `of`: session_id or video_id. Inside the transaction of what was decided. Raises
    `PblError` USAGE for a reason of more than 500 characters."""
    check_label("reason", reason, 500)
    Decision.insert1(
        {
            "decision_id": next_id(Decision, "decision_id"),
            **of,
            "decision_what": what,
            "decision_by": by,
            "decision_at": utc_now(),
            "decision_about": about,
            "decision_before": before,
            "decision_after": after,
            "decision_reason": reason,
        }
    )


def record_viewing(of: str, number: int, what: str, by: str) -> None:
    """Insert a row of Viewing, unless the number is unknown. `of`, `number`: "video_id" or "session_id", and which;
    `what`: the viewed part of it, such as "video" or "report"."""
    if not {"video_id": video.Video, "session_id": session.Session}[of] & {of: number}:
        return
    row = {of: number, "viewing_what": what, "viewing_by": by, "viewing_at": utc_now()}
    in_transaction(lambda: Viewing.insert1({"viewing_id": next_id(Viewing, "viewing_id"), **row}))


def _decided(row: Mapping[str, Any]) -> Decided:
    parts = {k: row[f"decision_{k}"] for k in ("what", "by", "at", "about", "before", "after", "reason")}
    number = row["video_id"]
    return Decided(int(row["decision_id"]), **parts, video_id=None if number is None else int(number))


def meanwhile(video_id: int, what: str) -> PblError:
    """DECIDED_MEANWHILE: the kind of decision about a recording was made, or what is decided about computed, since the
    page was loaded."""
    about = {"video_id": video_id, "decision_what": what}
    rows = (Decision & about).to_dicts(order_by="decision_id DESC", limit=1)
    last = rows[0] if rows else None
    after = {} if last is None else last["decision_after"]
    said = ", ".join(f"{k} {v}" for k, v in after.items() if not isinstance(v, list))
    who = (
        f"{last['decision_by']} decided for {said} at {moment(last['decision_at'])}"
        if last
        else "what is decided about was made or computed anew"
    )
    return PblError(
        "DECIDED_MEANWHILE",
        found=f"since this page was loaded {who}",
        expected="the state that the page showed; nothing of yours was written",
        next_step="load the page again, look at what was decided, and decide then",
        key=f"video_id={video_id}",
    )
