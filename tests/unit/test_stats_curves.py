"""Permutation inference over the gait cycle: exact small cases, agreement with another program, what is refused."""

import itertools
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pbl_pipeline.errors import PblError
from pbl_pipeline.stats import CURVE_METHODS, curve_test
from research.benchmarks.curve_alarms import CASES, alarms, smooth, walks


def curves(seed: int, n: int, points: int = 101) -> np.ndarray:
    return smooth(np.random.default_rng(seed), n, points)


def t_of(result: Any) -> np.ndarray:
    return result.statistic


def bump(points: int = 101) -> np.ndarray:
    """Raised between 60 and 75 % of the cycle."""
    return np.exp(-(((np.linspace(0, 100, points) - 67) / 5) ** 2))


def test_t_is_students_and_welchs():
    a, b = curves(0, 12), curves(1, 12)
    np.testing.assert_allclose(curve_test(a, b, paired=True).t, t_of(stats.ttest_rel(a, b)), atol=1e-9)
    unpaired = curve_test(a[:7], b, paired=False).t
    np.testing.assert_allclose(unpaired, t_of(stats.ttest_ind(a[:7], b, equal_var=False)), atol=1e-9)
    shifted = curve_test(a * 1e3 + 1e5, b * 1e3 + 1e5, paired=False).t
    np.testing.assert_allclose(shifted, t_of(stats.ttest_ind(a, b, equal_var=False)), atol=1e-6)


def test_all_sign_flips_of_seven_persons():
    d = curves(2, 7, 11) + 1.0
    found = curve_test(d, np.zeros_like(d), paired=True)
    flips = np.array(list(itertools.product((1, -1), repeat=7)))
    largest = np.array([np.abs(t_of(stats.ttest_1samp(s[:, None] * d, 0))).max() for s in flips])
    expected = [(largest >= abs(t) - 1e-9).mean() for t in t_of(stats.ttest_1samp(d, 0))]
    np.testing.assert_allclose(found.p, expected, atol=1e-12)
    assert (found.exact, found.permutations, found.smallest_p) == (True, 128, 2 / 128)
    assert np.array_equal(np.abs(found.t) > found.threshold, found.p <= 0.05)


@pytest.mark.parametrize("sizes", [(5, 4), (4, 4)])
def test_all_labels_of_small_groups(sizes):
    x = curves(3, sum(sizes), 9)
    x[: sizes[0]] += 1.5
    found = curve_test(x[: sizes[0]], x[sizes[0] :], paired=False)
    everybody = set(range(sum(sizes)))
    largest = [
        np.abs(t_of(stats.ttest_ind(x[list(c)], x[sorted(everybody - set(c))], equal_var=False))).max()
        for c in itertools.combinations(range(sum(sizes)), sizes[0])
    ]
    expected = [(np.array(largest) >= abs(t) - 1e-9).mean() for t in found.t]
    np.testing.assert_allclose(found.p, expected, atol=1e-12)
    assert (found.exact, found.permutations) == (True, len(largest))


def test_clusters_of_seven_persons():
    d = curves(4, 7, 31) + 0.8 * bump(31)
    found = curve_test(d, np.zeros_like(d), paired=True, method="cluster", cluster_p=0.1)
    critical = stats.t.isf(0.05, 6)
    assert found.threshold == pytest.approx(critical)

    def masses(t):
        sign = np.sign(t) * (np.abs(t) > critical)
        groups = itertools.groupby(range(len(t)), key=lambda i: sign[i])
        return [(list(points), key) for key, points in groups if key]

    own = t_of(stats.ttest_1samp(d, 0))
    null = []
    for signs in itertools.product((1, -1), repeat=7):
        t = t_of(stats.ttest_1samp(np.array(signs)[:, None] * d, 0))
        null.append(max([np.abs(t[p]).sum() for p, _ in masses(t)], default=0.0))
    expected = np.ones(31)
    for points, _ in masses(own):
        expected[points] = (np.array(null) >= np.abs(own[points]).sum() - 1e-9).mean()
    assert (expected < 1).any()
    np.testing.assert_allclose(found.p, expected, atol=1e-12)


@pytest.mark.parametrize("method", CURVE_METHODS)
@pytest.mark.parametrize("paired", [True, False])
def test_a_phase_that_differs_is_found_where_it_is(method, paired):
    a, b = curves(5, 40), curves(6, 40)
    found = curve_test(a + 1.5 * bump(), b, paired=paired, method=method, n_permutations=2000)
    assert len(found.phases) == 1
    phase = found.phases[0]
    assert 55 < phase.first < 67 < phase.last < 80
    assert (phase.sign, phase.p) == (1, found.p_value)
    assert (found.n_a, found.n_b, found.permutations, found.exact) == (40, 40, 2000, False)
    assert found.difference[67] == pytest.approx((a - b).mean(axis=0)[67] + 1.5)
    other_way = curve_test(b, a + 1.5 * bump(), paired=paired, method=method, n_permutations=2000)
    assert other_way.phases[0].sign == -1


def test_persons_count_not_repeats():
    g = np.random.default_rng(7)
    own = smooth(g, 10)
    (a, of_a), (b, of_b) = walks(g, own, 1, 9), walks(g, own, 1, 9)
    means = [np.array([x[p == i].mean(axis=0) for i in range(10)]) for x, p in ((a, of_a), (b, of_b))]
    order = g.permutation(len(a))
    found = curve_test(a[order], b, persons_a=of_a[order], persons_b=of_b, paired=True)
    expected = curve_test(*means, paired=True)
    np.testing.assert_allclose(found.p, expected.p)
    np.testing.assert_allclose(found.t, expected.t)
    assert (found.n_a, found.permutations) == (10, 1024)


