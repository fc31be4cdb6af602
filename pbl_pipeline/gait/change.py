"""Probability that a change between two visits is real."""

from __future__ import annotations

import math
from typing import NamedTuple

from .cycle_measures import Z90

#: Change of the index that matters: half a standard deviation of healthy people, of which 10 points are one. A
#: convention (Norman, Sloan & Wyrwich 2003, Medical Care 41:582-592), not measured with patients.
IMPORTANT_CHANGE = 5.0
#: Fraction of the variance of what two visits' errors have in common that does not cancel when the person walks
#: otherwise: the one of 0, 0.1 ... with the least logarithmic loss of the two probabilities over pairs of walks of
#: tuning persons (`research.corpus.measurement`).
REMAINS = 0.3


class Chances(NamedTuple):
    """Probabilities that the true change goes the way of the found one, and that it goes that way by at least the
    minimal important change; None where there is none."""

    real: float
    important: float | None


def change_sd(minimal_changes: tuple[float, float], sds: tuple[float, float]) -> float:
    """Return the standard deviation of a true change about the found one, between two visits filmed alike.

    Parameters
    ----------
    minimal_changes
        Minimal detectable change (90 %) of each visit, which holds what is anew in it.
    sds
        Standard deviation of the whole error of each.
    """
    anew = sum(c**2 for c in minimal_changes) / (2.0 * Z90**2)
    whole = sum(s**2 for s in sds)
    return math.sqrt(anew + REMAINS * max(whole - anew, 0.0))


def chances(by: float, sd: float, important: float | None = None) -> Chances:
    """Return the probabilities of a true change, normal about the found one `by` with the standard deviation `sd`."""
    beyond = [0.5 * math.erfc((limit - abs(by)) / (math.sqrt(2.0) * sd)) for limit in (0.0, important or 0.0)]
    return Chances(beyond[0], None if important is None else beyond[1])
