"""Changes between two results of a person: how large, how probable, and why one cannot be judged."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import VIEW, Difference, Filming, differences
from pbl_pipeline.qc import CADENCE, PASS
from pbl_pipeline.texts import text

if TYPE_CHECKING:
    from pbl_pipeline.gait import Measure
    from pbl_pipeline.visit import Visit

_V = TypeVar("_V")
#: Name of the index among the measures.
INDEX = "gdi"
#: Difference of two stated body heights (m) from which on two visits without codes are taken for two people.
OTHER_HEIGHT_M = 0.1

#: Checks that put a result in doubt as a whole until a person accepted them: with steps counted twice or missed, times
#: and index are others.
DOUBTS = frozenset({CADENCE})


@dataclasses.dataclass(frozen=True)
class Result:
    """Index and checks of the current set of a visit by one chain of methods.

    sd: of the error of the index; minimal_change: minimal detectable change between two such visits (90 %).
    outcome: worst check, empty before the checks are computed, ACCEPTED if a person accepted every one that asked
    for attention; worst: the names of those that no one accepted. corrected: a person corrected events.
    """

    kind: str
    methods: tuple[str, str, str, str]
    status: str
    reason: str
    index: float | None
    sd: float | None
    minimal_change: float | None
    outcome: str
    worst: tuple[str, ...]
    corrected: bool = False
    filming: Filming | None = None  # how it was filmed; None if it was not looked up
    detection: tuple[str, str] = ("", "")  # methods of tracking and of the keypoints; "" if there are none

    @property
    def errors(self) -> tuple[float | None, float | None]:
        """Standard deviation of the error and minimal detectable change."""
        return self.sd, self.minimal_change

    @property
    def chain(self) -> tuple[str, ...]:
        """Kind of recordings and methods."""
        return self.kind, *self.detection, *self.methods


@dataclasses.dataclass(frozen=True)
class Change:
    """Change of a value against that of another result.

    real: probability that the true change goes the same way; important: that it does by at least the minimal important
    change, None if there is none for the value. Both are None if the change cannot be judged. sure: whether it is
    at least `least`, None if it cannot be judged. differs: why it cannot, with what is not alike in the two results:
    "checks" (one is not to be used, or in doubt by `DOUBTS`), "methods", "corrected" (events), "error" (not known), or
    what `filming.differences` finds; with a verdict it is at most the view, by which `least` is that of visits filmed
    from other sides.
    """

    by: float
    sure: bool | None
    least: float | None = None
    differs: tuple[Difference, ...] = ()
    real: float | None = None
    important: float | None = None

    def row(self, measure: str) -> dict[str, Any]:
        """Return the change as a row of a table, rounded; its verdict in the words of the pages."""
        verdict = "unsure" if self.sure is None else "more" if self.sure else "chance"
        numbers = {"change": self.by, "least": self.least, "real": self.real, "important": self.important}
        return {
            "measure": measure,
            **{name: None if value is None else round(value, 3) + 0.0 for name, value in numbers.items()},
            "verdict": text("en", f"compare.{verdict}"),
            "not_comparable": "" if self.sure is not None else "; ".join(map(str, self.differs)),
        }


def visit_before(result: Result, earlier: Sequence[tuple[_V, Result]]) -> tuple[_V, Result] | None:
    """Return the visit before one with `result`: the last with a result by the same chain of methods. `earlier`: those
    of the person whose result has the value, in the order of their days, of one day in that of their numbers; those
    without a day come first."""
    return next((one for one in reversed(earlier) if one[1].chain == result.chain), None)


def change_since(result: Result, before: Result) -> Change | None:
    """The change of the index from one result to another; None if one of them has no index.

    Filmed alike, a change is more than chance from the larger of the two minimal changes on. Filmed from other sides,
    the errors of the two views do not cancel: from Z90 sqrt(sd1^2 + sd2^2) on, of the sds of their whole errors.
    """
    from pbl_pipeline.gait import IMPORTANT_CHANGE

    if result.index is None or before.index is None:
        return None
    errors = [r.errors for r in (result, before)]
    return judged(result.index - before.index, errors, not_alike(result, before), IMPORTANT_CHANGE)


def change_of(name: str, result: Result, before: Result, mine: Measure | None, old: Measure | None) -> Change | None:
    """Return the change of the index (`INDEX`), or of a measure that two results have."""
    if name == INDEX:
        return change_since(result, before)
    return measure_changes({name: mine}, {name: old}, not_alike(result, before)).get(name)


def measure_changes(
    now: Mapping[str, Measure | None], before: Mapping[str, Measure | None], differs: tuple[Difference, ...]
) -> dict[str, Change]:
    """Return the changes of the measures that two results both have. `differs`: as in `judged`."""
    pairs = {name: (mine, before.get(name)) for name, mine in now.items()}
    return {
        name: judged(mine.mean - old.mean, [m.errors for m in (mine, old)], differs)
        for name, (mine, old) in pairs.items()
        if mine is not None and old is not None
    }


def judged(
    by: float,
    errors: Sequence[tuple[float | None, float | None]],
    differs: tuple[Difference, ...],
    important: float | None = None,
) -> Change:
    """Judge a change.

    `errors`: standard deviation of the error, and minimal detectable change, of both values; None if one is not
    known. `differs`: what was not alike (`not_alike`). `important`: of the index alone.
    """
    from pbl_pipeline.gait import MEASURES_REMAIN, REMAINS, Z90, chances, change_sd

    if any(d.what != VIEW for d in differs):
        return Change(by, None, None, differs)
    known = [(sd, least) for sd, least in errors if sd is not None and least is not None]
    if len(known) < len(errors):
        return Change(by, None, None, (*differs, Difference("error")))
    (sd_1, sd_2), (least_1, least_2) = zip(*known, strict=True)
    # From other sides the errors of the two views do not cancel.
    remains = MEASURES_REMAIN if important is None else REMAINS
    sd = math.hypot(sd_1, sd_2) if differs else change_sd((least_1, least_2), (sd_1, sd_2), remains)
    least = Z90 * sd if differs else max(least_1, least_2)
    return Change(by, abs(by) >= least, least, differs, *chances(by, sd, important))


def not_alike(result: Result, before: Result) -> tuple[Difference, ...]:
    """Return what of two results was not made or filmed alike, or whether one is in doubt: all but the view leaves a
    change without a verdict."""
    found = []
    if any(r.outcome == "FAIL" or DOUBTS.intersection(r.worst) for r in (result, before)):
        found.append(Difference("checks"))
    if result.chain != before.chain:
        found.append(Difference("methods"))
    if result.corrected != before.corrected:
        found.append(Difference("corrected"))
    if result.filming is not None and before.filming is not None:
        found += differences(result.filming, before.filming)
    return tuple(found)


def usual_chain(results: Mapping[int, Sequence[Result]]) -> tuple[str, ...] | None:
    """Return `Result.chain` of most of the results, the first of several; None without any."""
    counts = Counter(r.chain for found in results.values() for r in found)
    return max(counts, key=lambda chain: counts[chain], default=None)


def result_of(visit: Visit) -> Result | None:
    """Return the result of a visit of files, without its filming; None if it has no measures."""
    measures = visit.judged
    if measures is None:
        return None
    index, outcome = measures.gdi, measures.outcome
    events = measures.trials[0].events.method if measures.trials else ""
    return Result(
        kind=visit.kind,
        methods=(visit.methods.get("Fit", ""), events, index.model, index.norm),
        status=measures.status,
        reason=measures.reason or index.reason,
        index=index.mean,
        sd=index.sd,
        minimal_change=index.minimal_change,
        outcome=outcome,
        worst=tuple(c.check for c in measures.checks if c.outcome == outcome != PASS),
        corrected=any(c.check == "events_by_hand" for c in measures.checks),
        detection=(visit.methods.get("Tracking", ""), visit.methods.get("Keypoints", "")),
    )


def earlier_visit(path: Path, out: Path, subject: str = "-", height_m: float | None = None) -> Visit:
    """Return the earlier visit of a person, to compare a visit with that is written to `out`.

    `path`: the folder of its results, or the session.json in it. `subject`, `height_m`: of the person now, "-" and None
    if they are not stated. Raises `PblError` FILE_MISSING, FILE_FORMAT if it is not such a folder, USAGE if it is `out`
    or another person's.
    """
    from pbl_pipeline.visit import SESSION, load_visit

    folder = path.parent if path.name == SESSION else path
    if path.exists() and not folder.is_dir():
        raise _not_earlier("FILE_FORMAT", f"the file {path.name}", path)
    if folder.resolve() == out.resolve():
        raise _not_earlier("USAGE", "the folder that the results are written to", path)
    visit = load_visit(folder)
    if visit.measures is None:
        raise _not_earlier("FILE_FORMAT", "; ".join(visit.lacks), path)
    if "-" not in (subject, visit.subject):
        if subject != visit.subject:
            raise _not_earlier("USAGE", f"visits of {visit.subject} and of {subject}", path)
        return visit
    if height_m and visit.height_m and abs(height_m - visit.height_m) > OTHER_HEIGHT_M:
        found = f"a person of {visit.height_m:.2f} m, now one of {height_m:.2f} m"
        raise _not_earlier("USAGE", found, path, "if it is one person who has grown, state --subject in both runs")
    return visit


def visit_changes(visit: Visit, before: Visit) -> list[dict[str, Any]]:
    """Return the rows (`Change.row`) of index and measures that both visits of files have. Raises `PblError` USAGE if
    other methods made them."""
    now, then = (result_of(v) for v in (visit, before))
    assert now is not None
    assert then is not None
    if now.chain != then.chain:
        pairs = (f"{b or 'unknown'} (earlier), {n}" for n, b in zip(now.chain, then.chain, strict=True) if n != b)
        again = "compute the recordings of the earlier visit again by these methods"
        raise _not_earlier("USAGE", f"other methods: {'; '.join(pairs)}", before.title, again)
    now, then = (dataclasses.replace(r, filming=v.filming) for r, v in ((now, visit), (then, before)))
    measures, old = (v.measures.spatiotemporal.measures for v in (visit, before) if v.measures is not None)
    changes = {n: change_of(n, now, then, measures.get(n), old.get(n)) for n in (INDEX, *measures)}
    return [c.row(name) for name, c in changes.items() if c is not None]


def _not_earlier(code: str, found: str, key: object, next_step: str = "name the folder of an earlier run") -> PblError:
    expected = "the results of an earlier visit of the same person by the same methods, in a folder of `pbl run`"
    return PblError(code, found=found, expected=expected, next_step=next_step, key=key or None)
