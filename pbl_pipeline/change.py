"""Changes between two results of a person: how large, how probable, and why one cannot be judged."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence

from pbl_pipeline.filming import VIEW, Difference, Filming, differences
from pbl_pipeline.qc import CADENCE

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

    @property
    def chain(self) -> tuple[str, ...]:
        """Kind of recordings and methods."""
        return self.kind, *self.methods


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


def change_since(result: Result, before: Result) -> Change | None:
    """The change of the index from one result to another; None if one of them has no index.

    Filmed alike, a change is more than chance from the larger of the two minimal changes on. Filmed from other sides,
    the errors of the two views do not cancel: from Z90 sqrt(sd1^2 + sd2^2) on, of the sds of their whole errors.
    """
    from pbl_pipeline.gait import IMPORTANT_CHANGE

    if result.index is None or before.index is None:
        return None
    errors = [(r.sd, r.minimal_change) for r in (result, before)]
    return judged(result.index - before.index, errors, not_alike(result, before), IMPORTANT_CHANGE)


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
