"""Corrections of detected events by a person: their validation, and the events that then count."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Collection, Iterable, Sequence

from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import PASS, Check
from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, SIDES, GaitEvent, GaitEvents

from .order import comes_next
from .types import no_events

#: Shortest time between two events of a side (s): a swing or a stance; the fastest walkers swing for 0.25 s.
SHORTEST_PHASE_S = 0.1
#: Shortest time between two events of one kind and side (s): 240 steps a minute.
SHORTEST_CYCLE_S = 0.5
#: Further apart than this two events of one kind and side are no cycle (s): the person stood, or was not in view.
LONGEST_CYCLE_S = 3.0
#: Further apart than this two events that follow each other belong to two bouts (s).
LONGEST_PHASE_S = 1.5
#: Most events of a recording.
MOST_EVENTS = 5000
_implausible = functools.partial(
    PblError, "EVENTS_IMPLAUSIBLE", next_step="move, add or delete that event and save again; nothing was written"
)


def check_correction(
    events: Iterable[GaitEvent], first_s: float, last_s: float, detected: Collection[tuple[float, str, str]] = ()
) -> tuple[GaitEvent, ...]:
    """Return the events that a person set in order of time, or raise an error about one of them.

    Initial contacts and toe-offs of a side alternate, at least `SHORTEST_PHASE_S` apart; two events of one kind and
    side are at least `SHORTEST_CYCLE_S` apart. Nothing is required between two that are more than `LONGEST_CYCLE_S`
    apart, because the person may have stood still or left the view. Neighbours that the method detected as such may
    stay.

    Raises `PblError` EVENTS_IMPLAUSIBLE, which names the event and what is expected there.

    Parameters
    ----------
    events
        As the person set them; times in s.
    first_s, last_s
        Times of the first and the last frame of the recording (s).
    detected
        Time (s), side and kind of the detected events.
    """
    found = sorted(events, key=lambda e: e.time_s)
    if len(found) > MOST_EVENTS:
        raise _implausible(f"{len(found)} events", f"at most {MOST_EVENTS} of a recording")
    outside = next((e for e in found if not first_s <= e.time_s <= last_s), None)
    if outside is not None:
        raise _implausible(_said(outside), f"a time inside the recording, {first_s:.2f} to {last_s:.2f} s")
    left_so = _neighbours([GaitEvent(t, side, event, 1.0) for t, side, event in detected])
    for side in SIDES:
        own = [e for e in found if e.side == side]
        for before, e in itertools.pairwise(own):
            if (_key(before), _key(e)) in left_so:
                continue
            apart = e.time_s - before.time_s
            both = f"{_said(e)}, {apart:.2f} s after {_said(before)}"
            if apart < SHORTEST_PHASE_S:
                raise _implausible(both, f"at least {SHORTEST_PHASE_S:g} s between two events of a side")
            if e.event != before.event:
                continue
            if apart < SHORTEST_CYCLE_S:
                raise _implausible(both, f"at least {SHORTEST_CYCLE_S:g} s between two of a kind of one side")
            if apart <= LONGEST_CYCLE_S:
                missing = _WORDS[FOOT_UP if e.event == FOOT_DOWN else FOOT_DOWN]
                raise _implausible(both, f"{missing} of the {side} foot between the two")
    return tuple(found)


def apply_correction(detected: GaitEvents, events: Sequence[GaitEvent], n_changed: int) -> GaitEvents:
    """Return the events after a person corrected the `detected` ones, in bouts of walking.

    A bout ends where the next event is not the next in the order of walking, or comes later than `LONGEST_PHASE_S`.
    Method, parameters and source stay those of the detection; the check `events_by_hand` marks corrected events.

    Parameters
    ----------
    events
        All events after the correction, as `check_correction` returned them.
    n_changed
        Number of events that the person moved, added or removed.
    """
    changes = Check("events_by_hand", PASS, float(n_changed), None)
    if not events:
        none = no_events(detected.method, detected.params_hash, detected.source, "a person removed every event")
        return dataclasses.replace(none, qc=(*none.qc, changes))
    bouts: list[list[GaitEvent]] = [[]]
    breaks = 0
    for e in events:
        if bouts[-1]:
            last = bouts[-1][-1]
            far = e.time_s - last.time_s > LONGEST_PHASE_S
            if far or not comes_next(last, e):
                bouts.append([])
                breaks += not far
        bouts[-1].append(e)
    numbered = tuple(dataclasses.replace(e, bout=i) for i, bout in enumerate(bouts) for e in bout)
    return GaitEvents(
        PASS,
        numbered,
        "",
        detected.method,
        detected.params_hash,
        detected.source,
        tuple((bout[0].time_s, bout[-1].time_s) for bout in bouts),
        n_candidates=len(events),
        n_order_breaks=breaks,
        qc=(changes,),
    )


_WORDS = {FOOT_DOWN: "initial contact", FOOT_UP: "toe-off"}


def _neighbours(events: Iterable[GaitEvent]) -> set[tuple[tuple, tuple]]:
    """Pairs of events of a side that follow each other."""
    found = sorted(events, key=lambda e: e.time_s)
    own = [[_key(e) for e in found if e.side == side] for side in SIDES]
    return {pair for keys in own for pair in itertools.pairwise(keys)}


def _key(e: GaitEvent) -> tuple[float, str, str]:
    return round(e.time_s, 3), e.side, e.event


def _said(e: GaitEvent) -> str:
    return f"{_WORDS[e.event]} of the {e.side} foot at {e.time_s:.2f} s"
