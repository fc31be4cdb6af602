"""Early verdict on recordings, while the person is still present."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Collection, Mapping
from typing import Any

from pbl_pipeline.qc import FAIL, PASS
from pbl_pipeline.records import number
from pbl_pipeline.words import TASKS

from .. import fit, gait, keypoints, video
from ..capture import PhoneRecording
from ..datajoint_setup import dj
from ..rows import grouped, inside
from .shown import shown_visit
from .why import Why, whys

#: Verdicts on a recording: not known yet; usable; usable with remarks; unusable.
PENDING, USABLE, REMARKS, UNUSABLE = "pending", "usable", "remarks", "unusable"
#: Recordings of which `usual_seconds` is the median, and the fewest.
_RECENT, _FEWEST = 20, 3


@dataclasses.dataclass(frozen=True)
class Needs:
    """Properties of a usable recording of an activity. cycles: True where a gait cycle has to count, False where none
    may, None where it does not matter; measures: of the task, each known and above 0; wanted: without them there is a
    remark."""

    cycles: bool | None = None
    measures: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()


#: Activity -> what a usable recording of it has. Stairs, tandem walking, running and words of a laboratory are walked:
#: that stairs were climbed is not checked.
NEEDS = {
    "sit_to_stand": Needs(measures=("rise_count",), wanted=("five_rises_time_s",)),
    "tug": Needs(measures=("tug_time_s", "turn_time_s")),
    "squat": Needs(measures=("squat_count",)),
    "standing": Needs(cycles=False),
    "fsst": Needs(),  # of which nothing is measured
}
_WALKED = Needs(cycles=True)
#: Next step for a recording that does not show its activity.
OTHER_ACTIVITY = "film it again; if something else was filmed, correct its activity on the page of the visit"


@dataclasses.dataclass(frozen=True)
class Usable:
    """The verdict on a recording."""

    state: str  # `PENDING`, `USABLE`, `REMARKS` or `UNUSABLE`
    said: tuple[str, ...] = ()  # what is wrong and what to do, in the words of the library
    #: Used gait cycles, left and right; None before events are searched, and where they do not matter.
    cycles: tuple[int, int] | None = None
    activity: str = ""  # as it is registered


@dataclasses.dataclass(frozen=True)
class _Found:
    """What was measured of a recording. cycles: used ones, left and right; reason: why it has no measures of walking;
    measures: those of its task, with the reason where one is not known."""

    cycles: tuple[int, int]
    reason: str
    measures: Mapping[str, tuple[float | None, str]]


@dataclasses.dataclass(frozen=True)
class Next:
    """Gain of one more pass: half the 90 % interval of the index now and after it, and the side from which it is filmed
    ("left", "right", or "" for front and back)."""

    side: str
    now: float
    then: float


def usable(video_id: int) -> Usable:
    """Return the verdict on a recording by the checks of its keypoints, what its activity needs (`NEEDS`), or the error
    that stopped it."""
    return verdicts([video_id])[video_id]


def verdicts(videos: Collection[int]) -> dict[int, Usable]:
    """Return `usable` of recordings by their numbers, with as many queries for one as for hundreds."""
    if not videos:
        return {}
    where = inside("video_id", videos)
    marks = {int(r["video_id"]): r["unusable_reason"] for r in (video.NotUsable & where).to_dicts()}
    checks = grouped((int(r["video_id"]), r) for r in (keypoints.Keypoints.Check & where).to_dicts(order_by="KEY"))
    found, done = _found(where), video.conditions(where)
    left = [v for v in videos if v not in marks]
    states = whys(v for v in left if v not in found)
    out = {v: Usable(UNUSABLE, (mark,)) for v, mark in marks.items()}
    for v in left:
        out[v] = _verdict(done[v].activity, checks.get(v, []), found.get(v), states.get(v))
    return {v: dataclasses.replace(judged, activity=done[v].activity) for v, judged in out.items()}


def _verdict(activity: str, checks: list[dict[str, Any]], found: _Found | None, state: Why | None) -> Usable:
    """Return the verdict by the checks of the keypoints and what was measured; state: of a recording that is not
    measured, and so not usable yet."""
    asking = [c for c in checks if c["keypoints_check_outcome"] != PASS]
    # The worst first: that is what is read.
    asking.sort(key=lambda c: c["keypoints_check_outcome"] != FAIL)
    said = tuple(dict.fromkeys(_words(c) for c in asking))
    needs = NEEDS.get(activity, _WALKED)
    cycles = found.cycles if found is not None and needs.cycles else None
    if any(c["keypoints_check_outcome"] not in (PASS, "WARN") for c in asking):
        return Usable(UNUSABLE, said, cycles)
    if found is None:
        assert state is not None
        return Usable(UNUSABLE, (*said, state.verdict)) if state.stops else Usable(PENDING)
    lacks = _lacks(needs, found)
    if lacks is not None:
        return Usable(UNUSABLE, tuple(dict.fromkeys((*lacks, *said))), cycles)
    missing = (found.measures[name][1] for name in needs.wanted if name in found.measures)
    said = tuple(dict.fromkeys((*filter(None, missing), *said)))
    return Usable(REMARKS if said else USABLE, said, cycles)


def _lacks(needs: Needs, found: _Found) -> tuple[str, ...] | None:
    """Return why a measured recording does not have what its activity needs, None if it does."""
    if needs.cycles and not any(found.cycles):
        return tuple(filter(None, (found.reason,)))
    if needs.cycles is False and any(found.cycles):
        return "the person walks", OTHER_ACTIVITY
    if all(found.measures.get(name, (None, ""))[0] for name in needs.measures):
        return None
    reasons = [reason for _, reason in found.measures.values() if reason]
    return (*reasons[:1], OTHER_ACTIVITY)


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


def _found(where: Any) -> dict[int, _Found]:
    """Return what was measured last of recordings, first of all with the sets that count."""
    # By their sets: the tables of the gait are not indexed by the recording.
    sets = inside("fit_set", set((fit.FitSet.Video & where).to_arrays("fit_set").tolist()))
    counting = {(r["fit_set"], r["fit_method"]) for r in (fit.current() & sets).proj().to_dicts()}
    rows = (gait.Spatiotemporal & sets & where).proj("measures_reason", "measures_computed").to_dicts(order_by="KEY")
    rows.sort(key=lambda r: ((r["fit_set"], r["fit_method"]) in counting, r["measures_computed"]))
    key = gait.Spatiotemporal.primary_key
    last = {int(r["video_id"]): r for r in rows}
    of_side = dj.U(*key, "cycle_side").aggr(gait.GaitCycle.Cycle & sets & where & "cycle_used = 1", n="count(*)")
    used = {(*(r[k] for k in key), r["cycle_side"]): int(r["n"]) for r in of_side.to_dicts()}
    measures: dict[tuple[Any, ...], dict[str, tuple[float | None, str]]] = {}
    of_tasks = gait.Spatiotemporal.Measure & sets & where & [{"measure": name} for name in TASKS]
    for r in of_tasks.proj("measure_mean", "measure_missing").to_dicts():
        of = measures.setdefault(tuple(r[k] for k in key), {})
        of[r["measure"]] = number(r["measure_mean"]), str(r["measure_missing"])
    out = {}
    for v, row in last.items():
        own = tuple(row[k] for k in key)
        left, right = (used.get((*own, side), 0) for side in ("left", "right"))
        of_task = {name: measures[own][name] for name in TASKS if name in measures.get(own, {})}
        out[v] = _Found((left, right), str(row["measures_reason"]), of_task)
    return out


def usual_seconds() -> float | None:
    """Return how long the verdicts on the last recordings of phones took (s, median), None for fewer than three."""
    rows = (PhoneRecording & "video_id IS NOT NULL").proj("video_id")
    videos = [int(v) for v in rows.to_arrays("video_id", order_by="phone_recording DESC", limit=_RECENT)]
    where = inside("video_id", videos)
    sets = inside("fit_set", set((fit.FitSet.Video & where).to_arrays("fit_set").tolist()))
    first = dj.U("video_id").aggr(gait.Spatiotemporal & sets & where, first="min(measures_computed)")
    took = [
        (r["first"] - r["video_created"]).total_seconds()
        for r in (first * video.Video.proj("video_created")).to_dicts()
    ]
    return statistics.median(took) if len(took) >= _FEWEST else None
