"""Parts of the event model: features, grid, filter, walking, training data, calibration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pbl_pipeline.gait.events import FilterParams, PhaseParams, WalkingParams
from pbl_pipeline.gait.events.network.features import N_FEATURES, features, heading, leg_length
from pbl_pipeline.gait.events.network.predict import GRID_HZ, Grid, Phases, on_grid
from pbl_pipeline.gait.events.network.transformer import Architecture, PhaseTransformer, load_model, save_model
from pbl_pipeline.gait.events.phase_filter import crossings, smooth_phases
from pbl_pipeline.gait.events.walking import turn_deg_per_stride, walking_stretches
from pbl_pipeline.paramset import Paramset
from tests.compiled import little_optimised

UP = np.array([0.0, 0.0, 1.0])
SMALL = Architecture(width=16, blocks=1, heads=2, hidden=32)


def legs(n: int = 120, seed: int = 0) -> np.ndarray:
    """Joints (T, 5, 2, 3) of a body that goes along x and swings its legs."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / GRID_HZ
    out = np.zeros((n, 5, 2, 3))
    for s, (side, phase) in enumerate(((1.0, 0.0), (-1.0, np.pi))):
        for j, (down, reach) in enumerate(((0.0, 0.0), (0.4, 0.1), (0.8, 0.25), (0.85, 0.25), (0.86, 0.25))):
            out[:, j, s, 0] = 1.1 * t + reach * np.cos(2 * np.pi * t + phase) + (0.15 if j == 4 else 0.0)
            out[:, j, s, 1] = 0.1 * side
            out[:, j, s, 2] = 0.9 - down
    return out + 0.001 * rng.standard_normal(out.shape)


# --- features


@pytest.mark.parametrize("angle_deg", [35.0, -160.0])
def test_features_do_not_know_where_the_body_is_how_large_it_is_or_where_it_heads(angle_deg):
    joints, known = legs(), np.ones((120, 5, 2), bool)
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned = 37.0 * (joints @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + [5.0, -3.0, 1.0])
    a, seen = features(joints, known, UP, leg_length(joints, known))
    b, _ = features(turned, known, UP, leg_length(turned, known))
    assert a.shape == (120, N_FEATURES)
    assert seen.all()
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_features_of_a_point_ahead_to_the_left_and_below():
    joints, known = np.zeros((60, 5, 2, 3)), np.zeros((60, 5, 2), bool)
    joints[:, 0, 0], joints[:, 0, 1] = [0, 0.1, 0.9], [0, -0.1, 0.9]  # faces along x
    joints[:, 2, 0] = [0.3, 0.2, 0.1]
    known[:, 0], known[:, 2, 0] = True, True
    values, _ = features(joints, known, UP, 0.5)
    place, there = values[:, :30].reshape(60, 5, 2, 3), values[:, 30:].reshape(60, 5, 2)
    np.testing.assert_allclose(place[5, 2, 0], [0.6, 0.4, -1.6], atol=1e-9)
    assert (there[5, 2] == [1.0, 0.0]).all()
    assert (place[5, 2, 1] == 0).all()


def test_what_is_not_known_does_not_matter():
    joints, known = legs(), np.ones((120, 5, 2), bool)
    known[30:60, 3], known[80:90, 0, 1] = False, False
    wild = np.where(known[..., None], joints, 1e6)
    a, seen = features(joints, known, UP, 0.8)
    b, _ = features(wild, known, UP, 0.8)
    np.testing.assert_array_equal(a, b)
    assert not seen[80:90].any()
    assert (a[80:90] == 0).all()


@pytest.mark.slow
def test_features_are_the_same_in_jax():
    joints, known = legs(), np.ones((120, 5, 2), bool)
    known[10:20, 2, 0] = False
    a, _ = features(joints, known, UP, 0.8)
    b, _ = features(jnp.asarray(joints, jnp.float32), jnp.asarray(known), jnp.asarray(UP, jnp.float32), 0.8, jnp)
    np.testing.assert_allclose(a, np.asarray(b), atol=2e-5)


def test_heading_is_level_and_across_the_hips():
    line = np.tile([0.0, 0.2, 0.05], (60, 1))
    np.testing.assert_allclose(heading(line, np.ones(60, bool), UP), np.tile([1.0, 0, 0], (60, 1)), atol=1e-6)


