"""Bands of normal gait at the speed of a person, and mean curves of a session beside them."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_interp_spline

from pbl_pipeline.results.cycles import BODY_ANGLES, GaitCycle
from pbl_pipeline.results.events import SIDES
from pbl_pipeline.shipped import shipped_text

from ._cycles import REPORT_PERCENT
from .cycle_measures import Measure
from .normative import GRAVITY, PLUG_IN_GAIT, gait_norm, offset_deg

if TYPE_CHECKING:
    import pandas as pd

#: Height (m, unscaled) of the calcaneus' origin above the floor with the foot flat.
_SOLE_M = 0.015


@dataclasses.dataclass(frozen=True, eq=False)
class NormalBands:
    """Normal curves at one speed.

    `percent` (P,) of the cycle; `curves` maps `ANGLE_NAMES` to mean and sd (P,) in degrees, the sd between people.
    `speed` is dimensionless, v / sqrt(g L) with the leg length L; `matched` is what it was found by ("speed",
    "cadence", or "" for the speed that people choose, if neither is known). `clipped`: the person is slower or faster
    than the slowest or fastest of the five groups, whose curves these then are.
    """

    percent: np.ndarray
    curves: dict[str, tuple[np.ndarray, np.ndarray]]
    speed: float
    matched: str
    clipped: bool
    source: str
    licence: str

    def words(self) -> str:
        """Matching of the bands, as the end of a sentence."""
        if not self.matched:
            return "at the speed that they choose"
        limit = (
            "the slowest or fastest group's: the person is slower or faster" if self.clipped else f"{self.speed:.2f}"
        )
        return f"at the same speed for the length of the leg (v / sqrt(g L) = {limit}), matched by {self.matched}"


@dataclasses.dataclass(frozen=True)
class AdultRanges:
    """Ranges of joint angles over the mean stride of able-bodied adults at the speed that they choose.

    `range_deg`: angle -> mean and sd between people (deg); `age`: youngest and oldest of the `n` people.
    """

    n: int
    age: tuple[int, int]
    range_deg: Mapping[str, tuple[float, float]]
    source: str
    licence: str


@functools.cache
def adult_ranges() -> AdultRanges:
    """Return the ranges that ship with the package (`research/adult_ranges.py` writes them)."""
    raw = json.loads(shipped_text("gait/normative/curves/adult_ranges.json"))
    ranges = {angle: (float(mean), float(sd)) for angle, (mean, sd) in raw["range_deg"].items()}
    return AdultRanges(raw["n"], tuple(raw["age"]), ranges, raw["source"], raw["licence"])


def leg_length_m(scale: np.ndarray) -> float:
    """From the hip to the floor of the body standing upright, mean of both legs (m), by its scale parameters (8,)."""
    from pbl_pipeline.body import load_body  # JAX loads only where a fit is read

    body, scale = load_body(), np.asarray(scale, float)
    total = 0.0
    for side in "lr":
        for name in ("tibia", "talus", "calcn"):
            at = body.body_names.index(f"{name}_{side}")
            # The offset of a body is in the frame of its parent (y up) and grows with the parent.
            total -= body.mj_model.body_pos[at + 1][1] * scale[body.scale_index[body.parent_index[at]]]
        total += _SOLE_M * scale[body.scale_index[body.body_names.index(f"calcn_{side}")]]
    return float(total / 2)


def normal_bands(
    measures: Mapping[str, Measure | None] | None = None, leg_m: float | None = None, angle_model: str = BODY_ANGLES
) -> NormalBands:
    """Mean and sd of healthy people's angles at the speed of the measures.

    Schwartz et al. 2008, J Biomech 41:1639-1650. By speed if it is known, else by cadence: both are made dimensionless
    by the leg length, because people of other sizes walk alike at the same v / sqrt(g L) (Hof 1996, Gait & Posture
    4:222-223). By cadence, a person with short steps is compared with faster walkers than by speed. The angles are
    mapped to `angle_model` (the published ones are Plug-in Gait's).
    """
    norm = gait_norm()
    wanted, matched = float(norm.speed[norm.groups.index("free")]), ""
    if measures is not None and leg_m is not None:
        speed, cadence = measures.get("speed_m_per_s"), measures.get("cadence_steps_per_min")
        if speed is not None:
            wanted, matched = speed.mean / float(np.sqrt(GRAVITY * leg_m)), "speed"
        elif cadence is not None:
            steps = cadence.mean / 60.0 * float(np.sqrt(leg_m / GRAVITY))
            # Outside the groups the line goes on, so that the clipping below is seen.
            wanted, matched = float(make_interp_spline(norm.cadence, norm.speed, k=1)(steps)), "cadence"
    low, high = float(norm.speed[0]), float(norm.speed[-1])
    at = float(np.clip(wanted, low, high))
    phase = 2 * np.pi * REPORT_PERCENT / 100.0
    curves = {
        angle: (
            norm.curve(angle, phase, at) + offset_deg(angle, PLUG_IN_GAIT, angle_model),
            norm.curve(angle, phase, at, sd=True),
        )
        for angle in norm.angles
    }
    return NormalBands(REPORT_PERCENT, curves, at, matched, not low <= wanted <= high, norm.source, norm.licence)


#: Columns of `curve_frame`; angles in degrees, `percent` of the cycle.
CURVE_FRAME_COLUMNS = ("side", "angle", "percent", "mean_deg", "sd_deg", "n", "normal_mean_deg", "normal_sd_deg")


def curve_frame(cycles: Sequence[GaitCycle], bands: NormalBands) -> pd.DataFrame:
    """One row per side, angle and percent: mean and sd (n - 1, NaN for one cycle) of the used cycles, and the band."""
    import pandas as pd

    parts = []
    for side in SIDES:
        own = [c for c in cycles if c.side == side and c.used and c.curves]
        for angle in dict.fromkeys(a for c in own for a in c.curves):
            curves = np.array([c.curves[angle] for c in own if angle in c.curves])
            percent = np.linspace(0.0, 100.0, curves.shape[1])
            normal = bands.curves.get(angle, (np.full(len(bands.percent), np.nan),) * 2)
            parts.append(
                pd.DataFrame(
                    {
                        "side": side,
                        "angle": angle,
                        "percent": percent,
                        "mean_deg": curves.mean(axis=0),
                        "sd_deg": curves.std(axis=0, ddof=1) if len(curves) > 1 else np.nan,
                        "n": len(curves),
                        "normal_mean_deg": np.interp(percent, bands.percent, normal[0]),
                        "normal_sd_deg": np.interp(percent, bands.percent, normal[1]),
                    }
                )
            )
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_FRAME_COLUMNS))
