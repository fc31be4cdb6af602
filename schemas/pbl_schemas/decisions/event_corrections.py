"""Correction of gait events: their state on the page, saving, and return to the detected ones."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.results.events import SetEvent

from .. import fit, gait, video
from ..plan import locked
from ..reading.objects import load_trial_fit
from ..rows import delete_below, utc_now
from ..transactions import repeated
from .review_decisions import last_decision, meanwhile, queue_visit, record

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib

#: Time (s), side, kind, and the probability of the detection (None: set by hand).
Event = tuple[float, str, str, float | None]
#: Tracking method and number of a person, None for laboratory markers.
Person = tuple[str | None, int | None]
#: Two times closer than this are the same (s): what a page sends is rounded.
_SAME_S = 0.0015


@dataclasses.dataclass(frozen=True)
class ShownEvents:
    """The events of a trial that the page shows, and where they come from."""

    #: Key of the row of GaitEvents.
    key: Mapping[str, Any]
    detected: tuple[Event, ...]
    #: The events as a person set them; None if no one corrected any of the person who is measured.
    hand: tuple[Event, ...] | None
    #: Who corrected, when (UTC), and how many events.
    by: str
    at: datetime.datetime | None
    n_changed: int
    #: The corrections are of another person than the one who is measured, and are not used.
    stale: bool
    #: A different text after each change.
    state: str

    @property
    def method(self) -> str:
        """Key of the method that detected the events."""
        return self.key["gait_method"]

    @property
    def events(self) -> tuple[Event, ...]:
        """The events that count."""
        return self.detected if self.hand is None else self.hand


def shown_events(video_id: int) -> ShownEvents | None:
    """Return the events of a recording; None before any were detected in a current fit."""
    trial = fit.trial_key(fit.trial_of(video_id))
    key = None if trial is None else gait.newest_events(trial)
    if key is None:
        return None
    detected = gait.GaitEvents.Event.records(key)
    counts = gait.correction_of(key)
    about = {} if counts is None else (gait.EventCorrection & counts).fetch1()
    hand = None if counts is None else tuple(map(dataclasses.astuple, gait.EventCorrection.Event.records(counts)))
    last = last_decision(key["video_id"], "events")
    computed = (gait.GaitEvents & key).fetch1("events_computed")
    return ShownEvents(
        key=key,
        detected=tuple((e.time_s, e.side, e.event, e.probability) for e in detected),
        hand=hand,
        by=about.get("correction_by", ""),
        at=about.get("correction_at"),
        n_changed=int(about.get("correction_changed", 0)),
        stale=counts is None and bool(_standing(key)),
        state=f"{last}-{key['gait_method']}-{computed}-{key['fit_set']}",
    )


def save(video_id: int, events: Sequence[tuple[float, str, str]], by: str, seen: str) -> dict[str, int]:
    """Write the events that a person set in a trial, with a row of Decision, in one transaction.

    The detected events stay, and so do earlier corrections. Restoring the detected events withdraws the last
    correction, as `take_back` does. Cycles, measures and indices that were computed from other events of this trial are
    deleted and pending again.

    Raises `PblError` EVENTS_IMPLAUSIBLE, which names the event; DECIDED_MEANWHILE; DB_NOT_FOUND for a recording without
    events; USAGE where nothing was changed.

    Returns the number of deleted rows by table.

    `events`: time (s), side and kind of all current events. `seen`: `ShownEvents.state` of the page on which they
    were set.
    """
    from pbl_pipeline.gait import GaitEvent, check_correction

    before = _must_be_shown(video_id)
    time = load_trial_fit({k: before.key[k] for k in fit.SessionFit.Trial.primary_key}).time_s
    given = [GaitEvent(float(t), side, kind, 1.0) for t, side, kind in events]
    # Tolerates rounding at both ends.
    first, last = float(time[0]) - _SAME_S, float(time[-1]) + _SAME_S
    checked = check_correction(given, first, last, [e[:3] for e in before.detected])
    found = tuple(_with_probability(e, before.detected) for e in checked)
    if [e[:3] for e in found] == [e[:3] for e in before.events]:
        raise PblError(
            "USAGE",
            found="the events that are there already",
            expected="an event that was moved, added or taken away",
            next_step="change one, then save",
            key=f"video_id={video_id}",
        )
    detected = sorted(e[:3] for e in before.detected)
    return _decide(before, None if sorted(e[:3] for e in found) == detected else found, by, seen)


def take_back(video_id: int, by: str, seen: str) -> dict[str, int]:
    """Go back to the detected events of a trial, with a row of Decision. Without a correction nothing happens. Raises
    `PblError` DECIDED_MEANWHILE, DB_NOT_FOUND."""
    return _decide(_must_be_shown(video_id), None, by, seen)


@repeated
def _decide(before: ShownEvents, events: tuple[Event, ...] | None, by: str, seen: str) -> dict[str, int]:
    trial = int(before.key["video_id"])
    session_id = int((video.Video & {"video_id": trial}).fetch1("session_id"))
    with locked(session_id):
        now = _must_be_shown(trial)
        if now.state != seen:
            raise meanwhile(trial, "events")
        standing = _standing(now.key)
        if events is None and not standing:
            return {}
        if events is None:
            after: dict[str, Any] = {"by": "automatic"}
            for person in standing:
                _insert(now.key, person, by, correction_withdrawn=True)
        else:
            n_changed = _n_changed(events, now.detected)
            after = {"by": "hand", "changed": n_changed, "events": _listed(events)}
            number = _insert(now.key, gait.measured_person(now.key), by, correction_changed=n_changed)
            gait.EventCorrection.Event.insert_records(number, [SetEvent(*e) for e in events])
        was = {"by": "automatic" if now.hand is None else "hand", "events": _listed(now.events)}
        record("events", by, {"method": now.method}, was, after, video_id=trial)
        queue_visit(session_id)
        cycles = (gait.GaitCycle & _of_events(now.key)).proj("correction_no").to_dicts()
        outdated = [r for r in cycles if (gait.correction_of(r) or {}).get("correction_no") != r["correction_no"]]
        return delete_below(gait.GaitCycle, [{k: r[k] for k in gait.GaitCycle.primary_key} for r in outdated])


def _of_events(key: Mapping[str, Any]) -> dict[str, Any]:
    return {k: key[k] for k in ("video_id", "gait_method")}


def _standing(key: Mapping[str, Any]) -> list[Person]:
    """Return the people whose last correction was not withdrawn."""
    rows = (gait.EventCorrection & _of_events(key)).to_dicts(order_by="correction_no")
    last = {(r["correction_tracking"], r["correction_person"]): bool(r["correction_withdrawn"]) for r in rows}
    return [person for person, withdrawn in last.items() if not withdrawn]


def _insert(key: Mapping[str, Any], person: Person, by: str, **columns: Any) -> dict[str, Any]:
    of_events = _of_events(key)
    number = of_events | {"correction_no": 1 + len(gait.EventCorrection & of_events)}
    gait.EventCorrection.insert1(
        {
            **number,
            "correction_withdrawn": False,
            "correction_changed": 0,
            "correction_tracking": person[0],
            "correction_person": person[1],
            "correction_by": by,
            "correction_at": utc_now(),
            **columns,
        }
    )
    return number


def _with_probability(e: lib.GaitEvent, detected: Sequence[Event]) -> Event:
    """An event as it is stored: a detected one keeps its time and probability."""
    same = (a for a in detected if a[1:3] == (e.side, e.event) and abs(a[0] - e.time_s) < _SAME_S)
    return next(same, (round(e.time_s, 4), e.side, e.event, None))


def _n_changed(events: Sequence[Event], detected: Sequence[Event]) -> int:
    """Number of events that were moved, added or removed; one that was moved counts once."""
    kept = sum(e[3] is not None for e in events)
    return max(len(detected) - kept, len(events) - kept)


def _listed(events: Sequence[Event]) -> list[list[Any]]:
    return [[round(t, 4), side, kind] for t, side, kind, _ in events]


def _must_be_shown(video_id: int) -> ShownEvents:
    found = shown_events(video_id)
    if found is None:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no events of video_id {video_id}",
            expected="a recording in whose current fit events were searched",
            next_step="`pbl populate`; `pbl why` says what stops it",
            key=f"video_id={video_id}",
        )
    return found
