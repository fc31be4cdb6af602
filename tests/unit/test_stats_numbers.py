"""Change, groups, correlation, agreement, many tests, sample size: against published examples and other libraries.

Oracles: pingouin 0.7.0, statsmodels 0.15.0, scipy 1.17.1, whose printed numbers stand here.
"""

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pbl_pipeline.errors import PblError
from pbl_pipeline.stats import (
    adjust,
    bland_altman,
    cohens_dz,
    compare_groups,
    correlation,
    effect_size,
    hedges_g,
    mann_whitney,
    niqr,
    shapiro_wilk,
    srm,
    wilcoxon,
)

#: Student 1908 (Biometrika 6:1-25): additional hours of sleep of ten patients under two drugs.
PRE = np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
POST = np.array([1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4])
#: Bland & Altman 1986: peak expiratory flow (l/min) of 17 persons by two meters, first readings.
WRIGHT = [494, 395, 516, 434, 476, 557, 413, 442, 650, 433, 417, 656, 267, 478, 178, 423, 427]
MINI = [512, 430, 520, 428, 500, 600, 364, 380, 658, 445, 432, 626, 260, 477, 259, 350, 451]
#: Bland & Altman 1995 (BMJ 310:446): intramural pH and PaCO2 of eight subjects.
PH = {
    1: ([6.68, 6.53, 6.43, 6.33], [3.97, 4.12, 4.09, 3.97]),
    2: ([6.85, 7.06, 7.13, 7.17], [5.27, 5.37, 5.41, 5.44]),
    3: (
        [7.4, 7.42, 7.41, 7.37, 7.34, 7.35, 7.28, 7.3, 7.34],
        [5.67, 3.64, 4.32, 4.73, 4.96, 5.04, 5.22, 4.82, 5.07],
    ),
    4: ([7.36, 7.33, 7.29, 7.3, 7.35], [5.67, 5.1, 5.53, 4.75, 5.51]),
    5: ([7.35, 7.3, 7.3, 7.37, 7.27, 7.28, 7.32, 7.32], [4.28, 4.44, 4.32, 3.23, 4.46, 4.72, 4.75, 4.99]),
    6: ([7.38, 7.3, 7.29, 7.33, 7.31, 7.33], [4.78, 4.73, 5.12, 4.93, 5.03, 4.93]),
    7: ([6.86, 6.94, 6.92], [6.85, 6.44, 6.52]),
    8: ([7.19, 7.29, 7.21, 7.25, 7.2, 7.19, 6.77, 6.82], [5.28, 4.56, 4.34, 4.32, 4.41, 3.69, 6.09, 5.58]),
}


def test_srm_and_its_jackknife_as_the_paper_words_it():
    change = POST - PRE
    n = len(change)
    value = change.mean() / change.std(ddof=1)
    without = [np.delete(change, i) for i in range(n)]
    pseudo = np.array([n * value - (n - 1) * w.mean() / w.std(ddof=1) for w in without])
    interval = stats.t.interval(0.95, n - 1, pseudo.mean(), pseudo.std(ddof=1) / np.sqrt(n))
    found = srm(PRE, POST)
    assert found.value == pytest.approx(1.2845575625910546, abs=1e-12)
    assert (found.jackknife, found.low, found.high) == pytest.approx((pseudo.mean(), *interval), abs=1e-9)
    assert found.p == pytest.approx(2 * stats.t.sf(abs(found.t), n - 1), abs=1e-12)
    assert found.t == pytest.approx(pseudo.mean() / (pseudo.std(ddof=1) / np.sqrt(n)), abs=1e-9)
    assert srm(change) == found
    assert srm(POST, PRE).value == pytest.approx(-found.value)
    assert srm(pd.Series(PRE), pd.Series(POST)) == found


def test_cohens_dz_has_the_interval_of_the_noncentral_t():
    found = cohens_dz(PRE, POST)
    assert found.value == srm(PRE, POST).value
    # Cumming and Finch's definition: t is the 97.5th percentile at the lower limit and the 2.5th at the upper one.
    t = found.value * np.sqrt(10)
    assert stats.nct.cdf(t, 9, found.low * np.sqrt(10)) == pytest.approx(0.975, abs=1e-6)
    assert stats.nct.cdf(t, 9, found.high * np.sqrt(10)) == pytest.approx(0.025, abs=1e-6)


def test_wilcoxon_and_the_papers_effect_size():
    found = wilcoxon(PRE, POST, n_resamples=200)
    assert (found.statistic, found.n, found.zeros) == (45.0, 10, 1)
    assert found.p == pytest.approx(0.00390625)  # pingouin and scipy
    assert found.rank_biserial == 1.0
    assert found.effect.value == pytest.approx(2.6679112502793854 / np.sqrt(9), abs=1e-9)  # scipy's z
    assert np.isnan(found.effect.low)  # nobody slept less: no resample can show it
    assert wilcoxon(POST, PRE, n_resamples=200).effect.value == -found.effect.value


