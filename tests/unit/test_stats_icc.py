"""Repeatability: Shrout & Fleiss' table, tables with missing ratings, what is refused."""

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.stats import ICC_KINDS, icc, minimal_detectable_change, ratings_table

#: Shrout & Fleiss 1979, table 2: six targets, four judges.
TABLE = np.array([[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]], float)
#: Subjects without any variance.
ALIKE = [[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]
HOLES = TABLE.copy()
HOLES[[0, 2, 4, 5, 5], [3, 1, 0, 2, 3]] = np.nan


@pytest.mark.parametrize(
    ("kind", "published", "oracle", "interval"),
    [  # published: their table 4; oracle and interval: pingouin 0.7.0
        ("1,1", 0.17, 0.1657417684, (-0.13, 0.72)),
        ("2,1", 0.29, 0.2897637795, (0.02, 0.76)),
        ("3,1", 0.71, 0.7148407148, (0.34, 0.95)),
        ("1,k", 0.44, 0.4427971337, (-0.88, 0.91)),
        ("2,k", 0.62, 0.6200505476, (0.07, 0.93)),
        ("3,k", 0.91, 0.9093155424, (0.68, 0.99)),
    ],
)
def test_the_table_of_shrout_and_fleiss(kind, published, oracle, interval):
    found = icc(TABLE, kind)
    assert found.value == pytest.approx(published, abs=0.005)
    assert found.value == pytest.approx(oracle, abs=1e-9)
    assert (found.low, found.high) == pytest.approx(interval, abs=0.005)
    assert (found.kind, found.n, found.k, found.missing, found.confidence) == (kind, 6, 4, 0, 0.95)


def test_units_order_and_data_frames_change_nothing():
    for kind in ICC_KINDS:
        found = icc(pd.DataFrame(TABLE[::-1, ::-1] * 10 + 1e4), kind)
        assert (found.value, found.low, found.high) == pytest.approx(
            (icc(TABLE, kind).value, icc(TABLE, kind).low, icc(TABLE, kind).high), abs=1e-9
        )
        assert found.sem == pytest.approx(10 * icc(TABLE, kind).sem)


def test_sem_is_sd_times_the_root_of_what_is_not_reliable():
    # Mean squares of their table 3: between 11.24, judges 32.49, residual 1.02, within 6.26.
    assert icc(TABLE, "3,1").sem == pytest.approx(np.sqrt(1.02), abs=0.005)
    assert icc(TABLE, "1,1").sem == pytest.approx(np.sqrt(6.26), abs=0.005)
    assert icc(TABLE, "1,k").sem == pytest.approx(np.sqrt(6.26 / 4), abs=0.005)
    assert icc(TABLE, "2,1").sem == pytest.approx(np.sqrt(1.02 + (32.49 - 1.02) / 6), abs=0.005)
    # Weir 2005: 1.96 sqrt(2) SEM.
    assert icc(TABLE, "3,1").mdc95 == pytest.approx(1.959964 * np.sqrt(2) * icc(TABLE, "3,1").sem, rel=1e-6)
    assert icc(TABLE, "3,1").mdc90 == pytest.approx(1.644854 * np.sqrt(2) * icc(TABLE, "3,1").sem, rel=1e-6)


@pytest.mark.parametrize(
    ("kind", "value"),
    [  # 1,1 and 3,1: statsmodels 0.15.0, MixedLM by REML
        ("1,1", 0.1404437),
        ("3,1", 0.6737529),
    ],
)
def test_missing_ratings_by_reml(kind, value):
    found = icc(HOLES, kind)
    assert found.value == pytest.approx(value, abs=2e-7)
    assert (found.n, found.missing) == (6, 5)
    assert found.k == pytest.approx(3.0)  # harmonic mean of 3, 4, 3, 4, 3, 2
    assert found.low < found.value < found.high


def test_two_way_components_maximise_the_restricted_likelihood():
    """Against the likelihood written with whole matrices: no other components near have a larger one."""
    i, j = np.nonzero(np.isfinite(HOLES))
    y, subjects, raters, ones = HOLES[i, j], np.eye(6)[i], np.eye(4)[j], np.ones((len(i), 1))

    def minus_twice_log(s, r, e):
        v = s * subjects @ subjects.T + r * raters @ raters.T + e * np.eye(len(y))
        inverse = np.linalg.inv(v)
        of_mean = ones.T @ inverse @ ones
        p = inverse - inverse @ ones @ np.linalg.solve(of_mean, ones.T @ inverse)
        return np.linalg.slogdet(v)[1] + np.linalg.slogdet(of_mean)[1] + y @ p @ y

    value = icc(HOLES, "2,1").value
    total_error = icc(HOLES, "2,1").sem ** 2
    s = value / (1 - value) * total_error
    best = min(minus_twice_log(s, r, total_error - r) for r in np.linspace(0.01, 0.99, 2000) * total_error)
    # Nelder and Mead on this function end at 43.5510653371 with an ICC of 0.2950110; statsmodels stops at 43.55108.
    assert value == pytest.approx(0.2950110, abs=1e-6)
    assert best == pytest.approx(43.5510653371, abs=1e-5)


def test_reml_of_a_complete_table_is_the_analysis_of_variance():
    """One rating missing of many changes little: both ways of computing agree."""
    g = np.random.default_rng(0)
    table = g.normal(0, 8, (80, 1)) + np.array([0, 2, 4]) + g.normal(0, 4, (80, 3))
    one_less = table.copy()
    one_less[0, 0] = np.nan
    for kind in ICC_KINDS:
        a, b = icc(table, kind), icc(one_less, kind)
        assert (a.value, a.low, a.high) == pytest.approx((b.value, b.low, b.high), abs=0.02)


def test_perfect_agreement_and_none():
    assert icc(np.repeat([[1.0], [2.0], [4.0]], 2, axis=1), "2,1").value == pytest.approx(1)
    shifted = np.array([[1.0, 2.0], [2.0, 3.0], [5.0, 6.0]])
    assert (icc(shifted, "3,1").value, icc(shifted, "3,1").sem) == pytest.approx((1, 0), abs=1e-7)
    assert icc(shifted, "2,1").value < 1
    opposite = np.array([[1.0, 2.0], [2.0, 1.0], [1.5, 1.5]])
    assert icc(opposite, "1,1").value == pytest.approx(-1)


@pytest.mark.slow
def test_limits_enclose_the_value_of_any_table():
    """Unreliable, small and tied tables: low <= value <= high <= 1 of every kind, or the coded error."""
    g = np.random.default_rng(3)
    n_values, codes = dict.fromkeys(ICC_KINDS, 0), set()
    for i in range(200):
        shape = g.integers(2, 8), g.integers(2, 5)
        table = g.integers(0, 4, shape).astype(float) if i % 2 else g.normal(size=shape)
        if i % 5 == 0:
            table[g.uniform(size=shape) < 0.2] = np.nan
        for kind in ICC_KINDS:
            for confidence in (0.95, 0.3):
                try:
                    found = icc(table, kind, confidence)
                except PblError as error:
                    codes.add(error.code)
                    continue
                assert found.low <= found.value <= found.high <= 1, (kind, table)
                n_values[kind] += 1
    assert min(n_values.values()) > 300, n_values
    assert codes == {"STATS_INPUT"}
    drawn = icc(g.normal(size=(6, 3)), "2,1", interval="generalized")
    assert drawn.low <= drawn.value <= drawn.high <= 1


def test_limits_of_unreliable_tables_do_not_cross():
    """Of 6 x 3 ratings without any reliability."""
    g = np.random.default_rng(0)
    n_values = 0
    for _ in range(100):
        try:
            found = icc(g.normal(size=(6, 3)), "2,k")
        except PblError:
            continue
        assert found.low < found.value < found.high <= 1
        n_values += 1
    assert n_values > 80


def test_subjects_without_any_variance():
    assert icc(ALIKE, "2,1").value == pytest.approx(0)


def test_drawn_interval_is_near_that_of_f_for_the_published_table():
    for kind in ICC_KINDS:
        by_f, drawn = icc(TABLE, kind), icc(TABLE, kind, interval="generalized")
        assert drawn.value == by_f.value
        assert drawn.high == pytest.approx(by_f.high, abs=0.02)
        assert drawn.low == pytest.approx(max(by_f.low, 0), abs=0.03)  # draws leave no variance below zero
    assert icc(TABLE, "2,1", interval="generalized") == icc(TABLE, "2,1", interval="generalized")
    with pytest.raises(PblError, match="interval"):
        icc(TABLE, "2,1", interval="bootstrap")


def test_long_form():
    values = [1.0, 2.0, 3.0, 4.0, 5.0]
    np.testing.assert_array_equal(ratings_table(values, ["b", "b", "a", "a", "a"]), [[1, 2, np.nan], [3, 4, 5]])
    np.testing.assert_array_equal(
        ratings_table(values[:3], ["b", "a", "a"], ["pre", "post", "pre"]), [[1, np.nan], [3, 2]]
    )
    with pytest.raises(PblError, match="two ratings"):
        ratings_table(values[:2], ["a", "a"], ["pre", "pre"])


@pytest.mark.parametrize(
    ("ratings", "kind"),
    [
        (TABLE, "4,1"),
        (TABLE, "2,2"),
        (TABLE[:1], "2,1"),
        (TABLE[:, :1], "1,1"),
        (TABLE[0], "2,1"),
        (np.full((5, 3), 7.0), "2,1"),
        (np.where(TABLE == 9, np.inf, TABLE), "2,1"),
        (np.vstack([TABLE, np.full(4, np.nan)]), "2,1"),
        (np.column_stack([TABLE, np.full(6, np.nan)]), "2,1"),
        (np.where(np.eye(6, dtype=bool), 1.0 + np.arange(6), np.nan), "1,1"),
        ([["a", "b"], ["c", "d"]], "1,1"),
        (np.full((3, 3), np.nan), "1,1"),
        (np.empty((0, 3)), "1,1"),
        (ALIKE, "3,1"),
        *(([[1, 2], [2, 1]], kind) for kind in ("1,k", "2,k", "3,k")),  # a mean without any reliability
    ],
)
def test_what_is_no_table_of_ratings_is_refused(ratings, kind):
    with pytest.raises(PblError, match="STATS_INPUT"):
        icc(ratings, kind)


def test_a_change_needs_a_sem():
    assert minimal_detectable_change(2.0) == pytest.approx(5.543616, abs=1e-5)
    for sem, confidence in ((-1.0, 0.95), (np.nan, 0.95), (1.0, 1.0)):
        with pytest.raises(PblError, match="STATS_INPUT"):
            minimal_detectable_change(sem, confidence)
