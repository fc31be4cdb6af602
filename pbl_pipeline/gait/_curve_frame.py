"""Mean curves of a session beside the normal bands, as a table for analysts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ._bands import NormalBands
from .events import SIDES
from .types import GaitCycle

if TYPE_CHECKING:
    import pandas as pd

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