def test_effect_size_with_equal_and_absent_changes():
    change = np.array([0, 1, 1, -1, 2, 2, -3, 4, 0, 1.0])
    moved = change[change != 0]
    result: Any = stats.wilcoxon(moved, method="approx", correction=False)
    ranks = stats.rankdata(np.abs(moved))
    found = effect_size(change, n_resamples=500)
    assert abs(found.value) == pytest.approx(abs(result.zstatistic) / np.sqrt(len(moved)), abs=1e-9)
    assert found.value * (ranks * np.sign(moved)).sum() > 0
    assert -1 <= found.low < found.value < found.high <= 1
    assert found == effect_size(change, n_resamples=500)
    assert found != effect_size(change, n_resamples=500, seed=1)
    assert effect_size([1, 2, 3, -1e-9]).value <= 1


def test_groups():
    found = mann_whitney(POST, PRE)
    assert (found.statistic, found.rank_biserial.value) == (74.5, pytest.approx(0.49))
    assert found.p == pytest.approx(0.0693275754, abs=1e-9)
    for limit in (found.rank_biserial.low, found.rank_biserial.high):
        # Newcombe's method 5: the limit's own standard error (Hanley & McNeil) times 1.96 is how far it is away.
        p = (limit + 1) / 2
        variance = p * (1 - p) * (1 + 9 * (1 - p) / (2 - p) + 9 * p / (1 + p)) / 100
        assert abs(limit - 0.49) / 2 == pytest.approx(1.959963985 * np.sqrt(variance), abs=1e-8)
    apart = mann_whitney([5, 6, 7, 8], [1, 2, 3]).rank_biserial
    assert (apart.value, apart.high) == (1, 1)
    assert apart.low < 0.8
    assert shapiro_wilk(PRE).statistic == pytest.approx(0.9258060286, abs=1e-9)
    assert shapiro_wilk(PRE).p == pytest.approx(0.407928795, abs=2e-9)  # scipy 1.17: ...7935, 1.18: ...7964


def test_hedges_g_with_his_exact_correction():
    # Cohen's d of pingouin times Hedges' c(18).
    found = hedges_g(POST, PRE)
    assert found.value == pytest.approx(0.8321810813 * math.gamma(9) / (3 * math.gamma(8.5)), abs=1e-9)
    # pingouin uses the approximation 1 - 3 / (4 n - 9).
    assert found.value == pytest.approx(0.7970185004, abs=1e-4)
    assert found.low < 0 < found.high


def test_the_papers_choice_of_test():
    g = np.random.default_rng(0)
    normal = g.normal(size=40)
    assert compare_groups(normal, normal + 0.5).name == "Student's t"
    by_scipy: Any = stats.ttest_ind(normal, normal + 0.5)
    assert compare_groups(normal, normal + 0.5).p == pytest.approx(by_scipy.pvalue)
    assert compare_groups(normal, np.exp(2 * normal)).name == "Mann-Whitney U"


@pytest.mark.parametrize(
    ("kind", "r", "p", "variance"),
    [  # r and p: pingouin, whose interval of Spearman's lacks the term of Bonett and Wright
        ("pearson", 0.7951702058, 0.0059649958, 1 / 7),
        ("spearman", 0.7818181818, 0.0075470078, (1 + 0.7818181818**2 / 2) / 7),
    ],
)
def test_correlation_over_persons(kind, r, p, variance):
    found = correlation(PRE, POST, kind)
    assert (found.value, found.p) == pytest.approx((r, p), abs=1e-9)
    interval = np.tanh(np.arctanh(r) + 1.959963985 * np.sqrt(variance) * np.array([-1, 1]))
    assert (found.low, found.high) == pytest.approx(interval, abs=1e-8)
    assert (found.n, found.persons, found.df) == (10, 10, 8)
    assert correlation(-PRE, POST, kind).value == pytest.approx(-r)


def test_correlation_within_persons():
    """Bakdash & Marusich 2017 on the data of Bland & Altman: r(38) = -0.507, [-0.71, -0.23]."""
    person = np.concatenate([np.full(len(v[0]), k) for k, v in PH.items()])
    ph, pco2 = (np.concatenate([v[i] for v in PH.values()]) for i in (0, 1))
    found = correlation(ph, pco2, "repeated", person)
    assert (found.value, found.p) == pytest.approx((-0.5067697422, 0.0008471081), abs=1e-9)  # pingouin
    assert (found.low, found.high) == pytest.approx((-0.71, -0.23), abs=0.005)
    assert (found.df, found.n, found.persons) == (38, 47, 8)


def test_perfect_correlation_has_no_width():
    x = np.arange(6.0)
    assert (correlation(x, 3 * x + 1).value, correlation(x, 3 * x + 1).low) == pytest.approx((1, 1))


