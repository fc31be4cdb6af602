"""A normative set from a laboratory's own gait cycles."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.qc import Check, warn_if
from pbl_pipeline.results.cycles import GaitCycle

from ._cycles import REPORT_PERCENT
from ._gdi import MODEL_ANGLES
from .normative import MIN_VECTORS, NINE_ANGLES, THREE_ANGLES, NormativeSet, fit_norm
from .types import feature_vector

#: Fewer people, or a larger fraction of the cycles from one person, give a warning.
ADVISED_PEOPLE, MAX_SHARE = 20, 0.2
_invalid = functools.partial(
    PblError, "NORM_INVALID", next_step="add cycles or choose others (docs/measures.md, section Normative sets)"
)


def norm_from_cycles(
    cycles: Sequence[GaitCycle],
    people: Sequence[str],
    *,
    name: str,
    version: int,
    source: str,
    licence: str = "",
    variables: Sequence[str] = THREE_ANGLES,
    variance: float = 0.95,
    n_components: int | None = None,
    pooled: Sequence[GaitCycle] = (),
) -> tuple[NormativeSet, tuple[Check, ...]]:
    """The set that the used cycles of healthy people make, and checks of it.

    Raises `PblError` NORM_INVALID: fewer than 30 usable cycles or too few for the components, angles of several
    definitions, or other angles than an index has. ANGLE_UNITS.

    Parameters
    ----------
    cycles, people
        Cycles, and the code of the person of each. Those not used or without curves do not count.
    variables
        Angles of the index: three (curves at 0, 2, ..., 98 %, as the paper's) or nine (0, 2, ..., 100 %).
    variance, n_components, pooled
        As in `fit_norm`; `pooled` are cycles of patients that the components are fitted to as well.
    """
    variables = tuple(variables)
    if variables not in MODEL_ANGLES.values():
        raise _invalid(f"angles {', '.join(variables)}", "those of an index: three or nine (`MODEL_ANGLES`)")
    known = [(c, p) for c, p in zip(cycles, people, strict=True) if _usable(c, variables)]
    others = [c for c in pooled if _usable(c, variables)]
    models = {c.angle_model for c, _ in known} | {c.angle_model for c in others}
    if len(models) > 1:
        raise _invalid(f"cycles whose angles are defined in several ways ({', '.join(sorted(models))})", "one way")
    if len(known) < MIN_VECTORS:
        raise _invalid(f"{len(known)} usable cycles of {len(cycles)}", f"at least {MIN_VECTORS}")
    at = REPORT_PERCENT if variables == NINE_ANGLES else REPORT_PERCENT[:-1]
    counts = Counter(p for _, p in known)
    model = models.pop()
    norm = fit_norm(
        np.array([feature_vector(c.curves, variables, at) for c, _ in known]),
        name=name,
        version=version,
        variables=variables,
        percent=at,
        source=source,
        licence=licence,
        convention=f"{len(known)} gait cycles of {len(counts)} people, angles of {model}, degrees"
        + (f"; components of these and {len(others)} cycles of patients" if others else ""),
        curves=_bands([c for c, _ in known], REPORT_PERCENT),
        variance=variance,
        n_components=n_components,
        pooled=np.array([feature_vector(c.curves, variables, at) for c in others]) if others else None,
        angle_model=model,
    )
    n, most = len(counts), max(counts.values()) / len(known)
    few = "few people: the set says how these walk, not how healthy people do"
    leans = "one person has a large part of the cycles: the set leans towards that gait"
    return norm, (
        warn_if(n < ADVISED_PEOPLE, "norm_people", float(n), float(ADVISED_PEOPLE), few),
        warn_if(most > MAX_SHARE, "norm_share_of_one_person", round(most, 3), MAX_SHARE, leans),
    )


def _usable(cycle: GaitCycle, variables: Sequence[str]) -> bool:
    return cycle.used and all(v in cycle.curves and np.isfinite(cycle.curves[v]).all() for v in variables)


def _bands(cycles: Sequence[GaitCycle], percent: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Mean and standard deviation (n - 1) of each angle that all cycles have."""
    names = [n for n in cycles[0].curves if all(n in c.curves for c in cycles)]
    bands = {}
    for name in names:
        curves = np.array([feature_vector(c.curves, (name,), percent) for c in cycles])
        bands[name] = {"percent": percent, "mean_deg": curves.mean(axis=0), "sd_deg": curves.std(axis=0, ddof=1)}
    return bands
