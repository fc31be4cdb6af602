"""Events that a person corrected by hand: their check, and what they become for the stages after."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterable, Sequence

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait.motion import FootTrajectories
from pbl_pipeline.methods import Method
from pbl_pipeline.qc import PASS, Check

from ._order import PLACE
from ._types import FOOT_DOWN, FOOT_UP, SIDES, GaitEvent, GaitEvents, no_events

#: Name of the family, and of its methods.
BY_HAND = "by-hand"
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


@dataclasses.dataclass(frozen=True)
class ByHandParams:
    """The automatic method that the corrections began from, which trials that nobody corrected keep: its key and its
    hash."""

    automatic: str
    automatic_hash: str


def detect_without_hands(feet: FootTrajectories, method: Method[ByHandParams]) -> GaitEvents:
    """The events of the automatic method, where nobody corrected any. Raises `PblError` as that method does, and
    SOLVER_UNKNOWN where it is not registered."""
    from ._methods import METHODS

    automatic = METHODS.find(method.params.automatic)
    return automatic.function(feet, automatic)


def check_by_hand(
    events: Iterable[GaitEvent], first_s: float, last_s: float, known: Collection[tuple[float, str, str]] = ()
) -> tuple[GaitEvent, ...]:
    """Events that a person set, in order of time, or what is wrong with one of them.

    Within a side initial contact and toe-off alternate, at least `SHORTEST_PHASE_S` apart, events of one kind at least
    `SHORTEST_CYCLE_S`; of one kind more than `LONGEST_CYCLE_S` apart nothing is asked for in between, because the
    person may have stood or left the view. Two that the automatic method left side by side may stay so.

    Parameters
    ----------
    events
        As they were set; times in s.
    first_s, last_s
        First and last frame of the recording (s).
    known
        Time (s), side and kind of the automatic events.

    Raises
    ------
    PblError
        EVENTS_IMPLAUSIBLE, which says which event and what is expected there.
    """
    found = sorted(events, key=lambda e: e.time_s)
    if len(found) > MOST_EVENTS:
        raise _implausible(f"{len(found)} events", f"at most {MOST_EVENTS} of a recording")
    outside = next((e for e in found if not first_s <= e.time_s <= last_s), None)
    if outside is not None:
        raise _implausible(f"{_said(outside)}", f"a time inside the recording, {first_s:.2f} to {last_s:.2f} s")
    left_so = _neighbours([GaitEvent(t, side, event, 1.0) for t, side, event in known])
    for side in SIDES:
        own = [e for e in found if e.side == side]
        for before, e in itertools.pairwise(own):
            apart, both = (
                e.time_s - before.time_s,
                f"{_said(e)}, {e.time_s - before.time_s:.2f} s after {_said(before)}",
            )
            if (_key(before), _key(e)) in left_so:
                continue
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


def events_by_hand(
    events: Sequence[GaitEvent], method: Method[ByHandParams], source: str, n_changed: int
) -> GaitEvents:
    """What events that `check_by_hand` passed are for the stages after: in bouts of walking.

    A bout ends where the next event is not the next in the order of walking, or comes later than `LONGEST_PHASE_S`.

    Parameters
    ----------
    source
        Of the trajectories that the person looked at, such as "fit".
    n_changed
        How many the person moved, added or took away.
    """
    if not events:
        return no_events(method.name, method.hash, source, "a person took every event away")
    bouts: list[list[GaitEvent]] = [[]]
    breaks = 0
    for e in events:
        if bouts[-1]:
            last = bouts[-1][-1]
            far = e.time_s - last.time_s > LONGEST_PHASE_S
            if far or PLACE[e.side, e.event] != (PLACE[last.side, last.event] + 1) % 4:
                bouts.append([])
                breaks += not far
        bouts[-1].append(e)
    numbered = tuple(dataclasses.replace(e, bout=i) for i, bout in enumerate(bouts) for e in bout)
    return GaitEvents(
        PASS,
        numbered,
        "",
        method.name,
        method.hash,
        source,
        tuple((bout[0].time_s, bout[-1].time_s) for bout in bouts),
        n_candidates=len(events),
        n_order_breaks=breaks,
        qc=(Check("events_by_hand", PASS, float(n_changed), None),),
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


def _implausible(found: str, expected: str) -> PblError:
    return PblError(
        "EVENTS_IMPLAUSIBLE",
        found=found,
        expected=expected,
        next_step="move, add or delete that event and save again; nothing was written",
    )
