"""Normal curves at a person's speed."""

from __future__ import annotations

import numpy as np
import pytest

from pbl_pipeline.gait import BODY_ANGLES, PLUG_IN_GAIT, Measure, Spatiotemporal, leg_length_m, normal_bands
from pbl_pipeline.gait.normative import GRAVITY, gait_norm
from pbl_pipeline.synthetic.physique import leg_length_m as by_mujoco

LEG_M = 0.9
PHASE = 2 * np.pi * np.linspace(0, 1, 51)


def measures(**means: float) -> Spatiotemporal:
    values = {k: Measure(None, None, v, None, 3) for k, v in means.items()}
    return Spatiotemporal("PASS", "", dict(values), {}, 3, 3, 4)


@pytest.mark.parametrize("scale", [np.ones(8), np.array([1.1, 0.9, 1.2, 0.8, 1.0, 1.05, 1, 1])])
def test_leg_length_is_that_of_the_body_by_mujoco(scale):
    assert leg_length_m(scale) == pytest.approx(by_mujoco(scale), abs=1e-6)


@pytest.mark.parametrize("group", [0, 2, 4])
def test_bands_at_the_speed_of_a_group_are_the_groups(group):
    norm = gait_norm()
    speed = float(norm.speed[group] * np.sqrt(GRAVITY * LEG_M))
    bands = normal_bands(measures(speed_m_per_s=speed, cadence_steps_per_min=60.0), LEG_M, PLUG_IN_GAIT)
    assert (bands.matched, bands.clipped) == ("speed", False)
    for angle in ("knee_flexion", "pelvis_obliquity"):
        mean, sd = bands.curves[angle]
        np.testing.assert_allclose(mean, norm.curve(angle, PHASE, norm.speed[group]), atol=1e-9)
        np.testing.assert_allclose(sd, norm.curve(angle, PHASE, norm.speed[group], sd=True), atol=1e-9)


@pytest.mark.parametrize("group", [0, 1, 3, 4])
def test_without_speed_the_cadence_decides(group):
    norm = gait_norm()
    cadence = 60 * float(norm.cadence[group]) / np.sqrt(LEG_M / GRAVITY)
    bands = normal_bands(measures(cadence_steps_per_min=cadence), LEG_M)
    assert bands.matched == "cadence"
    assert bands.speed == pytest.approx(norm.speed[group], abs=1e-6)


@pytest.mark.parametrize(("cadence", "end"), [(30.0, 0), (200.0, -1)])
def test_beyond_the_groups_it_says_so(cadence, end):
    bands = normal_bands(measures(cadence_steps_per_min=cadence), LEG_M)
    assert bands.clipped
    assert bands.speed == pytest.approx(gait_norm().speed[end])
    assert "slower or faster" in bands.words()


def test_without_a_leg_the_free_speed():
    bands = normal_bands(measures(cadence_steps_per_min=60.0))
    assert (bands.matched, bands.speed) == ("", pytest.approx(0.4294))
    assert bands.words() == "at the speed that they choose"


def test_bands_are_mapped_to_the_body():
    body, laboratory = (normal_bands(None, None, m).curves for m in (BODY_ANGLES, PLUG_IN_GAIT))
    assert {"hip_flexion", "pelvis_tilt", "knee_flexion"} < set(body)
    for angle in body:
        shift = 12.0 if angle in ("hip_flexion", "pelvis_tilt") else 0.0
        np.testing.assert_allclose(laboratory[angle][0] - body[angle][0], shift)
        np.testing.assert_allclose(laboratory[angle][1], body[angle][1])
