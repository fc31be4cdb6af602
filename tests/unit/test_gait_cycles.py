"""Cycles and spatiotemporal measures of a list of events worked by hand."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    GDI_METHODS,
    AngleSeries,
    Condition,
    Exclusion,
    FootTrajectories,
    GaitCycle,
    GaitParams,
    Lengths,
    Measure,
    Spatiotemporal,
    cycle_checks,
    cycle_curves,
    find_cycles,
    gait_metrics,
    spatiotemporal,
)
from pbl_pipeline.gait._cycles import foot_passes
from pbl_pipeline.gait.events import GaitEvent
from pbl_pipeline.methods import stored
from pbl_pipeline.paramset import Paramset
from pbl_schemas import gait
from tests import not_none
from tests.walking_fit import walking_fit


def walk(downs: list[tuple[float, str]], double_support_s: dict[str, float], bout: int = 0) -> list[GaitEvent]:
    """Initial contacts as given; the other foot leaves the ground `double_support_s[side that landed]` later."""
    out = []
    for time, side in downs:
        other = "right" if side == "left" else "left"
        out += [
            GaitEvent(time, side, "foot_down", 1.0, bout),
            GaitEvent(time + double_support_s[side], other, "foot_up", 1.0, bout),
        ]
    return out


# Left steps (landing left) last 0.6 s, right steps 0.5 s; stride 1.1 s. After a left initial contact the right foot
# leaves 0.12 s later, after a right one the left 0.10 s later.
DOWNS = [
    (1.0, "left"),
    (1.5, "right"),
    (2.1, "left"),
    (2.6, "right"),
    (3.2, "left"),
    (3.7, "right"),
    (4.3, "left"),
    (4.8, "right"),
]
EVENTS = walk(DOWNS, {"left": 0.12, "right": 0.10})


def test_first_and_last_step_are_dropped():
    cycles = find_cycles(EVENTS, trial="a")
    assert [(c.side, round(c.start_s, 3), round(c.end_s, 3)) for c in cycles] == [
        ("left", 1.0, 2.1),
        ("right", 1.5, 2.6),
        ("left", 2.1, 3.2),
        ("right", 2.6, 3.7),
        ("left", 3.2, 4.3),
        ("right", 3.7, 4.8),
    ]
    assert [c.used for c in cycles] == [False, True, True, True, True, False]
    assert cycles[0].excluded == "first step of the bout"
    assert cycles[-1].excluded == "last step of the bout"
    assert [c.number for c in cycles] == list(range(6))
    c = cycles[2]
    assert (c.opposite_foot_up_s, c.opposite_foot_down_s, c.foot_up_s) == pytest.approx((2.22, 2.6, 2.7))


def of(result: Spatiotemporal, name: str) -> Measure:
    """A measure that must be there."""
    return not_none(result[name])


def test_measures_by_hand():
    result = spatiotemporal(find_cycles(EVENTS))
    assert (result.status, result.n_cycles_found, result.n_cycles_used) == ("PASS", 6, 4)
    # Inner steps: 1.5-2.1 l, 2.1-2.6 r, 2.6-3.2 l, 3.2-3.7 r, 3.7-4.3 l: five of the seven.
    assert result.n_steps_used == 5
    step = of(result, "step_time_s")
    assert (step.left, step.right, step.n) == pytest.approx((0.6, 0.5, 5))
    assert step.mean == pytest.approx((3 * 0.6 + 2 * 0.5) / 5)
    assert step.sd == pytest.approx(np.std([0.6, 0.5, 0.6, 0.5, 0.6], ddof=1))
    stride = of(result, "stride_time_s")
    assert (stride.left, stride.right, stride.mean, stride.sd, stride.n) == pytest.approx(
        (1.1, 1.1, 1.1, 0, 4), abs=1e-9
    )
    assert of(result, "cadence_steps_per_min").mean == pytest.approx(120 / 1.1)
    assert of(result, "cadence_steps_per_min").left is None
    # Left stance: down at 0, left toe-off 0.10 s after right initial contact at 0.5 -> 0.60 s of 1.1 s.
    assert of(result, "stance_percent").left == pytest.approx(100 * 0.60 / 1.1)
    # Right stance: down at 0, right toe-off 0.12 s after left initial contact at 0.6 -> 0.72 s.
    assert of(result, "stance_percent").right == pytest.approx(100 * 0.72 / 1.1)
    assert of(result, "swing_percent").left == pytest.approx(100 * 0.50 / 1.1)
    # The left foot stands alone while the right one swings: from 0.12 to 0.50 s; the right one from 0.10 to 0.60 s.
    assert of(result, "single_support_percent").left == pytest.approx(100 * 0.38 / 1.1)
    assert of(result, "single_support_percent").right == pytest.approx(100 * 0.50 / 1.1)
    assert of(result, "stance_time_s").right == pytest.approx(0.72)
    assert of(result, "swing_time_s").left == pytest.approx(0.50)
    assert of(result, "double_support_time_s").mean == pytest.approx(0.22)
    assert of(result, "double_support_percent").mean == pytest.approx(20.0)


def test_lengths_without_positions_are_none_with_a_reason():
    result = spatiotemporal(find_cycles(EVENTS))
    for name in ("speed_m_per_s", "stride_length_m", "step_length_m", "step_width_m"):
        assert result[name] is None
        assert "positions" in result.reasons[name]


def test_asymmetry_is_not_variability():
    result = spatiotemporal(find_cycles(EVENTS))
    step = of(result, "step_time_s")
    # Steps of 0.6 and 0.5 s that never vary: 100 (0.5 - 0.6) / 0.55.
    assert step.asymmetry_percent == pytest.approx(-18.1818, abs=1e-4)
    assert (step.variability, step.cv_percent) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert step.sd == pytest.approx(0.0547723, abs=1e-6)
    assert of(result, "stride_time_s").asymmetry_percent is None
    assert of(result, "cadence_steps_per_min").asymmetry_percent is None


def test_variability_is_the_mean_variance_of_the_sides():
    # Steps (landing left, right) in s: 0.60 0.50 0.62 0.50 0.58 0.54; first and last are dropped.
    times = np.cumsum([1.0, 0.5, 0.60, 0.50, 0.62, 0.50, 0.58, 0.54, 0.60]).tolist()
    result = spatiotemporal(find_cycles(steps([t - 0.5 for t in times])))
    step = of(result, "step_time_s")
    left, right = [0.60, 0.62, 0.58], [0.50, 0.50, 0.54]
    assert (step.left, step.right, step.n) == pytest.approx((0.6, np.mean(right), 6))
    # Variances (n - 1): left 0.0004, right 0.16 / 300 = 0.00053333; root of their mean.
    assert step.variability == pytest.approx(np.sqrt((0.0004 + 0.00053333) / 2), abs=1e-6)
    assert step.cv_percent == pytest.approx(100 * 0.0216025 / np.mean(left + right), abs=1e-3)
    one = spatiotemporal(find_cycles(EVENTS[:10]))
    assert of(one, "stride_time_s").variability is None


@pytest.mark.parametrize(
    ("n_downs", "found", "used"), [(0, 0, 0), (2, 0, 0), (3, 1, 0), (4, 2, 0), (5, 3, 1), (7, 5, 3)]
)
def test_counts_of_short_walks(n_downs, found, used):
    result = spatiotemporal(find_cycles(walk(DOWNS[:n_downs], {"left": 0.12, "right": 0.10})))
    assert (result.n_cycles_found, result.n_cycles_used) == (found, used)
    assert result.status == ("PASS" if used else "EMPTY")
    if not used:
        assert result.reason
        assert all(result[name] is None and result.reasons[name] for name in result.measures)
    if used == 1:
        assert of(result, "stride_time_s").sd is None


def test_a_laboratory_keeps_the_ends():
    cycles = find_cycles(EVENTS, keep_ends=True)
    assert [c.used for c in cycles] == [True] * 6
    # The rule of odd lengths holds all the same.
    late = [GaitEvent(e.time_s + (0.9 if e.time_s > 4.2 else 0), e.side, e.event, 1.0) for e in EVENTS]
    assert [c.used for c in find_cycles(late, keep_ends=True)] == [True, True, True, True, False, False]


def test_each_bout_loses_its_ends():
    second = walk([(t + 10, s) for t, s in DOWNS[:5]], {"left": 0.12, "right": 0.10}, bout=1)
    cycles = find_cycles([*EVENTS, *second])
    assert [c.used for c in cycles if c.bout == 1] == [False, True, False]
    assert not [c for c in cycles if c.stride_time_s > 2]


def test_a_cycle_without_its_inner_events_is_none():
    lost = [e for e in EVENTS if not (e.side == "right" and e.event == "foot_up" and 2.1 < e.time_s < 2.6)]
    starts = [c.start_s for c in find_cycles(lost)]
    assert 2.1 not in starts
    assert 1.5 not in starts  # its own toe-off is the one that is missing
    assert 2.6 in starts


def steps(times: list[float]) -> list[GaitEvent]:
    """A walk with initial contacts of alternate sides at these times."""
    return walk([(t, "left" if k % 2 == 0 else "right") for k, t in enumerate(times)], {"left": 0.11, "right": 0.11})


#: Twelve steps of 0.55 s (stride 1.10 s); the seventh comes one step later than it should.
LATE_STEP = [0.55 * k + (0.55 if k >= 6 else 0.0) for k in range(13)]


def walking_feet(downs: list[float]) -> FootTrajectories:
    """Feet of which one is furthest ahead at each of `downs`, left and right in turn."""
    time = np.arange(downs[0], downs[-1], 1 / 60)
    apart = np.cos(np.pi * np.interp(time, downs, np.arange(len(downs))))
    heel = np.zeros((len(time), 2, 3))
    heel[:, 0, 0], heel[:, 1, 0] = 0.3 * apart, -0.3 * apart
    ahead = np.tile([1.0, 0.0, 0.0], (len(time), 1))
    return FootTrajectories(
        time, heel, heel, np.tile([0, 0, 0.9], (len(time), 1)), ahead, np.array([0, 0, 1.0]), heel[:, :, 0], "markers"
    )


def cycles_with_feet(events: list[GaitEvent], feet: FootTrajectories) -> tuple[GaitCycle, ...]:
    curves = AngleSeries(feet.time_s, {"hip_flexion": feet.time_s}, {"hip_flexion": feet.time_s})
    return find_cycles(events, series=curves, feet=feet)


def test_a_long_stride_that_may_hold_a_missed_step_leaves_no_spread():
    cycles = find_cycles(steps(LATE_STEP))
    assert [round(c.stride_time_s, 2) for c in cycles if c.odd_length] == [1.65, 1.65]
    wanted = "1.50 times the typical stride, without feet that show whether a step was missed"
    assert {c.excluded for c in cycles if c.odd_length} == {wanted}
    result = spatiotemporal(cycles)
    assert (result.n_cycles_found, result.n_cycles_used) == (11, 7)
    assert of(result, "stride_time_s").mean == pytest.approx(1.10)
    assert of(result, "cadence_steps_per_min").mean == pytest.approx(60 / 0.55)
    assert of(result, "step_time_s").mean == pytest.approx(0.55)
    for name in ("stride_time_s", "cadence_steps_per_min", "double_support_percent"):
        measure = of(result, name)
        assert (measure.sd, measure.variability, measure.cv_percent, measure.interval) == (None, None, None, None)
    assert "2 cycles of odd length" in result.reasons["spread"]
    (check,) = (c for c in cycle_checks(result, cycles) if c.check == "cycles_of_odd_length")
    assert (check.outcome, check.value) == ("WARN", 2.0)
    assert "no spread" in check.advice


def test_a_true_long_stride_is_used_and_counts_in_the_spread():
    """The feet swing once in it: the person was slow."""
    cycles = cycles_with_feet(steps(LATE_STEP), walking_feet(LATE_STEP))
    assert not any(c.odd_length for c in cycles)
    result = spatiotemporal(cycles)
    assert result.n_cycles_used == 9
    stride = of(result, "stride_time_s")
    by_side = [[c.stride_time_s for c in cycles if c.used and c.side == side] for side in ("left", "right")]
    assert stride.variability == pytest.approx(np.sqrt(np.mean([np.var(x, ddof=1) for x in by_side])))
    assert not_none(stride.variability) > 0.2
    assert "spread" not in result.reasons


def test_a_missed_pair_of_steps_does_not_pass_as_a_long_stride():
    """The feet swing on where no event was found: the cycles are left out, and the spread of the others stands."""
    true = [0.55 * k for k in range(15)]
    cycles = cycles_with_feet(steps(true[:6] + true[8:]), walking_feet(true))
    assert [round(c.stride_time_s, 2) for c in cycles if c.odd_length] == [2.2, 2.2]
    assert {c.excluded for c in cycles if c.odd_length} == {"2.00 times the typical stride"}
    result = spatiotemporal(cycles)
    stride = of(result, "stride_time_s")
    assert (stride.mean, stride.sd) == pytest.approx((1.10, 0.0), abs=1e-9)
    (check,) = (c for c in cycle_checks(result, cycles) if c.check == "cycles_of_odd_length")
    assert (check.value, check.advice.startswith("a step was missed or invented")) == (2.0, True)


@pytest.mark.parametrize("behind_m", [0.0, 0.5])
def test_feet_pass_each_other_twice_in_a_stride(behind_m: float):
    """Also where one foot is always placed behind the other; None where they are not seen."""
    feet = walking_feet([0.55 * k for k in range(13)])
    feet.heel_m[:, 1, 0] -= behind_m
    rng = np.random.default_rng(0)
    feet.heel_m[:] += 0.01 * rng.standard_normal(feet.heel_m.shape)
    assert [foot_passes(feet, 0.55 * k, 0.55 * (k + 2)) for k in range(10)] == [2] * 10
    assert [foot_passes(feet, 0.55 * k, 0.55 * (k + 4)) for k in range(8)] == [4] * 8
    feet.heel_m[40:80] = np.nan
    assert foot_passes(feet, 0.55, 1.65) is None


def test_strides_that_vary_as_in_disease_are_all_used():
    rng = np.random.default_rng(4)
    times = np.cumsum(0.55 * (1 + 0.10 * rng.standard_normal(30)))
    cycles = find_cycles(steps(times.tolist()))
    assert not any(c.odd_length for c in cycles)


def test_a_slow_bout_is_compared_with_itself():
    slow = [GaitEvent(e.time_s * 2 + 20, e.side, e.event, 1.0, 1) for e in EVENTS]
    assert [c.used for c in find_cycles([*EVENTS, *slow]) if c.bout == 1] == [False, True, True, True, True, False]


def series(time: np.ndarray) -> AngleSeries:
    ramp = {"hip_flexion": 10.0 * time, "knee_flexion": 30 * np.sin(2 * np.pi * time)}
    return AngleSeries(time, {k: -v for k, v in ramp.items()}, ramp)


def test_curves_are_resampled_to_percent_of_the_cycle():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.02, 0.045, 200))
    curves, missing = cycle_curves(series(time), "right", 1.3, 2.4)
    assert missing == ""
    at = np.linspace(1.3, 2.4, 51)
    np.testing.assert_allclose(curves["hip_flexion"], 10 * at, atol=1e-9)
    np.testing.assert_allclose(curves["knee_flexion"], 30 * np.sin(2 * np.pi * at), atol=0.35)
    left, _ = cycle_curves(series(time), "left", 1.3, 2.4)
    np.testing.assert_allclose(left["hip_flexion"], -10 * at, atol=1e-9)


def test_missing_frames_give_no_curves():
    time = np.arange(100) / 30
    angles = series(time)
    angles.right["knee_flexion"][45:52] = np.nan
    assert cycle_curves(angles, "right", 1.3, 2.4)[1] == "frames are missing for more than 0.15 s"
    assert cycle_curves(angles, "right", 2.0, 3.0)[1] == ""
    assert "beyond" in cycle_curves(angles, "right", 2.5, 3.4)[1]


# --- Why a cycle is not used: facts, and the sentence made from them.


def cycle(exclusion: Exclusion) -> GaitCycle:
    return GaitCycle("t", 0, 0, "left", 0.0, 0.1, 0.5, 0.6, 1.0, exclusion=exclusion)


@pytest.mark.parametrize(
    ("exclusion", "text"),
    [
        (Exclusion(), ""),
        (Exclusion(first_step=True), "first step of the bout"),
        (
            Exclusion(last_step=True, length_ratio=1.5),
            "last step of the bout and 1.50 times the typical stride",
        ),
        (
            Exclusion(length_ratio=1.4, length_unproven=True),
            "1.40 times the typical stride, without feet that show whether a step was missed",
        ),
        (Exclusion(curve_distance_deg=24.6, n_curves=8), "25 deg from the median curves of 8 cycles"),
        (
            Exclusion(last_step=True, failed_checks=("cadence_plausible",)),
            "the cadence is unusual for walking, and no one has accepted it",
        ),
        (Exclusion(first_step=True, failed_checks=("scale", "jumps")), "the fit failed its check scale, jumps"),
    ],
)
def test_the_sentence_and_whether_the_cycle_counts(exclusion: Exclusion, text: str):
    assert cycle(exclusion).excluded == text
    assert cycle(exclusion).used == (text == "")


def test_each_reason_is_a_fact_of_its_own():
    """They were read out of the sentence: a check called "from the median curves" would have been odd curves."""
    found = cycle(Exclusion(failed_checks=("times the typical stride from the median curves",)))
    assert (found.odd_length, found.odd_curves, found.check_failed) == (False, False, True)
    found = cycle(Exclusion(length_ratio=0.5, curve_distance_deg=9.0, n_curves=6))
    assert (found.odd_length, found.odd_curves, found.check_failed) == (True, True, False)


# --- Which trials the measures of a session pool.


@pytest.mark.parametrize(
    ("activity", "pace", "pool"),
    [
        ("", "", "self_selected"),
        ("unknown", "unknown", "self_selected"),
        ("walking", "", "self_selected"),
        ("Overground walking", "Self-selected", "self_selected"),
        ("treadmill gait", "fast", "fast"),
        ("walking", "dual task", "dual_task"),
        ("TUG", "fast", ""),
        ("Sit-to-stand", "", ""),
        ("running", "fast", ""),
    ],
)
def test_what_is_pooled(activity: str, pace: str, pool: str):
    found = Condition(activity, pace)
    assert found.pool == pool
    assert [p for p in ("self_selected", "fast", "dual_task") if found.pooled(p)] == ([pool] if pool else [])
    assert found.pooled("any") == bool(pool)


def test_a_label_that_is_too_long():
    with pytest.raises(PblError, match="USAGE"):
        Condition("walking", "x" * 33)


@pytest.fixture(scope="module")
def trials():
    body = load_body()
    return [walking_fit(body.joint_names, body.sha256, name=n, n_frames=360) for n in ("a", "b", "c")]


def test_the_session_pools_walking_at_the_pace_of_the_method(trials: list):
    plain = gait_metrics(trials[:2])
    done = [Condition("walking"), Condition(), Condition("TUG")]
    mixed = gait_metrics(trials, conditions=done)
    assert [t.pooled for t in mixed.trials] == [True, True, False]
    assert mixed.spatiotemporal == plain.spatiotemporal
    assert (mixed.gdi, mixed.params_hash, len(mixed.cycles)) == (plain.gdi, plain.params_hash, len(plain.cycles))
    assert mixed.trials[2].gdi.mean is not None
    at_fast = dataclasses.replace(GDI_METHODS.find().params, pace="fast")
    fast = gait_metrics(trials, params=GaitParams(gdi=at_fast), conditions=[*done[:2], Condition("walking", "fast")])
    alone = gait_metrics(trials[2:], params=GaitParams(gdi=at_fast), conditions=[Condition(pace="fast")])
    assert fast.gdi.mean == alone.gdi.mean
    assert fast.spatiotemporal.n_cycles_used == alone.spatiotemporal.n_cycles_used > 0
    assert fast.params_hash != plain.params_hash


def test_no_trial_of_that_pace_says_which_there_are(trials: list):
    none = gait_metrics(trials[:2], conditions=[Condition("TUG"), Condition("walking", "fast")])
    assert (none.status, none.gdi.status, none.cycles) == ("EMPTY", "EMPTY", [])
    for reason in (none.reason, none.gdi.reason, none.spatiotemporal.reasons["cadence_steps_per_min"]):
        assert "'self_selected' (there are: tug; walking, fast)" in reason


@pytest.mark.parametrize("family", list(GDI_METHODS.families))
def test_a_method_of_ones_own_at_another_pace(trials: list, family: str):
    """Its row is read back, scores with the angles of its family, and its hash is the row's."""
    params = {"family": family, **GDI_METHODS[family].paramset.params, "pace": "any"}
    own = GDI_METHODS.of(Paramset("gdi", "any-pace", 1, params))
    p = own.paramset
    assert stored(stage="gdi", name=p.name, version=p.version, params=dict(p.params), sha=own.hash) == own
    assert own.params.pace == "any"
    done = gait_metrics(
        trials[:1], params=GaitParams(gdi=own.params), model=own, conditions=[Condition("walking", "fast")]
    )
    plain = gait_metrics(trials[:1], params=GaitParams(gdi=GDI_METHODS[family].params), model=family)
    assert (done.gdi.model, done.gdi.params_hash) == ("any-pace", own.hash)
    assert done.gdi.mean == plain.gdi.mean


