"""Protocols: what is filmed in a visit, in which order, and how much of it a visit has."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

from pbl_pipeline.names import check_label

from ..capture import PhoneLink, Protocol, ProtocolStep
from ..reading.usable import PENDING, REMARKS, USABLE, Usable
from ..rows import utc_now
from ..transactions import in_transaction
from .phone_recordings import MOST_RECORDINGS, Sent
from .records import usage
from .sheets import needed, number_of, read_sheets, refused

VIEWS = ("left", "right", "front", "any")
COLUMNS = ("activity", "pace", "view", "passes")


def read_protocol(path: Path) -> list[ProtocolStep]:
    """Return the steps in a sheet, a row each in their order, with the columns `COLUMNS`. Raises `PblError`
    FILE_MISSING, SHEET_FORMAT."""
    (sheet,) = read_sheets(path)[:1] or [None]
    steps = []
    for number, row in enumerate(sheet.rows if sheet else (), 1):
        if row.error is not None:
            raise row.error
        activity, pace, view = needed(row, "activity"), row.cells.get("pace", ""), row.cells.get("view", "any")
        for what, text in (("activity", activity), ("pace", pace)):
            check_label(what, text, 32)
        passes = number_of(row, "passes", row.cells.get("passes", "1"))
        if view not in VIEWS or not 1 <= passes <= 99 or passes % 1:
            raise refused(
                f"view {view!r}, passes {passes:g}", f"view {', '.join(VIEWS)}; passes 1 to 99", "correct it", row.where
            )
        steps.append(ProtocolStep(number, activity, pace, view, int(passes)))
    if not 1 <= len(steps) <= MOST_RECORDINGS:
        expected = f"a row for each step, 1 to {MOST_RECORDINGS}: {', '.join(COLUMNS)}"
        raise refused(f"{len(steps)} rows", expected, "add the steps, or make two protocols", path)
    return steps


def add_protocol(name: str, steps: Sequence[ProtocolStep]) -> bool:
    """Register a protocol; return whether it is new. Raises `PblError` USAGE for the name of one with other steps."""
    check_label("protocol", name, 32, 1)
    if Protocol & {"protocol": name}:
        if _steps(name) == list(steps):
            return False
        expected = "a new name: visits were filmed by the old one"
        raise usage(f"protocol {name} with other steps", expected, next_step=f"call it {name}-2", key=name)

    def insert() -> None:
        Protocol.insert1({"protocol": name, "protocol_created": utc_now()})
        Protocol.Step.insert_records({"protocol": name}, steps)

    in_transaction(insert)
    return True


def protocols() -> list[str]:
    """Return the names of the protocols, in their order."""
    return sorted(str(name) for name in Protocol.to_arrays("protocol"))


def steps_of(session_id: int, sent: Iterable[tuple[Sent, Usable | None]]) -> list[ProtocolStep]:
    """Return the steps of the protocol of a visit's newest link, with what its `phone_recordings.recordings` have done,
    a video once, and only where the activity of the step is registered; none without a protocol."""
    from pbl_pipeline.gait import Condition

    links = (PhoneLink & {"session_id": session_id}).to_dicts(order_by="phone_link DESC")
    if not links or links[0]["protocol"] is None:
        return []
    once = {one.video_id: (one.about.get("step"), judged) for one, judged in sent if judged is not None}
    of = collections.Counter((step, judged.activity, judged.state) for step, judged in once.values())
    out = []
    for step in _steps(links[0]["protocol"]):
        this = str(step.number), Condition(step.activity).activity
        done = of[*this, USABLE] + of[*this, REMARKS]
        out.append(dataclasses.replace(step, done=done, waiting=of[*this, PENDING]))
    return out


def _steps(name: str) -> list[ProtocolStep]:
    return Protocol.Step.records({"protocol": name})
