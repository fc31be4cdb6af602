"""Events that a person corrects: what the page shows, saving them, and going back to the automatic ones."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError

from . import fit, gait, gdi, keypoints, video
from .decide import meanwhile, record
from .method_rows import method_row, register
from .plan import locked
from .recording_page import trial_key
from .results import load_trial_fit
from .review import Decision
from .rows import delete_below, utc_now

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib

#: Time (s), side, kind, and the probability of the automatic method (None: set by hand).
Event = tuple[float, str, str, float | None]
#: Two times closer than this are the same (s): what a page sends is rounded.
_SAME_S = 0.0015


@dataclasses.dataclass(frozen=True)
class Shown:
    """The events of a trial that the page shows, and where they come from.

    trial: its number; method: the automatic method whose events they are, or that the corrections began from;
    automatic: its events; hand: the corrected ones, None where nobody corrected any of the person that is measured; by,
    at, n_changed: who, when (UTC) and how many; stale: corrections are of another person, and not used; state: another
    text after each change.
    """

    trial: int
    method: str
    automatic: tuple[Event, ...]
    hand: tuple[Event, ...] | None
    by: str
    at: datetime.datetime | None
    n_changed: int
    stale: bool
    state: str

    @property
    def events(self) -> tuple[Event, ...]:
        """Those that count."""
        return self.automatic if self.hand is None else self.hand


def shown(video_id: int) -> Shown | None:
    """Of a recording; None where no events were searched in a current fit of it yet."""
    key = trial_key(fit.trial_of(video_id))
    if key is None:
        return None
    rows = (gait.GaitEvents.proj("events_computed") & key).to_dicts(order_by="events_computed DESC")
    searched = [r for r in rows if not gait.is_by_hand(r["gait_method"])]
    if not searched:
        return None
    row, trial = searched[0], int(key["video_id"])
    of_row = (gait.GaitEvents.Event & {k: row[k] for k in gait.GaitEvents.primary_key}).to_dicts(order_by="event_no")
    automatic = tuple(
        (float(e["event_time"]), e["event_side"], e["event_kind"], float(e["event_probability"])) for e in of_row
    )
    about = (gait.HandEvents & {"video_id": trial}).to_dicts()
    found = gait.corrected(key, [trial]).get(trial)
    last = (Decision & {"video_id": trial, "decision_what": "events"}).to_arrays("decision_id")
    state = f"{max(map(int, last), default=0)}-{row['gait_method']}-{row['events_computed']}-{key['fit_set']}"
    by = about[0] if about and found is not None else {}
    return Shown(
        trial=trial,
        method=row["gait_method"],
        automatic=automatic,
        hand=None if found is None else tuple(found["events"]),
        by=by.get("hand_by", ""),
        at=by.get("hand_at"),
        n_changed=int(by.get("hand_changed", 0)),
        stale=bool(about) and found is None,
        state=state,
    )


def save(video_id: int, events: Sequence[tuple[float, str, str]], by: str, seen: str) -> dict[str, int]:
    """Write the events of a trial as a person set them, with a row of Decision: one transaction.

    The session gets a method `by-hand`, which names the automatic one that it began from; its other trials keep that
    one's events. The automatic events and all results by them stay. What was computed from earlier corrections of this
    trial is deleted and pending again.

    Parameters
    ----------
    events
        Time (s), side and kind of all events that there are now.
    seen
        `Shown.state` of the page on which they were set.

    Returns
    -------
    dict
        Table name to number of deleted rows.

    Raises
    ------
    PblError
        EVENTS_IMPLAUSIBLE, which names the event; DECIDED_MEANWHILE; DB_NOT_FOUND for a recording without events;
        USAGE where nothing was changed.
    """
    from pbl_pipeline.gait import GaitEvent, check_by_hand

    before = _must_be_shown(video_id)
    key = trial_key(before.trial)
    assert key is not None
    time = load_trial_fit(key).time_s
    known = [e[:3] for e in before.automatic]
    given = [GaitEvent(float(t), side, kind, 1.0) for t, side, kind in events]
    # Frames begin at their time stamps: half a step before the first is no other moment.
    checked = check_by_hand(given, float(time[0]) - _SAME_S, float(time[-1]) + _SAME_S, known)
    found = tuple(_with_probability(e, before.automatic) for e in checked)
    if [e[:3] for e in found] == [e[:3] for e in before.events]:
        raise PblError(
            "USAGE",
            found="the events that are there already",
            expected="an event that was moved, added or taken away",
            next_step="change one, then save",
            key=f"video_id={video_id}",
        )
    return _decide(before, found, by, seen)


def take_back(video_id: int, by: str, seen: str) -> dict[str, int]:
    """Go back to the automatic events of a trial, with a row of Decision. Not corrected: nothing happens.

    Raises `PblError` DECIDED_MEANWHILE, DB_NOT_FOUND.
    """
    return _decide(_must_be_shown(video_id), None, by, seen)


def _decide(before: Shown, events: tuple[Event, ...] | None, by: str, seen: str) -> dict[str, int]:
    trial = {"video_id": before.trial}
    session_id = int((video.Video & trial).fetch1("session_id"))
    with locked(session_id):
        now = _must_be_shown(before.trial)
        if now.state != seen:
            raise meanwhile(before.trial, "events")
        there = (gait.HandEvents & trial).to_dicts()
        if events is None and not there:
            return {}
        (gait.HandEvents.Event & trial).delete_quick()
        (gait.HandEvents & trial).delete_quick()
        if events is None:
            deleted = _unplan(session_id) or _outdated(session_id, before.trial)
            after: dict[str, Any] = {"by": "automatic"}
        else:
            if not _planned(session_id):
                gait.GaitPlan.insert1({"session_id": session_id, "gait_method": _method(now.method)})
            gait.HandEvents.insert1({**trial, **_about(now, events, by)})
            names = ("hand_time", "hand_side", "hand_kind", "hand_probability")
            gait.HandEvents.Event.insert(
                {**trial, "hand_no": i, **dict(zip(names, e, strict=True))} for i, e in enumerate(events, 1)
            )
            deleted = _outdated(session_id, before.trial)
            after = {"by": "hand", "changed": _n_changed(events, now.automatic), "events": _listed(events)}
        was = {"by": "automatic" if now.hand is None else "hand", "events": _listed(now.events)}
        record("events", by, {"method": now.method}, was, after, video_id=before.trial)
    return deleted


def _about(now: Shown, events: Sequence[Event], by: str) -> dict[str, Any]:
    """The columns of HandEvents."""
    key = trial_key(now.trial)
    of_set = (fit.FitSet.Video & key) * keypoints.Keypoints.proj("keypoints_person_id")
    measured = of_set.to_dicts()
    return {
        "hand_from": now.method,
        "hand_changed": _n_changed(events, now.automatic),
        "hand_tracking": measured[0]["tracking_method"] if measured else None,
        "hand_person": measured[0]["keypoints_person_id"] if measured else None,
        "hand_by": by[:64],
        "hand_at": utc_now(),
    }


def _method(automatic: str) -> str:
    """Key of the method by hand that begins from an automatic one; it becomes a row when it is first asked for."""
    from pbl_pipeline.gait import BY_HAND, ByHandParams

    row = method_row(gait.GaitEventMethod, {"gait_method": automatic})
    made = methods.of_stage("gait").make(BY_HAND, 1, ByHandParams(automatic, row["sha"]))
    return register(gait.GaitEventMethod, made)[0]


def _planned(session_id: int) -> list[str]:
    """The methods by hand of a session: one at most."""
    of_session = (gait.GaitPlan & {"session_id": session_id}).to_arrays("gait_method")
    return [m for m in map(str, of_session) if gait.is_by_hand(m)]


def _outdated(session_id: int, trial: int) -> dict[str, int]:
    """Delete what was computed by hand of a trial and of its session."""
    sets = [{"fit_set": s} for s in (fit.FitSet.Video & {"video_id": trial}).to_arrays("fit_set")]
    by_hand = [{"gait_method": m} for m in _planned(session_id)]
    events = (gait.GaitEvents & by_hand & {"video_id": trial}).keys() if by_hand else []
    measures = (gdi.SessionGdi & by_hand & sets).keys() if by_hand else []
    return {**delete_below(gait.GaitEvents, events), **delete_below(gdi.SessionGdi, measures)}


def _unplan(session_id: int) -> dict[str, int] | None:
    """Delete the plan by hand of a session and all results of it, where no trial has corrections any more; None where
    one has."""
    videos = (video.Video & {"session_id": session_id}).proj()
    if gait.HandEvents & videos:
        return None
    by_hand = [{"gait_method": m, "session_id": session_id} for m in _planned(session_id)]
    deleted: dict[str, int] = {}
    if by_hand:
        for table in (gait.GaitEvents, gdi.SessionGdi):
            deleted |= delete_below(table, (table & by_hand).keys())
        (gait.GaitPlan & by_hand).delete_quick()
    return deleted


def _with_probability(e: lib.GaitEvent, automatic: Sequence[Event]) -> Event:
    """An event as it is stored: one that the automatic method found keeps its time and probability."""
    same = (a for a in automatic if a[1:3] == (e.side, e.event) and abs(a[0] - e.time_s) < _SAME_S)
    return next(same, (round(e.time_s, 4), e.side, e.event, None))


def _n_changed(events: Sequence[Event], automatic: Sequence[Event]) -> int:
    """Events that were moved, added or taken away; one that was moved counts once."""
    kept = sum(e[3] is not None for e in events)
    return max(len(automatic) - kept, len(events) - kept)


def _listed(events: Sequence[Event]) -> list[list[Any]]:
    return [[round(t, 4), side, kind] for t, side, kind, _ in events]


def _must_be_shown(video_id: int) -> Shown:
    found = shown(video_id)
    if found is None:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no events of video_id {video_id}",
            expected="a recording in whose current fit events were searched",
            next_step="`pbl populate`; `pbl why` says what stops it",
            key=f"video_id={video_id}",
        )
    return found