def test_every_field_of_a_cycle_survives_its_row():
    """All off their defaults; curves and the model of their error are in a file, and the name of the trial is given."""
    why = Exclusion(True, True, 1.9, True, 24.5, 8, ("scale",))
    lengths = Lengths(1.2, 0.6, 0.1, "why", True)
    whole = GaitCycle("t", 3, 1, "right", 0.5, 0.6, 1.0, 1.1, 1.5, why, {}, "no curves", {}, lengths, far_leg="left")
    default = GaitCycle("t", 0, 0, "left", 0.0, 0.1, 0.5, 0.6, 1.0)
    for record, other in ((whole, default), (whole.exclusion, Exclusion()), (whole.lengths, Lengths())):
        same = [f.name for f in dataclasses.fields(record) if getattr(record, f.name) == getattr(other, f.name)]
        assert set(same) <= {"trial", "curves", "curves_sd", "angle_model", "error_model"}
    for c in (whole, default):
        assert gait.cycle_of_row(gait.row_of_cycle(c), "t") == c


def test_a_cycle_of_odd_length_in_a_row_of_before_may_be_one_stride():
    row = gait.row_of_cycle(cycle(Exclusion(length_ratio=1.9))) | {"cycle_length_unproven": None}
    assert gait.cycle_of_row(row, "t").exclusion == Exclusion(length_ratio=1.9, length_unproven=True)
