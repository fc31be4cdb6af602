"""Statistics of a study, from repeatability to responsiveness (docs/statistics.md).

Pure functions on arrays and columns of data frames (matched by position, not by index). Arguments `pre, post` are
compared as post - pre, arguments `a, b` as a - b. Random numbers are drawn from `seed`. Values that cannot support a
statistic raise `PblError` STATS_INPUT; no function drops values.
"""

from ._change import BlandAltman, Srm, Wilcoxon, bland_altman, cohens_dz, effect_size, niqr, srm, wilcoxon
from ._curves import CURVE_METHODS, CurveTest, Phase, curve_test
from ._groups import (
    Correlation,
    MannWhitney,
    Test,
    adjust,
    compare_groups,
    correlation,
    hedges_g,
    mann_whitney,
    shapiro_wilk,
)
from ._icc import ICC_INTERVALS, ICC_KINDS, Icc, icc, minimal_detectable_change, ratings_table
from .types import Estimate
