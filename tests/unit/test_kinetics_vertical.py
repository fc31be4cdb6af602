"""The vertical force of one camera's motion, weighed against how people's force varies, against closed forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.kinetics import METHODS
from pbl_pipeline.kinetics.vertical import (
    Noise,
    VerticalModel,
    dimensionless_speed,
    load_vertical_model,
    support_phase,
    vertical_force,
)

SHIPPED = load_vertical_model(METHODS.find().params.vertical_model)
SPEED = SHIPPED.speed
N = 300


def steps(n: int = N) -> np.ndarray:
    """Feet on the floor of steps of 0.6 s, of which the first 0.12 s on both."""
    i = np.arange(n)
    both, left = i % 60 < 12, (i // 60) % 2 == 0
    return np.stack([both | left, both | ~left], axis=1)


def levels(sd: float) -> VerticalModel:
    """A model in which persons differ by a constant force alone."""
    ones = np.ones_like(SHIPPED.phase)
    return dataclasses.replace(
        SHIPPED, mean=ones, slope=0 * ones, person=sd * ones[:, None], step_sd=0.0, noise_memory_s=1e-3
    )


def test_the_posterior_of_a_constant_is_the_closed_form() -> None:
    sd, noise, m = 0.1, Noise(0.3, 0.8, 1.0), N // 3
    found = vertical_force(np.full(N, 1.2), steps(), SPEED, levels(sd), noise)
    kept = noise.gain**2 * sd**2 * m / (noise.gain**2 * sd**2 * m + noise.sd**2)
    np.testing.assert_allclose(found.mean, 1.0 + kept * 0.2 / noise.gain, atol=1e-6)
    rng = np.random.default_rng(0)
    drawn = np.array([found.draw(rng)[0] for _ in range(2000)])
    assert drawn.mean() == pytest.approx(found.mean[0], abs=0.003)
    assert drawn.std() == pytest.approx(sd * np.sqrt(1.0 - kept), rel=0.05)


def test_what_is_certain_stays() -> None:
    time = np.arange(N) / 100
    needed = 1.0 + 0.6 * np.sin(2 * np.pi * 1.3 * time)  # like no walk: it has another rhythm than the steps
    found = vertical_force(needed, steps(), SPEED, SHIPPED, Noise(1e-5, 1.0, 1.0))
    np.testing.assert_allclose(found.mean, needed, atol=2e-3)
    assert np.abs(found.draw(np.random.default_rng(0)) - needed).max() < 0.01


@pytest.mark.parametrize(("points", "least"), [("bml_movi_87", 0.9), ("blazepose_33", 0.6)])
def test_a_force_unlike_that_of_healthy_people_survives(points: str, least: float) -> None:
    """Somebody whose force hardly changes, as few who walk at that speed."""
    found = vertical_force(np.ones(N), steps(), SPEED, SHIPPED, SHIPPED.noise[points])
    usual = np.interp(support_phase(steps()), SHIPPED.phase, SHIPPED.expected(SPEED))
    assert np.std(found.mean) < (1.0 - least) * np.std(usual)


def test_noise_is_weighed_against_people() -> None:
    usual = np.interp(support_phase(steps()), SHIPPED.phase, SHIPPED.expected(SPEED))
    noise = SHIPPED.noise["blazepose_33"]
    off = np.repeat(np.random.default_rng(1).normal(0.0, noise.sd, N // 6), 6)
    found = vertical_force(1.0 + noise.gain * (usual - 1.0) + off, steps(), SPEED, SHIPPED, noise)
    assert np.std(found.mean - usual) < 0.7 * np.std(off)


def test_where_no_foot_stands_the_force_is_as_it_was() -> None:
    stands = steps()
    stands[100:150] = False
    needed = np.linspace(0.8, 1.2, N)
    found = vertical_force(needed, stands, SPEED, SHIPPED, SHIPPED.noise["blazepose_33"])
    np.testing.assert_array_equal(found.mean[100:150], needed[100:150])
    assert not np.allclose(found.mean[:100], needed[:100])


def test_a_support_that_is_seen_in_part_lasts_as_long_as_the_others() -> None:
    phase = support_phase(steps()[30:])
    assert phase[0] == pytest.approx(1.0 + (30 - 12 + 0.5) / 48)
    assert phase[30] == pytest.approx(0.5 / 12)
    assert np.isnan(support_phase(np.zeros((5, 2), bool))).all()


def test_speed_has_no_unit_and_beyond_the_walks_of_the_model_the_nearest_counts() -> None:
    centre = np.zeros((100, 3))
    centre[:, 1] = -1.2 * np.arange(100) / 100
    assert dimensionless_speed(centre, 1.8) == pytest.approx(1.2 / np.sqrt(9.80665 * 1.8))
    low, high = SHIPPED.speed_range
    np.testing.assert_array_equal(SHIPPED.expected(0.5 * low), SHIPPED.expected(low))
    assert np.ptp(SHIPPED.expected(high)) > 2 * np.ptp(SHIPPED.expected(low))


def test_long_recordings_are_estimated_in_parts() -> None:
    n = 4000
    time = np.arange(n) / 100
    needed = 1.0 + 0.1 * np.sin(2 * np.pi * time / 0.6)
    found = vertical_force(needed, steps(n), SPEED, SHIPPED, SHIPPED.noise["blazepose_33"])
    assert np.abs(np.diff(found.mean)).max() < 0.15
    assert found.draw(np.random.default_rng(0)).shape == (n,)
