"""Gait events of a trial."""

from __future__ import annotations

import csv
from pathlib import Path

from pbl_pipeline.qc import Check
from pbl_pipeline.records import column, record, stored

LEFT, RIGHT = "left", "right"
FOOT_DOWN, FOOT_UP = "foot_down", "foot_up"
SIDES = (LEFT, RIGHT)
EVENTS = (FOOT_DOWN, FOOT_UP)
#: Columns of `events.csv`.
COLUMNS = ("time_s", "side", "event", "probability")


@record
class GaitEvent:
    """One event. `probability` in 0..1 that it is real: calibrated in the event model, only a measure of prominence in
    the coordinate-based methods; `bout` counts walking bouts from 0."""

    time_s: float = column("event_time", "(s) time of the trial")
    side: str = column("event_side", type="enum('left', 'right')")
    event: str = column("event_kind", type="enum('foot_down', 'foot_up')")
    probability: float = column(
        "event_probability", "(0..1) that it is real; by coordinates: how clear it is, not calibrated"
    )
    bout: int = column("event_bout", "walking bout, from 0", "int16", default=0)

    def __post_init__(self) -> None:
        if self.side not in SIDES or self.event not in EVENTS:
            raise ValueError(f"side {self.side!r} or event {self.event!r} is not one of {SIDES}, {EVENTS}")


@record
class SetEvent:
    """One event of a correction."""

    time_s: float = column("corrected_time", "(s) time of the trial")
    side: str = column("corrected_side", type="enum('left', 'right')")
    event: str = column("corrected_kind", type="enum('foot_down', 'foot_up')")
    probability: float | None = column(
        "corrected_probability", "(0..1) of the detection, which found it there; null: set by hand"
    )


@record
class GaitEvents:
    """The events of one trial in order of time.

    `status` is "PASS" or "EMPTY" (no walking, with the `reason`). `params_hash` identifies the parameters, `source` the
    trajectories ("fit", "keypoints blazepose_33", ...). `walking_s` lists start and end of each bout. `n_candidates`
    counts candidates before their check, `n_order_breaks` the bouts that ended because an event was missing, or the
    pairs that are out of order.
    """

    status: str = column("events_status", type="enum('PASS', 'EMPTY')")
    events: tuple[GaitEvent, ...]
    reason: str = column("events_reason", "why EMPTY", "varchar(1000)", cut=True)
    method: str = column("events_detector", "name of the method in the library", "varchar(64)")
    params_hash: str
    source: str = column("events_source", "what the feet come from", "varchar(64)")
    walking_s: tuple[tuple[float, float], ...] = column(
        "walking_bouts", "(s) start and end of each walking bout", "json", default=()
    )
    n_candidates: int = column("n_candidates", "possible events before their check", "int16", default=0)
    n_order_breaks: int = column(
        "n_order_breaks", "bouts that ended because an event was missing or out of order", "int16", default=0
    )
    qc: tuple[Check, ...] = ()

    @property
    @stored("n_events", type="int16", before="n_candidates")
    def n_events(self) -> int:
        """Number of events."""
        return len(self.events)

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