def test_persons_are_paired_by_name():
    a, b = curves(15, 8), curves(16, 8)
    names = list("abcdefgh")
    found = curve_test(a, b[::-1], persons_a=names, persons_b=names[::-1], paired=True)
    np.testing.assert_allclose(found.t, curve_test(a, b, paired=True).t)


def test_chance_comes_from_the_seed():
    a, b = curves(8, 30), curves(9, 30)
    first = curve_test(a, b, paired=False, n_permutations=500)
    np.testing.assert_array_equal(first.p, curve_test(a, b, paired=False, n_permutations=500).p)
    assert not np.array_equal(first.p, curve_test(a, b, paired=False, n_permutations=500, seed=1).p)


def test_thresholds_and_phases_as_by_spm1d():
    """spm1d 0.4.55, nonparam.ttest_paired and ttest2, all permutations. Its critical |t| is an interpolated percentile
    of theirs, ours the smallest |t| that is not significant; its phases end between points."""
    pairs = curve_test(curves(11, 10) + 2 * bump(), curves(12, 10), paired=True)
    assert pairs.threshold == pytest.approx(4.438763978, abs=0.01)
    assert pairs.t[67] == pytest.approx(4.289310296743527, abs=1e-9)
    assert [(p.first, p.last) for p in pairs.phases] == [(68.0, 68.0)]  # 67.56 to 68.52
    groups = curve_test(curves(13, 6) + 2.5 * bump(), curves(14, 6), paired=False)
    assert groups.threshold == pytest.approx(4.084022242, abs=0.01)
    assert groups.t[67] == pytest.approx(5.025992631535399, abs=1e-9)
    assert [(p.first, p.last) for p in groups.phases] == [(63.0, 68.0)]  # 62.58 to 68.35


@pytest.mark.needs_extra
@pytest.mark.parametrize("name", ["tpaired.PlantarArchAngle", "t2.PlantarArchAngle", "t2.SimulatedTwoLocalMax"])
def test_own_examples_of_spm1d(name):
    spm1d = pytest.importorskip("spm1d")
    kind, dataset = name.split(".")
    a, b = getattr(getattr(spm1d.data.uv1d, kind), dataset)().get_data()
    found = curve_test(a, b, paired=kind == "tpaired")
    np.random.seed(0)  # noqa: NPY002 - spm1d draws from it
    theirs = getattr(spm1d.stats.nonparam, "ttest_paired" if kind == "tpaired" else "ttest2")(a, b)
    iterations = -1 if theirs.permuter.nPermTotal <= 10_000 else 10_000
    theirs = theirs.inference(0.05, two_tailed=True, iterations=iterations)
    np.testing.assert_allclose(found.t, theirs.z, atol=1e-9)
    assert found.threshold == pytest.approx(theirs.zstar, abs=0.03)
    ends = [np.array(c.endpoints) / (a.shape[1] - 1) * 100 for c in theirs.clusters]
    np.testing.assert_allclose([(p.first, p.last) for p in found.phases], ends, atol=1.1)


@pytest.mark.parametrize("name", [n for n in CASES if "unequal" in n and ("17" in n or "1 to 20" in n)])
def test_false_alarms_of_a_few_studies(name):
    """The command `python -m research.benchmarks.curve_alarms` has 4,000; here the bounds of 100 at 5 %."""
    assert 0.01 <= alarms(CASES[name], "max-t", 100, 3, 200) <= 0.12


A = curves(10, 8, 21)
SPOILT = A.copy()
SPOILT[3, 5] = np.nan
INFINITE = np.where(A.max() == A, np.inf, A)
TIED = A.copy()
TIED[:, 0] = 0.0


@pytest.mark.parametrize(
    ("a", "b", "options"),
    [
        (SPOILT, A, {"paired": True}),
        (A, INFINITE, {"paired": False}),
        (A[:, 0], A[:, 0], {"paired": True}),
        (A, A[:, :20], {"paired": False}),
        (A, A[:7], {"paired": True}),
        (A, A, {"paired": True}),
        (TIED, TIED[::-1], {"paired": True}),
        (A[:1], A[1:2], {"paired": True}),
        (A[:5], A[::-1][:5], {"paired": True}),
        (A[:1], A[1:], {"paired": False}),
        (A[:3], A[3:6], {"paired": False}),
        (A, A[::-1], {"paired": True, "n_permutations": 10}),
        (A, A[::-1], {"paired": True, "method": "spm"}),
        (A, A[::-1], {"paired": True, "alpha": 5}),
        (A, A[::-1], {"paired": True, "persons_a": [1, 2]}),
        (A, A[::-1], {"paired": True, "persons_a": list("abcdefgh"), "persons_b": list("abcdefgx")}),
        (A, A[::-1], {"paired": False, "persons_a": list("abcdefgh"), "persons_b": list("hijklmno")}),
        (A, A[::-1], {"paired": True, "persons_a": [*"abcdefg", None], "persons_b": [*"abcdefg", None]}),
        (A, A[::-1], {"paired": True, "n_permutations": 0}),
        (A[:0], A[:0], {"paired": True}),
    ],
)
def test_what_cannot_be_tested_is_refused(a, b, options):
    with pytest.raises(PblError, match=r"^STATS_INPUT: "):
        curve_test(a, b, **options)
