"""Statistics of a study, from repeatability to sample size (docs/statistics.md).

Pure functions on arrays and columns of data frames (matched by position, not by index). What comes as `pre, post` is
compared as post - pre, what comes as `a, b` as a - b. Chance is drawn from `seed`. Values that cannot support a
statistic raise `PblError` STATS_INPUT; no function leaves a value out by itself.
"""

from ._agreement import LIMIT_SD, BlandAltman, bland_altman
from ._change import MIN_PERSONS, Srm, Wilcoxon, cohens_dz, effect_size, srm, wilcoxon
from ._correlation import CORRELATIONS, Correlation, correlation
from ._curves import CURVE_METHODS, CurveTest, Phase, curve_test
from ._groups import MannWhitney, Test, compare_groups, hedges_g, mann_whitney, shapiro_wilk
from ._icc import ICC_INTERVALS, ICC_KINDS, Icc, icc, minimal_detectable_change, ratings_table
from ._many import CORRECTIONS, adjust
from ._paper import NIQR_FACTOR, median_of_medians, niqr
from ._sample_size import DESIGNS, SampleSize, sample_size
from .types import Estimate
