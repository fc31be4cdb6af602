"""Gait Deviation Index of three angles."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.paramset import Paramset
from pbl_pipeline.qc import EMPTY, PASS, WARN, Check

from ._cycles import GaitCycle
from .events import LEFT, RIGHT
from .normative import DEFAULT_NORM, NormativeSet, load_norm


@dataclasses.dataclass(frozen=True)
class GdiParams:
    """Parameters of the index.

    norm
        Name of the normative set.
    min_cycles_per_side
        Fewer used cycles of either side give no index.
    advised_cycles
        Fewer in all give a warning: single cycles vary by several points.
    min_explained
        A smaller share of a cycle's deviation inside the normative components gives a warning.
    """

    norm: str = DEFAULT_NORM
    min_cycles_per_side: int = 1
    advised_cycles: int = 10
    min_explained: float = 0.5


GDI_MODEL = "pbl-2025-three-angles"
GDI_PARAMSETS: dict[str, Paramset] = {GDI_MODEL: Paramset.of("gdi", GDI_MODEL, 1, GdiParams())}


@dataclasses.dataclass(frozen=True)
class GdiCycle:
    """The index of one cycle. `z` is the standardised log distance; `explained` the share (0..1) of the squared
    deviation from the normative mean that lies in the normative components: what is outside does not count."""

    trial: str
    number: int
    side: str
    gdi: float
    z: float
    explained: float


@dataclasses.dataclass(frozen=True)
class Gdi:
    """The index of one trial or session: means over used cycles, None where too few (`reason`).

    `mean` is over all cycles of both sides, `n` of them. Status PASS or EMPTY.
    """

    status: str
    reason: str
    left: float | None
    right: float | None
    mean: float | None
    n: int
    n_left: int
    n_right: int
    norm: str
    model: str
    params_hash: str
    cycles: tuple[GdiCycle, ...]
    qc: tuple[Check, ...]

    def to_dict(self) -> dict:
        """`gdi` of metrics.json."""
        left, right, mean = (None if v is None else round(v, 3) for v in (self.left, self.right, self.mean))
        return {"left": left, "right": right, "mean": mean, "n": self.n, "norm": self.norm}


def score_gdi(
    cycles: Sequence[GaitCycle], norm: NormativeSet | str | None = None, params: GdiParams | None = None
) -> Gdi:
    """Gait Deviation Index of three angles over the used cycles of one or several trials.

    Each cycle's hip flexion, hip adduction and knee flexion at 0, 2, ..., 98 % make a vector of 150; the Euclidean
    distance of its normative component scores to the normative mean, logarithm, standardised by the normative
    cycles, GDI = 100 - 10 z (Schwartz & Rozumalski 2008, Gait & Posture 28:351-357). 100 is normative, each 10 points
    one normative standard deviation. It is not the original index of nine angles and must not be compared with it.

    The components come from the normative vectors alone (the paper pools them with the patients'), so deviations in
    directions in which healthy people do not vary are not counted; `GdiCycle.explained` says how much was.

    Parameters
    ----------
    cycles
        Only cycles with `used` and with curves count.
    norm
        A set or its name; None for that of `params`.

    Raises
    ------
    PblError
        NORM_UNKNOWN, NORM_INVALID.
    """
    params = params or GdiParams()
    if norm is None:
        norm = params.norm
    basis = load_norm(norm) if isinstance(norm, str) else norm
    paramset = Paramset.of("gdi", GDI_MODEL, 1, dataclasses.replace(params, norm=basis.name))
    usable = [c for c in cycles if c.used and all(v in c.curves for v in basis.variables)]
    scored = tuple(_score(c, basis) for c in usable)
    by_side = {side: [c.gdi for c in scored if c.side == side] for side in (LEFT, RIGHT)}
    left, right = (float(np.mean(by_side[s])) if by_side[s] else None for s in (LEFT, RIGHT))
    n_left, n_right = len(by_side[LEFT]), len(by_side[RIGHT])
    enough = min(n_left, n_right) >= params.min_cycles_per_side
    reason = "" if enough else _too_few(cycles, n_left, n_right, params)
    return Gdi(
        status=PASS if enough else EMPTY,
        reason=reason,
        left=left if enough else None,
        right=right if enough else None,
        mean=float(np.mean([c.gdi for c in scored])) if enough else None,
        n=len(scored),
        n_left=n_left,
        n_right=n_right,
        norm=basis.name,
        model=GDI_MODEL,
        params_hash=paramset.hash,
        cycles=scored,
        qc=_checks(scored, enough, reason, params),
    )


def gdi_vector(cycle: GaitCycle, norm: NormativeSet) -> np.ndarray:
    """The feature vector of a cycle: the norm's angles one after another, each at the norm's percents."""
    phase = np.linspace(0.0, 100.0, len(next(iter(cycle.curves.values()))))
    return np.concatenate([np.interp(norm.percent, phase, cycle.curves[v]) for v in norm.variables])


def _score(cycle: GaitCycle, norm: NormativeSet) -> GdiCycle:
    vector = gdi_vector(cycle, norm)
    deviation = vector - norm.mean_deg
    inside = norm.components @ deviation
    total = float(deviation @ deviation)
    z = float((norm.log_distance(vector)[0] - norm.ln_mean) / norm.ln_sd)
    explained = float(inside @ inside) / total if total > 0 else 1.0
    return GdiCycle(cycle.trial, cycle.number, cycle.side, float(norm.index(vector)[0]), z, explained)


def _too_few(cycles: Sequence[GaitCycle], n_left: int, n_right: int, params: GdiParams) -> str:
    if failed := next((c.excluded for c in cycles if c.fit_failed), ""):
        return failed
    text = (
        f"{n_left} left and {n_right} right cycles with curves are left of {len(cycles)}, "
        f"the index needs {params.min_cycles_per_side} of each side"
    )
    missing = sorted({c.curves_missing for c in cycles if c.used and c.curves_missing})
    return text + (f" ({'; '.join(missing)})" if missing else "")


def _checks(scored: Sequence[GdiCycle], enough: bool, reason: str, params: GdiParams) -> tuple[Check, ...]:
    if not enough:
        return (Check("gdi_cycles", EMPTY, float(len(scored)), float(2 * params.min_cycles_per_side), reason),)
    few = len(scored) < params.advised_cycles
    share = float(np.mean([c.explained for c in scored]))
    return (
        Check(
            "norm_convention",
            WARN,
            None,
            None,
            "the normative angles come from a laboratory marker model, ours from the fitted OpenSim body, whose pelvis "
            "and hip axes differ by constant offsets (hip flexion most): compare sessions with each other, do not read "
            "a single value against 100",
        ),
        Check(
            "gdi_cycles",
            WARN if few else PASS,
            float(len(scored)),
            float(params.advised_cycles),
            "few cycles: record more passes and give them as trials of one session" if few else "",
        ),
        Check(
            "gdi_explained",
            PASS if share >= params.min_explained else WARN,
            round(share, 3),
            params.min_explained,
            ""
            if share >= params.min_explained
            else "most of the deviation is of a kind that healthy walking does not show: the index understates it",
        ),
    )
