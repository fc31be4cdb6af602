"""Events that a person set: what is refused, and what they become."""

import dataclasses

import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import GaitEvent, GaitEvents, apply_correction, check_correction, find_cycles
from pbl_pipeline.qc import Check
from tests.unit.test_gait_cycles import DOWNS, EVENTS, walk

DETECTED = GaitEvents(
    "PASS",
    tuple(EVENTS),
    "",
    "zeni-2008",
    "0" * 16,
    "fit",
    ((1.0, 4.9),),
    40,
    3,
    (Check("heading", "WARN", None, None),),
)
KNOWN = [(e.time_s, e.side, e.event) for e in EVENTS]


def refused(events: list[GaitEvent], known=()) -> PblError:
    with pytest.raises(PblError) as error:
        check_correction(events, 0.0, 6.0, known)
    assert error.value.code == "EVENTS_IMPLAUSIBLE"
    return error.value


def test_a_walk_passes_in_whatever_order_it_is_sent():
    assert check_correction(EVENTS[::-1], 0.0, 6.0) == tuple(sorted(EVENTS, key=lambda e: e.time_s))
    assert check_correction([], 0.0, 6.0) == ()


@pytest.mark.parametrize(
    ("event", "found", "expected"),
    [
        (GaitEvent(6.5, "left", "foot_up", 1.0), "toe-off of the left foot at 6.50 s", "inside the recording"),
        (GaitEvent(1.05, "left", "foot_up", 1.0), "0.05 s after initial contact of the left", "at least 0.1 s"),
        (GaitEvent(1.3, "left", "foot_down", 1.0), "0.30 s after initial contact of the left", "at least 0.5 s"),
        (GaitEvent(4.9, "left", "foot_down", 1.0), "0.60 s after initial contact of the left", "toe-off of the left"),
        (
            GaitEvent(0.4, "right", "foot_up", 1.0),
            "toe-off of the right foot at 1.12 s",
            "initial contact of the right",
        ),
    ],
)
def test_what_cannot_be_walking_is_named(event: GaitEvent, found: str, expected: str):
    events = [e for e in EVENTS if not (e.side == "left" and e.time_s > 4.35)]
    error = refused([*events, event])
    assert found in error.found
    assert expected in error.expected


def test_what_the_automatic_method_left_may_stay():
    """It missed a toe-off: nobody has to invent it to correct another event; but what is new next to it is judged."""
    missed = [e for e in EVENTS if (e.side, e.event, e.time_s) != ("right", "foot_up", 2.22)]
    assert len(missed) == len(EVENTS) - 1
    refused(missed)
    refused(missed, KNOWN)  # who takes it away has to say what is there instead
    known = [(e.time_s, e.side, e.event) for e in missed]
    assert len(check_correction(missed, 0.0, 6.0, known)) == len(missed)
    refused([dataclasses.replace(e, time_s=2.65) if e.time_s == 2.6 else e for e in missed], known)


def test_bouts_and_cycles_of_corrected_events():
    again = [dataclasses.replace(e, time_s=e.time_s + 10.0) for e in walk(DOWNS[:4], {"left": 0.12, "right": 0.10})]
    checked = check_correction([*EVENTS, *again], 0.0, 20.0)
    found = apply_correction(DETECTED, checked, 3)
    assert (found.status, found.reason, found.n_candidates, found.n_order_breaks) == ("PASS", "", 24, 0)
    assert [e.bout for e in found.events] == [0] * 16 + [1] * 8
    assert [round(t, 6) for bout in found.walking_s for t in bout] == [1.0, 4.9, 11.0, 12.7]
    assert [(c.check, c.outcome, c.value) for c in found.qc] == [("events_by_hand", "PASS", 3.0)]
    assert len(find_cycles(found)) == 6 + 2
    # A step that is missing ends a bout, and its cycles are none.
    broken = apply_correction(DETECTED, [e for e in checked[:16] if e.time_s != 2.6], 1)
    assert broken.n_order_breaks == 1
    assert {e.bout for e in broken.events} == {0, 1}
    none = apply_correction(DETECTED, [], 16)
    assert (none.status, none.events, none.qc[0].outcome) == ("EMPTY", (), "EMPTY")


@pytest.mark.parametrize("events", [tuple(EVENTS), ()])
def test_a_correction_says_whose_detection_it_corrects(events: tuple[GaitEvent, ...]):
    found = apply_correction(DETECTED, events, 2)
    assert (found.method, found.params_hash, found.source) == ("zeni-2008", "0" * 16, "fit")
    assert (found.corrected, DETECTED.corrected) == (True, False)
    assert [c.value for c in found.qc if c.check == "events_by_hand"] == [2.0]
