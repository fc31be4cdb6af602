"""Curves that turn a stated confidence into a probability."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import (
    METHODS,
    Keypoints,
    confidence_curve,
    confidence_curves,
    confidence_text,
    probability_within,
)
from research.confidence import curve_params
from tests import not_none
from tests.unit.test_shortcomings import person


def test_curves_that_ship_are_monotone_and_say_where_they_come_from():
    assert confidence_curves()
    for name, curve in confidence_curves().items():
        assert curve.name == name
        values = curve(np.linspace(0, 1, 101))
        assert values[0] == 0  # no point
        assert np.all(np.diff(values[1:]) >= 0)
        assert np.all((values > 0) == (np.linspace(0, 1, 101) > 0))
        assert values.max() < 1
        assert curve.source
        assert curve.n > 1000


@pytest.mark.parametrize("name", list(METHODS))
def test_a_methods_curve_is_of_what_it_does(name: str):
    """Another detection states other confidences: fit a curve to it, `python -m
    research.confidence`, under the next version."""
    params = METHODS[name].params
    curve = confidence_curve(params.confidence_curve)
    assert curve.detector == params.detector
    assert curve_params(METHODS[name]) == curve.params


def test_the_name_of_the_curve_is_part_of_the_method():
    params = METHODS.find().params
    other = METHODS.make(METHODS.default, METHODS.find().version, dataclasses.replace(params, confidence_curve=""))
    assert other.hash != METHODS.find().hash


def test_an_unknown_curve_is_refused_and_none_is_no_curve(tmp_path):
    assert probability_within(person()) is None
    assert "not measured" in confidence_text(person())
    strange = dataclasses.replace(person(), confidence_curve="oracle-v9")
    with pytest.raises(PblError, match=r"^SOLVER_UNKNOWN: "):
        probability_within(strange)
    known = dataclasses.replace(person(), confidence_curve="blazepose-v1")
    known.confidence[0, 0] = 0.0
    known.save(tmp_path / "k.npz")
    again = Keypoints.load(tmp_path / "k.npz")
    probability = not_none(probability_within(again))
    assert probability[0, 0] == 0
    np.testing.assert_allclose(probability[1], confidence_curve("blazepose-v1")(np.full(33, 0.9)), atol=1e-5)
    assert "20% of the trunk's length (blazepose-v1)" in confidence_text(again)