# --- grid


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 100.0, 240.0])
def test_the_grid_does_not_shift_in_time(fps):
    time = np.arange(0, 4, 1 / fps)
    legs_m = np.zeros((len(time), 5, 2, 3))
    legs_m[..., 0] = np.sin(2 * np.pi * time)[:, None, None]
    legs_m[:, 0, 0, 1], legs_m[:, 0, 1, 1] = 0.1, -0.1
    legs_m[:, 2, :, 2] = -0.8
    grid = on_grid(time, legs_m, UP)
    middle = slice(10, -10)
    np.testing.assert_allclose(np.diff(grid.time_s), 1 / GRID_HZ, atol=1e-9)
    np.testing.assert_allclose(
        grid.joints_m[middle, 2, 0, 0], np.sin(2 * np.pi * grid.time_s[middle]), atol=0.012 if fps < 50 else 0.004
    )


def test_short_gaps_are_filled_and_long_ones_are_not():
    time = np.arange(0, 3, 1 / 30)
    legs_m = np.ones((len(time), 5, 2, 3))
    legs_m[30:34, 2, 0], legs_m[50:70, 2, 0] = np.nan, np.nan
    known = on_grid(time, legs_m, UP).known[:, 2, 0]
    at = np.arange(len(known)) / GRID_HZ
    assert known[(at > 0.9) & (at < 1.4)].all()
    assert not known[(at > 1.7) & (at < 2.2)].any()


# --- filter


def true_phases(n: int, rate: float = 0.9, offsets=(0.0, 0.12, 0.5, 0.62)) -> np.ndarray:
    """Phases (T, 4) in rad at a rate in turns a second, which changes a little."""
    t = np.arange(n) / GRID_HZ
    turn = rate * t + 0.05 * np.sin(0.7 * t)
    return 2 * np.pi * (turn[:, None] - np.array(offsets))


def test_the_filter_finds_the_phases_in_noise():
    rng = np.random.default_rng(0)
    phase = true_phases(400)
    z = np.exp(1j * (phase + 0.25 * rng.standard_normal(phase.shape))) * np.exp(-(0.25**2) / 2)
    smooth = smooth_phases(z, 1 / GRID_HZ, FilterParams(memory_frames=1.0))
    off = np.angle(np.exp(1j * (smooth.phase_rad - phase)))
    assert off.std() < 0.08
    assert abs(off.mean()) < 0.02
    np.testing.assert_allclose(smooth.rate[20:-20] / 2 / np.pi, 0.9, atol=0.08)
    # Its own standard deviation is of the size of its error.
    assert 0.4 < off.std() / smooth.sd_rad.mean() < 2.0


def test_the_filter_goes_on_through_a_gap():
    phase = true_phases(300)
    z = 0.99 * np.exp(1j * phase)
    z[140:160] = 0
    smooth = smooth_phases(z, 1 / GRID_HZ, FilterParams())
    off = np.angle(np.exp(1j * (smooth.phase_rad - phase)))
    assert np.abs(off).max() < 0.1
    assert smooth.sd_rad[150].mean() > 1.2 * smooth.sd_rad[100].mean()


def test_one_wrong_event_is_pulled_by_the_other_three():
    phase = true_phases(300)
    z = 0.995 * np.exp(1j * phase)
    z[140:150, 0] *= 0.5 * np.exp(1j * 1.5) / 0.995
    smooth = smooth_phases(z, 1 / GRID_HZ, FilterParams())
    assert abs(np.angle(np.exp(1j * (smooth.phase_rad[145, 0] - phase[145, 0])))) < 0.1


def test_crossings_lie_between_frames():
    time = np.arange(0, 3, 0.02)
    at = crossings(2 * np.pi * (1.3 * time - 0.51), time)
    np.testing.assert_allclose(at, (np.arange(4) + 0.51)[: len(at)] / 1.3, atol=1e-9)
    assert len(at) == 4
    assert len(crossings(np.array([0.1]), np.array([0.0]))) == 0


# --- walking


def a_grid(n: int, swing: np.ndarray, heading_rad: np.ndarray | None = None) -> Grid:
    joints, known = np.zeros((n, 5, 2, 3)), np.ones((n, 5, 2), bool)
    turn = np.zeros(n) if heading_rad is None else heading_rad
    ahead = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=1)
    joints[:, :2] += [[UP], [0.5 * UP]]  # hips and knees above the feet
    joints[:, 2:, 0] += 0.5 * swing[:, None, None] * ahead[:, None]
    joints[:, 2:, 1] -= 0.5 * swing[:, None, None] * ahead[:, None]
    return Grid(np.arange(n) / GRID_HZ, joints, known, UP, ahead, 1.0)


def some_phases(n: int, walking: np.ndarray, seen: np.ndarray | None = None) -> Phases:
    return Phases(np.ones((n, 4), complex), walking, np.ones(n, bool) if seen is None else seen)


def phases_of(n: int, strides_hz: float) -> Phases:
    """Phases of a walk with so many strides a second."""
    phase = 2 * np.pi * strides_hz * np.arange(n) / GRID_HZ
    return Phases(np.exp(1j * (phase[:, None] - np.arange(4))), np.ones(n), np.ones(n, bool))


