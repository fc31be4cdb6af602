"""Sampling interval of stamps that their writer rounded."""

import numpy as np
import pytest

from pbl_pipeline.sampling import interval_of


@pytest.mark.parametrize("tick_s", [1e-3, 1 / 600, 1 / 90_000])
@pytest.mark.parametrize("fps", [23.976, 24.0, 25.0, 29.97, 30.0, 59.94, 60.0, 120.0, 240.0])
@pytest.mark.parametrize("dropped", [(), (1, 20, 21, 150)])
def test_rounded_stamps_have_the_rate_of_their_span(tick_s, fps, dropped):
    stamps = np.delete(np.round(np.arange(200) / fps / tick_s) * tick_s, dropped)
    assert 1 / interval_of(stamps) == pytest.approx(fps, abs=2 * fps * tick_s * fps / 200)


def test_stamps_that_are_not_rounded_keep_their_median():
    for stamps in (np.arange(90) / 30, np.delete(np.arange(90) / 30, [4, 5, 60]), np.arange(5) / 59.94):
        assert interval_of(stamps) == float(np.median(np.diff(stamps)))


def test_rates_that_change_have_the_median():
    """In low light a phone goes from 30 to 24 frames a second: the mean is neither."""
    slower = np.cumsum(np.r_[np.full(100, 1 / 30), np.full(60, 1 / 24)])
    jumping = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.05, 200))
    for stamps in (slower, jumping):
        assert interval_of(stamps) == float(np.median(np.diff(stamps)))
