"""Gait events and the parameters of the detector."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from pathlib import Path

from pbl_pipeline.bounded import MIB, read_text
from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import EMPTY, Check, warn_if

LEFT, RIGHT = "left", "right"
FOOT_DOWN, FOOT_UP = "foot_down", "foot_up"
SIDES = (LEFT, RIGHT)
EVENTS = (FOOT_DOWN, FOOT_UP)
COLUMNS = ("time_s", "side", "event", "probability")
#: Of a file of events (bytes): some ten thousand.
_LARGEST = MIB


@dataclasses.dataclass(frozen=True)
class EventParams:
    """Parameters of the coordinate-based detector. Lengths are in leg lengths, so that an unknown scale cancels.

    cutoff_hz, filter_order
        Zero-phase Butterworth low-pass (`filter_order` is that of both passes together).
    grid_hz
        Rate of the uniform grid; time stamps of the frames may be irregular.
    max_gap_s
        Longer runs of missing frames split a trial into segments; shorter ones are interpolated.
    min_segment_s
        Shorter segments are not searched.
    min_confidence
        Points below are treated as missing.
    min_excursion_leg
        Smallest forward-backward movement of a foot against the pelvis that counts, in leg lengths.
    min_prominence_ratio
        Smallest prominence of an extremum against the typical one of the same side and event.
    min_cadence_per_min, max_cadence_per_min
        Limits of one step's cadence (60 / step time).
    min_swing_s, max_phase_s
        Shortest swing; longest swing or double support.
    break_cost
        Cost of a break of the event order in the search for the best sequence (one event weighs its probability).
    min_foot_downs
        Fewest initial contacts of a walking bout.
    foot_down_offset_s, foot_up_offset_s
        Added to every event of that kind: the correction of a measured bias, 0 for none.
    """

    cutoff_hz: float = 6.0
    filter_order: int = 4
    grid_hz: float = 100.0
    max_gap_s: float = 0.15
    min_segment_s: float = 1.0
    min_confidence: float = 0.1
    min_excursion_leg: float = 0.10
    min_prominence_ratio: float = 0.35
    min_cadence_per_min: float = 40.0
    max_cadence_per_min: float = 180.0
    min_swing_s: float = 0.15
    max_phase_s: float = 1.2
    break_cost: float = 1.5
    min_foot_downs: int = 2
    foot_down_offset_s: float = 0.0
    foot_up_offset_s: float = 0.0


@dataclasses.dataclass(frozen=True)
class GaitEvent:
    """One event. `probability` in 0..1 that it is real: calibrated in the event model, only a measure of prominence in
    the coordinate-based methods; `bout` counts walking bouts from 0."""

    time_s: float
    side: str
    event: str
    probability: float
    bout: int = 0

    def __post_init__(self) -> None:
        if self.side not in SIDES or self.event not in EVENTS:
            raise ValueError(f"side {self.side!r} or event {self.event!r} is not one of {SIDES}, {EVENTS}")


@dataclasses.dataclass(frozen=True)
class GaitEvents:
    """The events of one trial in order of time.

    `status` is "PASS" or "EMPTY" (no walking, with the `reason`). `params_hash` identifies the parameters, `source` the
    trajectories ("fit", "keypoints blazepose_33", ...). `walking_s` lists start and end of each bout. `n_candidates`
    counts candidates before their check, `n_order_breaks` the bouts that ended because an event was missing, or the
    pairs that are out of order.
    """

    status: str
    events: tuple[GaitEvent, ...]
    reason: str
    method: str
    params_hash: str
    source: str
    walking_s: tuple[tuple[float, float], ...] = ()
    n_candidates: int = 0
    n_order_breaks: int = 0
    qc: tuple[Check, ...] = ()

    @property
    def corrected(self) -> bool:
        """True if a person corrected the detected events."""
        return any(c.check == "events_by_hand" for c in self.qc)

    def times(self, side: str, event: str) -> list[float]:
        """Times in seconds of one kind of event."""
        return [e.time_s for e in self.events if e.side == side and e.event == event]

    def save(self, path: str | Path) -> None:
        """Write `events.csv`: time_s, side, event, probability. Without walking only the header is written."""
        with Path(path).open("w", encoding="utf-8", newline="") as f:
            rows = csv.writer(f, lineterminator="\n")
            rows.writerow(COLUMNS)
            for e in self.events:
                rows.writerow([f"{e.time_s:.4f}", e.side, e.event, f"{e.probability:.3f}"])


def no_events(
    method: str,
    params_hash: str,
    source: str,
    reason: str,
    advice: str = "",
    n_candidates: int = 0,
    n_order_breaks: int = 0,
) -> GaitEvents:
    """Return EMPTY events, with the reason and advice."""
    check = Check("walking", EMPTY, None, None, f"{reason}: {advice}" if advice else reason)
    return GaitEvents(EMPTY, (), reason, method, params_hash, source, (), n_candidates, n_order_breaks, (check,))


def heading_check(agreement: float) -> tuple[Check, ...]:
    """Check that the person walks in the direction of the pelvis; empty if the way is not known (NaN)."""
    if not math.isfinite(agreement):
        return ()
    advice = "the person does not go where the pelvis faces: sideways, or the camera moved"
    return (warn_if(not agreement >= 0.5, "heading_agreement", round(agreement, 3), 0.5, advice),)


def load_events(path: str | Path) -> tuple[GaitEvent, ...]:
    """Read `events.csv`, in order of time. The file does not hold bouts: all events get bout 0.

    Raises `PblError` FILE_FORMAT.
    """
    try:
        rows = csv.DictReader(io.StringIO(read_text(path, _LARGEST), newline=""))
        if tuple(rows.fieldnames or ()) != COLUMNS:
            raise ValueError(f"columns {rows.fieldnames}"[:200])
        found = [GaitEvent(float(r["time_s"]), r["side"], r["event"], float(r["probability"])) for r in rows]
        if not all(math.isfinite(e.time_s) and 0.0 <= e.probability <= 1.0 for e in found):
            raise ValueError("a time that is not finite, or a probability outside 0..1")
        return tuple(sorted(found, key=lambda e: e.time_s))
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise PblError(
            "FILE_FORMAT",
            found=str(error),
            expected=f"a CSV file with the columns {', '.join(COLUMNS)}",
            next_step="write it with `pbl events`, or see docs/files.md, section events.csv",
            key=str(path),
        ) from error
