"""Statistics of a study, from repeatability to responsiveness (docs/statistics.md).

Pure functions on arrays and columns of data frames (matched by position, not by index). What comes as `pre, post` is
compared as post - pre, what comes as `a, b` as a - b. Chance is drawn from `seed`. Values that cannot support a
statistic raise `PblError` STATS_INPUT; no function leaves a value out by itself.
"""

from ._change import (
    LIMIT_SD,
    MIN_PERSONS,
    NIQR_FACTOR,
    BlandAltman,
    Srm,
    Wilcoxon,
    bland_altman,
    cohens_dz,
    effect_size,
    niqr,
    srm,
    wilcoxon,
)
from ._curves import CURVE_METHODS, CurveTest, Phase, curve_test
from ._groups import (
    CORRECTIONS,
    CORRELATIONS,
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
