"""The arithmetic of the ablation (`research/benchmarks/ablation.py`): errors, their parts, and what a row changes."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.bench.case import PAPER_JOINTS
from pbl_pipeline.keypoints import Keypoints
from research.benchmarks.ablation import row_of
from research.benchmarks.ablation_cases import DEFAULT, Setup, factors, paramset_of, session


def errors(median: float, bias: float, sd: float, rte_cm: float = 2.0) -> dict:
    """`errors_of` with the same figures for every joint."""
    values = {"median_deg": median, "bias_deg": bias, "sd_deg": sd, "within_90": 0.9}
    return {**{k: dict.fromkeys(PAPER_JOINTS, v) for k, v in values.items()}, "rte_cm": rte_cm}


def test_a_row_compares_the_people_that_both_could_fit():
    default = {1: errors(1.0, 0, 1), 2: errors(2.0, 0, 1), 3: errors(9.0, 0, 1)}
    row = row_of(factors()[0], {1: errors(1.5, 0, 1), 2: errors(2.7, 0, 1)}, default)
    assert row["people"] == 2
    assert row["change_all_deg"] == pytest.approx(0.6)
    assert row["change_all_deg_se"] == pytest.approx(np.std([0.5, 0.7], ddof=1) / np.sqrt(2))


def test_every_row_is_named_once_and_differs_from_the_default():
    rows = factors()
    assert len({f.name for f in rows}) == len(rows)
    assert all(f.setup != DEFAULT.setup for f in rows)


@pytest.mark.slow
@pytest.mark.parametrize("factor", factors(), ids=lambda f: f.name)
def test_every_row_can_be_observed_and_has_a_paramset(factor):
    paramset_of(factor.setup)
    given, truth = session(dataclasses.replace(factor.setup, n_trials=1), 100, 0.5)
    assert truth[0].shape == (round(0.5 * factor.setup.fps), 40)
    assert given.trials[0].names


def test_rows_see_the_same_walk_with_the_same_random_numbers():
    by_name = {f.name: f.setup for f in factors()}

    def points(setup: Setup) -> Keypoints:
        seen = session(setup, 100, 1.0)[0].trials[0]
        assert isinstance(seen, Keypoints)
        return seen

    usual, told = points(DEFAULT.setup), points(by_name["focal length told 5 % too long"])
    np.testing.assert_array_equal(told.xy_px, usual.xy_px)
    np.testing.assert_allclose(np.diag(told.camera.matrix)[:2], 1.05 * np.diag(usual.camera.matrix)[:2])
    none, double = points(by_name["pixel noise x0"]).xy_px, points(by_name["pixel noise x2"]).xy_px
    np.testing.assert_allclose(0.5 * (none + double), usual.xy_px, atol=1e-9)
