"""Stride length, step length and step width of feet whose places are known."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.gait import FootTrajectories, cycle_lengths, find_cycles, spatiotemporal
from pbl_pipeline.gait.cycle_measures import NO_WIDTH
from pbl_pipeline.gait.events import GaitEvent
from pbl_pipeline.gait.ground import FLAT_FROM, FLAT_TO, FOLLOWS, SLIDES, UNSEEN, why_no_lengths
from pbl_pipeline.synthetic import SynthSpec, synthesise
from tests import not_none

STRIDE_S, DOUBLE_S = 1.0, 0.1
UP = np.array([0.0, 0.0, 1.0])


def footprints(n: int = 8, left_step: float = 0.7, right_step: float = 0.5, width: float = 0.12) -> np.ndarray:
    """Places (n, 3) of foot k, alternately left and right; a left step ends at a left foot."""
    x = np.cumsum([0.0] + [right_step if k % 2 else left_step for k in range(1, n)])
    return np.stack([x, np.where(np.arange(n) % 2, -width / 2, width / 2), np.zeros(n)], axis=-1)


def walk(places: np.ndarray, fps: float = 50.0) -> tuple[FootTrajectories, list[GaitEvent]]:
    """Feet that stand at their places, the left first; foot k comes down at k * STRIDE_S / 2."""
    time = np.arange(0, len(places) * STRIDE_S / 2, 1 / fps)
    heel = np.zeros((len(time), 2, 3))
    events = []
    for foot in (0, 1):
        own = places[foot::2]
        downs = (np.arange(len(own)) * 2 + foot) * STRIDE_S / 2
        knots, at = [], []
        for d, p in zip(downs, own, strict=True):
            knots += [d, d + STRIDE_S / 2 + DOUBLE_S]
            at += [p, p]
            events.append(GaitEvent(float(d), ("left", "right")[foot], "foot_down", 1.0))
            events.append(GaitEvent(float(d + STRIDE_S / 2 + DOUBLE_S), ("left", "right")[foot], "foot_up", 1.0))
        heel[:, foot] = np.stack([np.interp(time, knots, np.array(at)[:, k]) for k in range(3)], axis=-1)
    pelvis = np.stack([np.interp(time, np.arange(len(places)) * STRIDE_S / 2, places[:, k]) for k in range(3)], axis=-1)
    n = len(time)
    feet = FootTrajectories(
        time, heel, heel + np.array([0.2, 0, 0]), pelvis + UP, np.tile([1.0, 0, 0], (n, 1)), UP, np.ones((n, 2)), "test"
    )
    return feet, sorted(events, key=lambda e: e.time_s)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize("degrees", [0.0, 37.0, 180.0])
def test_by_hand(degrees):
    feet, events = walk(turned(footprints(), degrees))
    cycles = find_cycles(events, feet=feet, keep_ends=True)
    # A left cycle ends with a left step, a right one with a right step.
    assert len(cycles) >= 4
    for c in cycles[:4]:
        own = c.lengths
        step = {"left": 0.7, "right": 0.5}[c.side]
        assert (own.stride_length_m, own.step_length_m, own.step_width_m) == pytest.approx((1.2, step, 0.12), abs=1e-9)
        assert own.metric
    result = spatiotemporal(cycles[:4])
    assert not_none(result["speed_m_per_s"]).mean == pytest.approx(1.2 / STRIDE_S)
    assert not_none(result["step_length_m"]).asymmetry_percent == pytest.approx(100 * (0.5 - 0.7) / 0.6)


@pytest.mark.parametrize("belt_m_per_s", [1.2, 1.1, 1.5])  # in place, forwards and backwards on the belt
def test_a_treadmill_and_a_phone_that_follows_have_no_lengths(belt_m_per_s):
    feet, events = walk(footprints())
    belt = np.outer(feet.time_s, [belt_m_per_s, 0, 0])
    on_belt = dataclasses.replace(feet, heel_m=feet.heel_m - belt[:, None], pelvis_m=feet.pelvis_m - belt)
    cycles = find_cycles(events, feet=on_belt, keep_ends=True)
    assert {c.lengths.missing for c in cycles[:4]} == {SLIDES}
    result = spatiotemporal(cycles[:4])
    assert result["speed_m_per_s"] is None
    assert "treadmill" in result.reasons["speed_m_per_s"]


def test_a_foot_that_is_taken_for_the_passing_one_keeps_its_place():
    """A standing heel that a detector drags along for a tenth of a second, once."""
    feet, events = walk(footprints())
    heel = feet.heel_m.copy()
    down = [e.time_s for e in events if (e.side, e.event) == ("left", "foot_down")][1]
    dragged = (feet.time_s > down + 0.2 * STRIDE_S) & (feet.time_s < down + 0.2 * STRIDE_S + 0.1)
    heel[dragged, 0, 0] += np.linspace(0.1, 0.4, dragged.sum())
    assert 2 <= dragged.sum() < 0.5 * (FLAT_TO - FLAT_FROM) * STRIDE_S / np.diff(feet.time_s)[0]
    cycles = find_cycles(events, feet=dataclasses.replace(feet, heel_m=heel), keep_ends=True)
    assert [c.lengths.stride_length_m for c in cycles[:4]] == pytest.approx([1.2] * 4, abs=1e-9)


def test_too_few_frames_are_no_place():
    feet, events = walk(footprints())
    gone = feet.heel_m.copy()
    gone[(feet.time_s > 2.0) & (feet.time_s < 2.4)] = np.nan
    cycles = find_cycles(events, feet=dataclasses.replace(feet, heel_m=gone), keep_ends=True)
    assert UNSEEN in {c.lengths.missing for c in cycles}
    assert any(c.lengths.stride_length_m is not None for c in cycles)


def test_one_camera_gives_no_width():
    feet, _ = walk(footprints())
    lengths, _ = cycle_lengths(feet, "left", 1.0, 1.5, 2.0, metric=False, width=False)
    assert lengths.stride_length_m == pytest.approx(1.2)
    assert (lengths.step_width_m, lengths.metric) == (None, False)
    assert "4 cm" in NO_WIDTH


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "known"), [("static", True), ("handheld", False)])
def test_what_a_fit_knows_depends_on_its_camera(camera, known):
    """The truth of a synthetic walker as a fit: step and stride are those of its footprints, or null."""
    from tests.unit.test_gait_fit import make_fit

    made = synthesise(SynthSpec(seed=2, view="sagittal", noise="none", speed_m_per_s=1.2))
    truth = made.truth
    fit = dataclasses.replace(
        make_fit(truth.time_s, {}), qpos=truth.qpos, scale=truth.scale, camera_motion=camera, name="walk"
    )
    assert why_no_lengths(fit) == ("" if known else FOLLOWS)
    cycles = [c for c in find_cycles(truth.events, fit) if c.used]
    assert cycles
    result = spatiotemporal(cycles)
    if not known:
        assert result["speed_m_per_s"] is None
        assert "phone moves" in result.reasons["speed_m_per_s"]
        return
    way = np.linalg.norm(truth.pelvis_m[-1, :2] - truth.pelvis_m[0, :2])
    assert not_none(result["speed_m_per_s"]).mean == pytest.approx(way / (truth.time_s[-1] - truth.time_s[0]), rel=0.02)
