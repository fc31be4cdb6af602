"""The vertical force of one camera's motion, weighed against how people's force varies, against closed forms."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.kinetics import METHODS, segment_inertia
from pbl_pipeline.kinetics.compute import trial_series
from pbl_pipeline.kinetics.vertical import (
    Noise,
    VerticalModel,
    dimensionless_speed,
    load_vertical_model,
    support_phase,
    vertical_force,
)
from tests.walking_fit import walking_fit

SHIPPED = load_vertical_model(METHODS.find().params.vertical_model)
NOISE = SHIPPED.noise["blazepose_33"]
SPEED = SHIPPED.speed
N = 300
BODY = load_body()


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
    usual = np.interp(support_phase(steps()), SHIPPED.phase, SHIPPED.expected(SPEED))
    needed = usual + 0.3 * np.sin(2 * np.pi * 1.3 * np.arange(N) / 100)  # another rhythm than that of the steps
    found = vertical_force(needed, steps(), SPEED, SHIPPED, Noise(1e-5, 1.0, 1.0))
    np.testing.assert_allclose(found.mean[::3], needed[::3], atol=1e-3)
    assert np.sqrt(np.mean((found.mean - needed) ** 2)) < 0.02
    assert np.abs(found.draw(np.random.default_rng(0)) - found.mean)[::3].max() < 0.001


def test_only_one_camera_with_known_noise_and_a_stated_error_is_weighed() -> None:
    method = METHODS.find()
    fit = walking_fit(BODY.joint_names, BODY.sha256, n_frames=240, start_m=(6.0, -4.5, -0.2))
    fit = dataclasses.replace(
        fit, orientation_source="measured: phone", marker_set="blazepose_33", qpos_sd=np.full_like(fit.qpos, 0.01)
    )
    events = gait_metrics([fit]).trials[0].events.events

    def vertical(**changes) -> np.ndarray:
        changed = dataclasses.replace(fit, **changes)
        inertia = segment_inertia(BODY, fit.scale)
        series = trial_series(BODY, changed, inertia, np.asarray(fit.qpos, float), events, method.params)
        assert series is not None
        return series.force_bw[:, :, 2].sum(axis=1)

    needed = vertical(orientation_source="measured: calibration")
    assert np.nanmax(np.abs(vertical() - needed)) > 0.02
    for changes in ({"marker_set": "bml_movi_87"}, {"qpos_sd": np.full_like(fit.qpos, np.nan)}):
        np.testing.assert_array_equal(vertical(**changes), needed)


def test_a_force_unlike_that_of_healthy_people_survives() -> None:
    """A person whose force hardly changes, as few at that speed, keeps most of that."""
    found = vertical_force(np.ones(N), steps(), SPEED, SHIPPED, NOISE)
    usual = np.interp(support_phase(steps()), SHIPPED.phase, SHIPPED.expected(SPEED))
    assert np.std(found.mean) < 0.4 * np.std(usual)


def test_noise_is_weighed_against_people() -> None:
    usual = np.interp(support_phase(steps()), SHIPPED.phase, SHIPPED.expected(SPEED))
    off = np.repeat(np.random.default_rng(1).normal(0.0, NOISE.sd, N // 6), 6)
    found = vertical_force(1.0 + NOISE.gain * (usual - 1.0) + off, steps(), SPEED, SHIPPED, NOISE)
    assert np.std(found.mean - usual) < 0.7 * np.std(off)


def test_where_no_foot_stands_the_force_is_as_it_was() -> None:
    stands = steps()
    stands[100:150] = False
    needed = np.linspace(0.8, 1.2, N)
    found = vertical_force(needed, stands, SPEED, SHIPPED, NOISE)
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
    found = vertical_force(needed, steps(n), SPEED, SHIPPED, NOISE)
    onset = slice(59, None, 60)  # of double support
    assert np.delete(np.abs(np.diff(found.mean)), np.arange(n - 1)[onset]).max() < 0.15
    assert found.draw(np.random.default_rng(0)).shape == (n,)
