"""Section of the report on forces and joint moments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pbl_pipeline import charts
from pbl_pipeline.gait.events import SIDES
from pbl_pipeline.kinetics import GRAVITY, KineticMeasure, Kinetics
from pbl_pipeline.qc import PASS
from pbl_pipeline.report.words import plural, sentence
from pbl_pipeline.results.measures import Z90
from pbl_pipeline.visit import Visit
from pbl_pipeline.words import KINETICS, KINETICS_CURVES, number

#: Smallest range of a chart by unit.
_LEAST = {"BW": 0.2, "Nm/kg": 0.5, "W/kg": 1.0}
#: The section is folded if half the 90 % interval of the loading peak is larger (body weights).
_UNSURE_BW = 0.10
_NOTE = (
    "From the motion alone, by the laws of Newton and Euler: no force was measured. Per body weight (BW) and kilogram. "
    "Joint moments are internal, those of the person's own muscles and ligaments; at the knee flexion is positive, so "
    "extensors show as negative. While both feet stand, and for where under the sole the force acts, the usual course "
    "of walking is taken. In brackets the 90 % interval. Thin lines are single cycles, thick ones their mean."
)


def forces_section(visit: Visit) -> dict | None:
    """Return the section for the template; None if forces were not computed."""
    kinetics = visit.kinetics
    if kinetics is None:
        return None
    if not kinetics.measures:
        return {"reason": sentence(f"No forces: {kinetics.reason}"), "open": False}
    peak = kinetics.measures.get("vertical_peak_loading_bw")
    sure = peak is not None and peak.sd is not None and Z90 * peak.sd <= _UNSURE_BW
    weight = kinetics.mass_kg
    in_newtons = "" if weight is None else f" 1 BW is {number(GRAVITY * weight, 0)} N."
    residual = kinetics.residual_bw
    left_over = "" if residual is None else f" Carried by no foot: {number(100 * residual, 1)} % of the weight."
    doubts = [c for c in kinetics.qc if c.outcome != PASS]
    return {
        "reason": "",
        "open": sure and not doubts,
        "rows": [_row(name, kinetics.measures.get(name), kinetics.reasons.get(name, ""), weight) for name in KINETICS],
        "charts": force_charts(kinetics, _label),
        "note": " ".join([_NOTE + in_newtons + left_over, *(sentence(c.advice) for c in doubts)]),
    }


def _row(name: str, measure: KineticMeasure | None, reason: str, mass_kg: float | None) -> dict:
    title, unit, decimals = KINETICS[name]
    if measure is None:
        return {"name": title, "known": False, "reason": reason}
    low_high = measure.interval
    both = number(measure.mean, decimals)
    if low_high is not None:
        both += f" ({number(low_high[0], decimals)} to {number(low_high[1], decimals)})"
    asymmetry = number(measure.asymmetry_percent, 0)
    if measure.asymmetry_sd is not None:
        asymmetry += f" \N{PLUS-MINUS SIGN} {number(Z90 * measure.asymmetry_sd, 0)}"
    newtons = "" if mass_kg is None or unit != "BW" else f"{number(GRAVITY * mass_kg * measure.mean, 0)} N"
    return {
        "name": title,
        "known": True,
        "left": number(measure.left, decimals),
        "right": number(measure.right, decimals),
        "mean": both,
        "asymmetry": asymmetry,
        "n": measure.n,
        "unit": unit if not newtons else f"{unit} (mean {newtons})",
    }


def _label(title: str, unit: str, n: int) -> str:
    return f"{title} in {unit} over the gait cycle in percent, of {plural(n, 'cycle')}."


def force_charts(kinetics: Kinetics, label: Callable[[str, str, int], str]) -> list[dict]:
    """Draw a chart for each curve that cycles have; of hip and knee, and of powers, only if a measure of them is known.

    `label` describes a chart for screen readers, by the curve's title, its unit and the number of cycles.
    """
    hidden = [
        text
        for measure, text in (
            ("knee_extension_moment_peak_nm_per_kg", "hip_"),
            ("knee_extension_moment_peak_nm_per_kg", "knee_"),
            ("ankle_push_off_power_w_per_kg", "_power_"),
        )
        if measure in kinetics.reasons
    ]
    cycles = [c for t in kinetics.trials for c in t.cycles if c.used and c.curves]
    drawn = []
    for name, (title, unit) in KINETICS_CURVES.items():
        by_side = {s: [c.curves[name] for c in cycles if c.side == s and name in c.curves] for s in SIDES}
        known = [curve for curves in by_side.values() for curve in curves]
        if not known or any(text in name for text in hidden):
            continue
        percent = np.linspace(0.0, 100.0, len(known[0]))
        chart = charts.cycle_chart(
            label(title, unit, len(known)), percent, by_side, {}, None, unit="", least=_LEAST[unit]
        )
        drawn.append({"name": title, "note": unit, "svg": chart})
    return drawn
