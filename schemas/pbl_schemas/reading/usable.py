"""Early verdict on a recording, while the person is still present."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.qc import FAIL, PASS

from .. import gait, keypoints, qc, video
from .shown import shown_visit
from .why import why

#: Verdicts on a recording: not known yet; usable; usable with remarks; unusable.
PENDING, USABLE, REMARKS, UNUSABLE = "pending", "usable", "remarks", "unusable"


@dataclasses.dataclass(frozen=True)
class Usable:
    """The verdict on a recording."""

    state: str  # `PENDING`, `USABLE`, `REMARKS` or `UNUSABLE`
    said: tuple[str, ...] = ()  # what is wrong and what to do, in the words of the library
    cycles: tuple[int, int] | None = None  # used gait cycles, left and right; None before events are searched


@dataclasses.dataclass(frozen=True)
class Next:
    """Gain of one more pass: half the 90 % interval of the index now and after it, and the side from which it is filmed
    ("left", "right", or "" for front and back)."""

    side: str
    now: float
    then: float


def usable(video_id: int) -> Usable:
    """Return the verdict on a recording by the checks of its keypoints, its gait cycles, or the error that stopped
    it."""
    key = {"video_id": video_id}
    if video.NotUsable & key:
        return Usable(UNUSABLE, ((video.NotUsable & key).fetch1("unusable_reason"),))
    checks = (keypoints.Keypoints.Check & key).to_dicts(order_by="KEY")
    found = why(video_id)
    if not checks:
        return Usable(PENDING) if found.waits else Usable(UNUSABLE, (found.verdict,))
    asking = [c for c in checks if c["keypoints_check_outcome"] != PASS]
    # The worst first: that is what is read.
    asking.sort(key=lambda c: c["keypoints_check_outcome"] != FAIL)
    said = tuple(dict.fromkeys(_words(c) for c in asking))
    cycles = _cycles(key)
    if any(c["keypoints_check_outcome"] not in (PASS, "WARN") for c in asking):
        return Usable(UNUSABLE, said, cycles)
    if cycles is None and not found.waits:  # it failed after its keypoints
        return Usable(UNUSABLE, (*said, found.verdict))
    if cycles is not None and not any(cycles):
        reasons = (gait.Spatiotemporal & key).to_arrays("measures_reason")
        return Usable(UNUSABLE, tuple(dict.fromkeys((*map(str, reasons), *said))), cycles)
    return Usable(REMARKS if said else USABLE, said, cycles)


def next_pass(session_id: int) -> Next | None:
    """Return what one more pass of a visit would bring most; None before its index is known, or where its error is
    not known. Loads the visit."""
    from pbl_pipeline.gait import intervals_with_one_more

    about = shown_visit(session_id)
    visit = about.visit
    if about.shown is None or visit is None or visit.judged is None:
        return None
    index = visit.judged.gdi
    after = intervals_with_one_more(visit.judged.cycles, index)
    if not after or index.interval is None:
        return None
    side = min(after, key=lambda s: after[s])
    low, high = index.interval
    return Next(side, (high - low) / 2, after[side])


def computed(session_id: int) -> tuple[str, ...]:
    """Return the identity of the results of a visit."""
    return tuple(str(t) for t in (qc.SessionQc & {"session_id": session_id}).to_arrays("qc_computed"))


def _words(check: dict[str, Any]) -> str:
    advice, value = check["keypoints_check_advice"], check["keypoints_check_value"]
    if check["keypoints_check"] in ("feet_cut_share", "head_cut_share") and value is not None:
        return f"{advice} ({value:.0%})"
    return advice


def _cycles(key: dict[str, Any]) -> tuple[int, int] | None:
    if not gait.GaitCycle & key:
        return None
    sides = (gait.GaitCycle.Cycle & key & "cycle_used = 1").to_arrays("cycle_side")
    return int((sides == "left").sum()), int((sides == "right").sum())
