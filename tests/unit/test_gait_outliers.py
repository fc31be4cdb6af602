"""Cycles whose curves are unlike the others'."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.gait import GaitCycle, cycle_checks, find_cycles, spatiotemporal
from pbl_pipeline.gait._cycles import CURVE_ANGLES, without_odd_curves
from pbl_pipeline.synthetic import Impairment, SynthSpec, synthesise

pytestmark = pytest.mark.slow

PHASE = np.linspace(0, 2 * np.pi, 51)


def cycles(n: int, sd_deg: float, side: str = "left", seed: int = 0) -> list[GaitCycle]:
    """Cycles whose curves differ by constants with a standard deviation."""
    rng = np.random.default_rng(seed)
    shape = {
        "hip_flexion": 20 * np.cos(PHASE),
        "knee_flexion": 30 - 25 * np.sin(PHASE),
        "ankle_dorsiflexion": 0 * PHASE,
    }
    out = []
    for k in range(n):
        curves = {a: shape[a] + sd_deg * rng.standard_normal() for a in CURVE_ANGLES}
        out.append(GaitCycle("t", k, 0, side, k, k + 0.1, k + 0.5, k + 0.6, k + 1.0, curves=curves))
    return out


def away(cycle: GaitCycle, deg: float) -> GaitCycle:
    return dataclasses.replace(cycle, curves={k: v + deg for k, v in cycle.curves.items()})


def test_the_reason_says_how_far():
    usual = cycles(8, 1.0)
    usual[3] = away(usual[3], 25.0)
    found = without_odd_curves(usual)
    assert [c.used for c in found] == [k != 3 for k in range(8)]
    assert found[3].odd_curves
    assert found[3].excluded.endswith("deg from the median curves of 8 cycles")
    assert float(found[3].excluded.split()[0]) == pytest.approx(25, abs=2)
    check = next(c for c in cycle_checks(spatiotemporal(found), found) if c.check == "cycles_of_odd_curves")
    assert (check.outcome, check.value) == ("WARN", 1.0)


@pytest.mark.parametrize("sd_deg", [0.0, 1.0, 4.0, 8.0])
def test_the_variability_of_a_person_is_no_outlier(sd_deg):
    for seed in range(20):
        assert all(c.used for c in without_odd_curves(cycles(20, sd_deg, seed=seed)))


def test_few_cycles_and_the_other_side_say_nothing():
    few = cycles(4, 1.0)
    few[0] = away(few[0], 60.0)
    assert all(c.used for c in without_odd_curves(few))
    # The usual curves of the right side are nothing to the left.
    right = [away(c, 40.0) for c in cycles(6, 1.0, "right")]
    assert all(c.used for c in without_odd_curves([*cycles(6, 1.0), *right]))


@pytest.mark.parametrize("impairment", [None, "weakness", "crouch"])
def test_synthetic_walkers_lose_no_cycle(impairment):
    from tests.unit.test_gait_fit import make_fit

    impaired = (Impairment(impairment, 1.0),) if impairment else ()
    truth = synthesise(SynthSpec(seed=5, view="frontal", noise="none", seconds=12.0, impairments=impaired)).truth
    fit = dataclasses.replace(make_fit(truth.time_s, {}), qpos=truth.qpos, scale=truth.scale)
    found = find_cycles(truth.events, fit)
    assert sum(c.used for c in found) >= 8
    assert not any(c.odd_curves for c in found)
