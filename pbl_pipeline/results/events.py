"""Gait events of a trial."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Annotated

from pbl_pipeline.qc import Check
from pbl_pipeline.records import Column, stored

LEFT, RIGHT = "left", "right"
FOOT_DOWN, FOOT_UP = "foot_down", "foot_up"
SIDES = (LEFT, RIGHT)
EVENTS = (FOOT_DOWN, FOOT_UP)
#: Columns of `events.csv`.
COLUMNS = ("time_s", "side", "event", "probability")


@dataclasses.dataclass(frozen=True)
class GaitEvent:
    """One event. `probability` in 0..1 that it is real: calibrated in the event model, only a measure of prominence in
    the coordinate-based methods; `bout` counts walking bouts from 0."""

    time_s: Annotated[float, Column("event_time", "float64", "(s) time of the trial")]
    side: Annotated[str, Column("event_side", "enum('left', 'right')")]
    event: Annotated[str, Column("event_kind", "enum('foot_down', 'foot_up')")]
    probability: Annotated[
        float,
        Column(
            "event_probability", "float64", "(0..1) that it is real; by coordinates: how clear it is, not calibrated"
        ),
    ]
    bout: Annotated[int, Column("event_bout", "int16", "walking bout, from 0")] = 0

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

    status: Annotated[str, Column("events_status", "enum('PASS', 'EMPTY')")]
    events: tuple[GaitEvent, ...]
    reason: Annotated[str, Column("events_reason", "varchar(1000)", "why EMPTY")]
    method: Annotated[str, Column("events_detector", "varchar(64)", "name of the method in the library")]
    params_hash: str
    source: Annotated[str, Column("events_source", "varchar(64)", "what the feet come from")]
    walking_s: Annotated[
        tuple[tuple[float, float], ...], Column("walking_bouts", "json", "(s) start and end of each walking bout")
    ] = ()
    n_candidates: Annotated[int, Column("n_candidates", "int16", "possible events before their check")] = 0
    n_order_breaks: Annotated[
        int, Column("n_order_breaks", "int16", "bouts that ended because an event was missing or out of order")
    ] = 0
    qc: tuple[Check, ...] = ()

    @property
    @stored("n_events", "int16", before="n_candidates")
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
