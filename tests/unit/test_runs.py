"""Stretches of an array with one value."""

import numpy as np
import pytest

from pbl_pipeline.runs import runs


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([], []),
        ([False, False], []),
        ([True, True], [(0, 2)]),
        ([True, False, True, True], [(0, 1), (2, 4)]),
        ([0, 1, 1, -1, 0, -1], [(1, 3), (3, 4), (5, 6)]),
    ],
)
def test_stretches_of_one_value(values, expected):
    assert [(r.start, r.stop) for r in runs(np.array(values))] == expected