def test_stretches_end_at_standing_gaps_and_turns():
    n = 1000
    swing = 0.6 * np.sin(2 * np.pi * np.arange(n) / GRID_HZ)
    walking, seen, turn = np.ones(n), np.ones(n, bool), np.zeros(n)
    walking[200:300] = 0.01  # stands
    walking[340:346] = 0.01  # a moment of doubt
    seen[500:560] = False  # out of view
    turn[750:800] = np.pi * np.linspace(0, 1, 50)  # turns round within a second
    turn[800:] = np.pi
    found = walking_stretches(a_grid(n, swing, turn), some_phases(n, walking, seen), WalkingParams())
    assert len(found) == 4
    assert found[0][0] == 0
    for edges, wanted in zip(found[1:], ((300, 499), (560, 750), (800, 999)), strict=True):
        np.testing.assert_allclose(edges, wanted, atol=15)


def test_feet_that_do_not_pass_each_other_do_not_walk():
    n = 300
    still = a_grid(n, 0.05 * np.sin(2 * np.pi * np.arange(n) / GRID_HZ))
    assert walking_stretches(still, some_phases(n, np.ones(n)), WalkingParams()) == []


def test_turn_of_a_stride_by_hand():
    """Positive to the left: 40 deg/s is 80 deg of a stride at 0.5 strides a second, 32 at 1.25; also at the ends."""
    n = 400
    turn = np.radians(40.0) * np.arange(n) / GRID_HZ
    for strides_hz, wanted in ((0.5, 80.0), (1.25, 32.0)):
        phases = phases_of(n, strides_hz)
        np.testing.assert_allclose(turn_deg_per_stride(a_grid(n, np.zeros(n), turn), phases), wanted, rtol=0.05)
        np.testing.assert_allclose(turn_deg_per_stride(a_grid(n, np.zeros(n)), phases), 0.0, atol=1e-6)


def test_a_bend_ends_a_slow_walk_and_not_a_fast_one():
    """40 deg/s for three seconds."""
    n = 600
    turn = np.radians(40.0) * np.clip(np.arange(n) / GRID_HZ - 4.5, 0, 3)
    swing = 0.6 * np.sin(2 * np.pi * np.arange(n) / GRID_HZ)
    for strides_hz, stretches in ((0.5, 2), (1.6, 1)):
        phases = phases_of(n, strides_hz)
        found = walking_stretches(a_grid(n, swing, turn), phases, WalkingParams(max_turn_deg_per_stride=30.0))
        assert len(found) == stretches
        assert len(walking_stretches(a_grid(n, swing, turn), phases, WalkingParams())) == 1  # version 1: by time


# --- network


@pytest.fixture(scope="module")
def model() -> PhaseTransformer:
    """A small network with random weights."""
    with little_optimised():
        return eqx.filter_jit(PhaseTransformer)(SMALL, jax.random.key(3))


@pytest.mark.slow
@pytest.mark.usefixtures("little_optimised")
def test_the_network_is_saved_and_read_again(model, tmp_path):
    save_model(tmp_path / "m.npz", model, {"seed": 3})
    again, about = load_model(tmp_path / "m.npz")
    assert about["seed"] == 3
    x, seen = jax.random.normal(jax.random.key(0), (40, N_FEATURES)), jnp.ones(40, bool)
    run = eqx.filter_jit(lambda m: m(x, seen))
    np.testing.assert_allclose(run(model), run(again), atol=0.02)
    np.savez(tmp_path / "other.npz", about=np.array('{"architecture": {"width": 16, "blocks": 1, "heads": 2}}'))
    with pytest.raises(ValueError, match="architecture"):
        load_model(tmp_path / "other.npz")


@pytest.mark.usefixtures("little_optimised")
def test_frames_that_are_not_seen_do_not_change_the_others_much(model):
    """Attention leaves them out; only the convolution of the frames beside them sees their zeros."""
    x = jax.random.normal(jax.random.key(0), (80, N_FEATURES))
    seen = jnp.arange(80) < 50
    run = eqx.filter_jit(lambda x, seen: model(x, seen))
    long = run(jnp.where(seen[:, None], x, 0.0), seen)
    short = run(x[:50], jnp.ones(50, bool))
    np.testing.assert_allclose(long[:46], short[:46], atol=0.01)
    everything = run(jnp.where(seen[:, None], x, 0.0), jnp.ones(80, bool))
    assert np.abs(everything[:46] - short[:46]).max() > 0.05


def test_parameters_go_through_the_database_form():
    params = PhaseParams("m", "s", filter=FilterParams(rate_noise=2.0))
    assert Paramset.of("gait", "x", 1, params).to(PhaseParams) == params
