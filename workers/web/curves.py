"""Joint angles and forces over the gait cycle on the page of a visit: curves of both sides, peaks and ranges."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from markupsafe import Markup

from pbl_pipeline import charts
from pbl_pipeline.gait import (
    AdultRanges,
    NormalBands,
    adult_ranges,
    far_leg_of,
    leg_length_m,
    load_norm,
    norm_names,
    normal_bands,
)
from pbl_pipeline.kinetics import GRAVITY
from pbl_pipeline.report.forces import force_charts
from pbl_pipeline.visit import Visit
from pbl_pipeline.words import ANGLES, KINETICS

from . import texts

#: Angles of the first screen: those of the index of three angles, and the ankle.
SHOWN = ("hip_flexion", "hip_adduction", "knee_flexion", "ankle_dorsiflexion")
SIDES = ("left", "right")


@dataclasses.dataclass(frozen=True)
class Curve:
    """One angle: its chart; lowest and highest value (deg) of each side's mean curve and of that of the children."""

    name: str
    title: str
    positive: str
    picture: Markup
    ranges: dict[str, tuple[float, float]]
    norm: tuple[float, float] | None


@dataclasses.dataclass(frozen=True)
class Curves:
    """The angles of a visit. far: the leg that was behind the other, empty where both were seen alike. adults: ranges
    of adults beside the children's bands."""

    angles: tuple[Curve, ...]
    bands: NormalBands
    far: str
    adults: AdultRanges


def curves_of(visit: Visit, language: str) -> Curves | None:
    """Return the curves of the cycles that count, None without any."""
    if visit.measures is None:
        return None
    cycles = [c for c in visit.measures.cycles if c.used and c.curves]
    if not cycles:
        return None
    leg_m = None if visit.solution is None else leg_length_m(visit.solution.scale)
    bands, far = normal_bands(visit.measures.spatiotemporal, leg_m), far_leg_of(cycles)
    drawn = []
    for name in SHOWN:
        by_side = {s: [c.curves[name] for c in cycles if c.side == s and name in c.curves] for s in SIDES}
        if not any(by_side.values()):
            continue
        band = (bands.percent, *bands.curves[name]) if name in bands.curves else None
        percent = np.linspace(0.0, 100.0, len(next(c for curves in by_side.values() for c in curves)))
        off = {s: [100 * (c.foot_up_s - c.start_s) / c.stride_time_s for c in cycles if c.side == s] for s in SIDES}
        foot_off = {s: float(np.mean(v)) for s, v in off.items() if v}
        title, positive = ANGLES[name]
        label = texts.text(language, "curves.chart", name=texts.library_words(language, title))
        picture = charts.cycle_chart(label, percent, by_side, foot_off, band, far)
        means = {s: charts.mean_curve(curves) for s, curves in by_side.items() if curves}
        ranges = {s: (float(m.min()), float(m.max())) for s, m in means.items() if np.isfinite(m).all()}
        normal = None if band is None else (float(band[1].min()), float(band[1].max()))
        drawn.append(Curve(name, title, positive, picture, ranges, normal))
    return Curves(tuple(drawn), bands, far, adult_ranges())


def forces_of(visit: Visit, language: str) -> dict[str, Any] | None:
    """Return the forces of a visit (without its trials) with their charts and the body weight (N); None without any."""
    if visit.kinetics is None:
        return None

    def label(title: str, unit: str, n: int) -> str:
        return texts.text(language, "forces.chart", name=texts.library_words(language, title), unit=unit, n=n)

    found = dataclasses.replace(visit.kinetics, trials=())
    weight_n = None if found.mass_kg is None else GRAVITY * found.mass_kg
    drawn = [{**c, "svg": texts.in_chart(language, c["svg"])} for c in force_charts(visit.kinetics, label)]
    return {"found": found, "words": KINETICS, "weight_n": weight_n, "charts": drawn}


def norm_people(norm: str) -> int | None:
    """Return how many typically developing children a set of the index that ships is of; None for other sets."""
    return load_norm(norm).n if norm in norm_names() else None
