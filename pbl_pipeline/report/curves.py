"""Charts of the joint angles over the gait cycle, for the report and the review page."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from markupsafe import Markup

from pbl_pipeline import charts
from pbl_pipeline.gait import GaitCycle, NormalBands, far_leg_of
from pbl_pipeline.gait.events import SIDES

#: Side -> lowest and highest value (deg) of its mean curve.
Ranges = dict[str, tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class CycleCurve:
    """One angle with its chart."""

    name: str
    title: str
    positive: str  # the positive direction
    picture: Markup
    ranges: Ranges
    norm: tuple[float, float] | None  # lowest and highest value (deg) of the norm's mean curve


def cycle_curves(
    cycles: Sequence[GaitCycle],
    bands: NormalBands,
    names: Mapping[str, tuple[str, str]],
    label: Callable[[str, Ranges], str],
) -> list[CycleCurve]:
    """Draw the angles of `names` that the used cycles have.

    Parameters
    ----------
    names
        Name of the angle -> its title and positive direction, such as `words.ANGLES`.
    label
        Describes a chart in words, by the angle's title and its ranges.
    """
    usable, faint = [c for c in cycles if c.used and c.curves], far_leg_of(cycles)
    off = {s: [100 * (c.foot_up_s - c.start_s) / c.stride_time_s for c in usable if c.side == s] for s in SIDES}
    foot_off = {s: float(np.mean(values)) for s, values in off.items() if values}
    drawn = []
    for name, (title, positive) in names.items():
        by_side = {s: [c.curves[name] for c in usable if c.side == s and name in c.curves] for s in SIDES}
        if not any(by_side.values()):
            continue
        band = (bands.percent, *bands.curves[name]) if name in bands.curves else None
        percent = np.linspace(0.0, 100.0, len(next(c for curves in by_side.values() for c in curves)))
        means = {s: np.mean(curves, axis=0, dtype=float) for s, curves in by_side.items() if curves}
        ranges = {s: (float(m.min()), float(m.max())) for s, m in means.items() if np.isfinite(m).all()}
        picture = charts.cycle_chart(label(title, ranges), percent, by_side, foot_off, band, faint)
        norm = None if band is None else (float(band[1].min()), float(band[1].max()))
        drawn.append(CycleCurve(name, title, positive, picture, ranges, norm))
    return drawn
