"""Parameters of the detector, events of a trial without any, and files of events."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from pathlib import Path

from pbl_pipeline.bounded import MIB, read_text
from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import EMPTY, Check, warn_if
from pbl_pipeline.results.events import COLUMNS, GaitEvent, GaitEvents

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
