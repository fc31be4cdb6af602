"""Early verdict on recordings, while the person is still present."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

from pbl_pipeline.qc import FAIL, PASS

from .. import fit, gait, keypoints, video
from ..datajoint_setup import dj
from ..rows import inside
from .shown import shown_visit
from .why import Why, whys

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
    return verdicts([video_id])[video_id]


def verdicts(videos: Collection[int]) -> dict[int, Usable]:
    """Return `usable` of recordings by their numbers, with as many queries for one as for hundreds."""
    if not videos:
        return {}
    where = inside("video_id", videos)
    marks = {int(r["video_id"]): r["unusable_reason"] for r in (video.NotUsable & where).to_dicts()}
    checks: dict[int, list[dict[str, Any]]] = {}
    for row in (keypoints.Keypoints.Check & where).to_dicts(order_by="KEY"):
        checks.setdefault(int(row["video_id"]), []).append(row)
    cycles, reasons = _cycles(where)
    left = [v for v in videos if v not in marks]
    states = whys(v for v in left if v not in checks or v not in cycles)
    out = {v: Usable(UNUSABLE, (mark,)) for v, mark in marks.items()}
    for v in left:
        out[v] = _verdict(checks.get(v, []), cycles.get(v), reasons.get(v, []), states.get(v))
    return out


def _verdict(
    checks: list[dict[str, Any]], cycles: tuple[int, int] | None, reasons: Sequence[str], state: Why | None
) -> Usable:
    """Return the verdict by the checks of the keypoints, the used cycles and the reasons for missing measures; state:
    of a recording without checks or cycles."""
    if not checks:
        assert state is not None
        return Usable(PENDING) if state.waits else Usable(UNUSABLE, (state.verdict,))
    asking = [c for c in checks if c["keypoints_check_outcome"] != PASS]
    # The worst first: that is what is read.
    asking.sort(key=lambda c: c["keypoints_check_outcome"] != FAIL)
    said = tuple(dict.fromkeys(_words(c) for c in asking))
    if any(c["keypoints_check_outcome"] not in (PASS, "WARN") for c in asking):
        return Usable(UNUSABLE, said, cycles)
    if state is not None and not state.waits:  # it failed after its keypoints
        return Usable(UNUSABLE, (*said, state.verdict))
    if cycles is not None and not any(cycles):
        return Usable(UNUSABLE, tuple(dict.fromkeys((*reasons, *said))), cycles)
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


def _words(check: dict[str, Any]) -> str:
    advice, value = check["keypoints_check_advice"], check["keypoints_check_value"]
    if check["keypoints_check"] in ("feet_cut_share", "head_cut_share") and value is not None:
        return f"{advice} ({value:.0%})"
    return advice


def _cycles(where: Any) -> tuple[dict[int, tuple[int, int]], dict[int, list[str]]]:
    """Return the used cycles, left and right, of the recordings whose events were searched, and why recordings have no
    measures."""
    # By their sets: the tables of the gait are not indexed by the recording.
    sets = inside("fit_set", set((fit.FitSet.Video & where).to_arrays("fit_set").tolist()))
    of_side = dj.U("video_id", "cycle_side").aggr(gait.GaitCycle.Cycle & sets & where & "cycle_used = 1", n="count(*)")
    found = {(int(r["video_id"]), r["cycle_side"]): int(r["n"]) for r in of_side.to_dicts()}
    searched = {int(v) for v in (gait.GaitCycle & sets & where).to_arrays("video_id")}
    reasons: dict[int, list[str]] = {}
    for row in (gait.Spatiotemporal & sets & where).proj("measures_reason").to_dicts(order_by="KEY"):
        reasons.setdefault(int(row["video_id"]), []).append(str(row["measures_reason"]))
    return {v: (found.get((v, "left"), 0), found.get((v, "right"), 0)) for v in searched}, reasons