def test_limits_of_agreement():
    found = bland_altman(WRIGHT, MINI)
    assert (found.bias.value, found.sd, found.n) == (pytest.approx(-2.1, abs=0.05), pytest.approx(38.8, abs=0.05), 17)
    assert (found.bias.low, found.bias.high) == pytest.approx((-22.0, 17.8), abs=0.05)  # as they print it
    # They take 2 sd, which gives their -79.7 and 75.5; we 1.96.
    assert found.bias.value - 2 * found.sd == pytest.approx(-79.7, abs=0.1)
    assert found.upper.value == pytest.approx(found.bias.value + 1.96 * found.sd)
    # Their intervals, with the standard error sqrt(3 / n) sd, are -114.3 to -45.1: the exact ones reach further out.
    assert -130 < found.lower.low < -114
    assert -55 < found.lower.high < -45
    swapped = bland_altman(MINI, WRIGHT)
    assert (swapped.upper.low, swapped.upper.high) == pytest.approx((-found.lower.high, -found.lower.low))


def test_correction_for_many_tests():
    # The 15 p of Benjamini & Hochberg 1995: Holm finds 3, theirs finds 4 at 0.05. Adjusted p: statsmodels, pingouin.
    p = [
        0.0001,
        0.0004,
        0.0019,
        0.0095,
        0.0201,
        0.0278,
        0.0298,
        0.0344,
        0.0459,
        0.324,
        0.4262,
        0.5719,
        0.6528,
        0.759,
        1,
    ]
    holm, bh = adjust(p), adjust(p[::-1], "benjamini-hochberg")[::-1]
    assert ((holm <= 0.05).sum(), (bh <= 0.05).sum()) == (3, 4)
    np.testing.assert_allclose(
        holm[:9], [0.0015, 0.0056, 0.0247, 0.114, 0.2211, 0.278, 0.278, 0.278, 0.3213], atol=1e-9
    )
    np.testing.assert_allclose(bh[3:10], [0.035625, 0.0603, 0.06385714, 0.06385714, 0.0645, 0.0765, 0.486], atol=1e-8)


NAN = [1.0, 2.0, np.nan, 4.0, 5.0]
LINE = [1.0, 2.0, 3.0, 4.0, 5.5]
FLAT = [2.0] * 5


@pytest.mark.parametrize(
    "call",
    [
        *(
            lambda f=f, x=x: f(x)
            for f in (srm, cohens_dz, effect_size, wilcoxon, shapiro_wilk, niqr)
            for x in (NAN, [1.0])
        ),
        *(lambda f=f: f(FLAT) for f in (srm, cohens_dz, effect_size, wilcoxon, shapiro_wilk)),
        *(lambda f=f: f(LINE, FLAT[:4]) for f in (srm, correlation, bland_altman)),
        *(lambda f=f: f(LINE, [np.inf, *LINE[1:]]) for f in (srm, correlation, bland_altman, mann_whitney, hedges_g)),
        *(lambda f=f: f(LINE, NAN) for f in (srm, correlation, bland_altman, mann_whitney, hedges_g, compare_groups)),
        *(lambda f=f: f(FLAT, FLAT) for f in (correlation, bland_altman, mann_whitney, hedges_g)),
        *(lambda f=f: f(LINE, [1.0]) for f in (mann_whitney, hedges_g, compare_groups)),
        lambda: hedges_g(FLAT, [1.0, 1.0]),
        lambda: srm([1, 1, 1, 2]),
        lambda: srm(["a", "b", "c"]),
        lambda: srm([1e200, 2e200, 3e200]),
        lambda: srm([1e-200, 2e-200, 3e-200]),
        lambda: cohens_dz([1e6, 1e6, 1e6 + 1]),
        lambda: effect_size([1.0, -2.0, 3.0], n_resamples=0),
        lambda: mann_whitney(np.ones((3, 2)), LINE),
        lambda: correlation(LINE, LINE, "repeated", ["a", "a", None, "b", "b"]),
        lambda: srm(np.ones((3, 2))),
        lambda: srm(LINE, confidence=95),
        lambda: shapiro_wilk(np.arange(5001.0)),
        lambda: correlation(LINE, FLAT),
        lambda: correlation(LINE, LINE, "kendall"),
        lambda: correlation(LINE, LINE, "pearson", [1, 1, 2, 2, 3]),
        lambda: correlation(LINE, LINE, "repeated"),
        lambda: correlation(LINE, LINE, "repeated", [1] * 5),
        lambda: correlation(LINE, LINE, "repeated", [1, 2, 3, 4, 5]),
        lambda: correlation([1, 1, 1, 2, 2, 2], [1, 2, 3, 4, 5, 7], "repeated", [1, 1, 1, 2, 2, 2]),
        lambda: correlation(LINE[:3], LINE[:3]),
        lambda: adjust([0.5, np.nan]),
        lambda: adjust([0.5, 1.5]),
        lambda: adjust([]),
        lambda: adjust([0.5], "bonferroni"),
    ],
)
def test_what_supports_no_number_is_refused(call):
    with pytest.raises(PblError, match=r"^STATS_INPUT: "):
        call()
