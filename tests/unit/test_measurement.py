"""The measurement model against closed forms, and the index that score_gdi makes of it."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from scipy.stats import norm as normal

from pbl_pipeline.fit import METHODS, default_fit
from pbl_pipeline.gait import (
    EVENT_METHODS,
    GDI_METHODS,
    GDI_MODEL,
    THREE_ANGLES,
    Z90,
    GaitCycle,
    Gdi,
    Lengths,
    Spatiotemporal,
    chances,
    change_sd,
    intervals_with_one_more,
    load_norm,
    score_gdi,
    spatiotemporal,
)
from pbl_pipeline.gait.measurement import (
    USUAL_CHANGE,
    MeasureError,
    MeasurementModel,
    Pass,
    Posterior,
    View,
    estimate,
    expected_index,
    load_model,
    measure_error,
    model_names,
    model_of_fit,
    with_one_more,
)
from pbl_pipeline.gait.metrics import with_errors
from pbl_pipeline.gait.metrics_file import load_curves, save_curves
from pbl_pipeline.keypoints import METHODS as KEYPOINTS
from tests import not_none

K = 2
NORM = load_norm()


#: Of the measures, by view.
ERRORS = {"left": {"stance_percent": MeasureError(3.0, 2.0, 1.0)}, "": {"stance_percent": MeasureError(1.0, 0.0, 4.0)}}


def toy_model(spread: float = 4.0, person: float = 0.5, view: float = 0.3, anew: float = 1.0) -> MeasurementModel:
    """Two scores a side whose errors are independent: each is a closed form of its own."""
    one = np.eye(2 * K)
    seen = View(np.full(2 * K, 0.7), one, view * one, anew * one)
    views = {"": seen, "left": seen, "right": seen}
    return MeasurementModel(
        "toy",
        "toy",
        (),
        np.full(2 * K, 3.0),
        spread * one,
        person * one,
        0.0 * one,
        views,
        np.eye(K),
        5.0,
        1.0,
        "events",
        8.0,
        ERRORS,
    )


def toy_pass(value: float, far_leg: str = "left", n: int = 5) -> Pass:
    return Pass((np.full(K, value), np.full(K, value)), (n, n), far_leg)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_passes_of_one_view_share_its_error_and_the_persons(n):
    """The mean of n passes errs by person + view + pass / n; of people of variance 4 a share 4 / (4 + that) counts."""
    found = estimate(toy_model(), [toy_pass(5.7 + i) for i in range(n)])
    error = 0.5 + 0.3 + 1.0 / n
    share = 4.0 / (4.0 + error)
    expected = 3.0 + share * (np.mean([5.7 + i for i in range(n)]) - 0.7 - 3.0)
    np.testing.assert_allclose(found.mean, expected)
    np.testing.assert_allclose(found.covariance, (1 - share) * 4.0 * np.eye(2 * K), atol=1e-12)
    np.testing.assert_allclose(found.anew, share**2 * 1.0 / n * np.eye(2 * K), atol=1e-12)


def test_passes_of_two_views_halve_the_error_of_a_view():
    found = estimate(toy_model(), [toy_pass(5.0, "left"), toy_pass(5.0, "right")])
    error = 0.5 + (0.3 + 1.0) / 2
    np.testing.assert_allclose(found.covariance, 4.0 * error / (4.0 + error) * np.eye(2 * K), atol=1e-12)


def test_passes_fitted_together_share_the_error_of_their_body_until_the_next_visit():
    model = dataclasses.replace(toy_model(), visit=0.4 * np.eye(2 * K))
    found, error = estimate(model, [toy_pass(5.0, "left"), toy_pass(5.0, "right")]), 0.5 + 0.4 + (0.3 + 1.0) / 2
    share = 4.0 / (4.0 + error)
    np.testing.assert_allclose(found.covariance, (1 - share) * 4.0 * np.eye(2 * K), atol=1e-12)
    np.testing.assert_allclose(found.anew, share**2 * (0.4 + 0.5) * np.eye(2 * K), atol=1e-12)


def test_fewer_cycles_than_measured_add_their_chance():
    found = estimate(toy_model(), [toy_pass(5.0, n=1)])
    error = 0.5 + 0.3 + 1.0 + (1.0 - 1.0 / 5.0)
    np.testing.assert_allclose(found.covariance, 4.0 * error / (4.0 + error) * np.eye(2 * K), atol=1e-12)


def test_a_side_that_was_not_seen_stays_as_people_are():
    seen = Pass((np.full(K, 5.0), np.full(K, np.nan)), (5, 0), "left")
    found = estimate(toy_model(), [seen])
    np.testing.assert_allclose(found.mean[K:], 3.0)
    np.testing.assert_allclose(np.diag(found.covariance)[K:], 4.0)


def test_a_gain_is_undone():
    model = toy_model(spread=1e6, person=0.0, view=0.0)
    half = dataclasses.replace(model.views["left"], gain=0.5 * np.eye(2 * K))
    found = estimate(dataclasses.replace(model, views=model.views | {"left": half}), [toy_pass(3.7 + 1.0)])
    np.testing.assert_allclose(found.mean, 3.0 + 2.0, rtol=1e-4)


def test_scores_without_an_error_have_their_own_index():
    scores = np.random.default_rng(2).normal(0, 20, 2 * len(NORM.components))
    none = np.zeros((len(scores), len(scores)))
    found = expected_index(Posterior(scores, none, none), NORM)
    vectors = scores.reshape(2, -1) @ NORM.components + NORM.mean_deg
    assert (found.left, found.right) == pytest.approx(NORM.index(vectors))
    assert found.mean == pytest.approx(np.mean(NORM.index(vectors)))
    assert (found.sd, found.sd_anew) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_the_expected_index_is_the_mean_over_the_error():
    """Against 200,000 other draws."""
    rng = np.random.default_rng(5)
    size = 2 * len(NORM.components)
    mean, root = rng.normal(0, 15, size), 8.0 * np.eye(size)
    found = expected_index(Posterior(mean, root @ root.T, 0 * root), NORM)
    draws = (mean + rng.standard_normal((200_000, size)) @ root.T).reshape(-1, 2, size // 2)
    index = 100 - 10 * (np.log(np.linalg.norm(draws, axis=-1)) - NORM.ln_mean) / NORM.ln_sd
    assert found.mean == pytest.approx(index.mean(), abs=0.1)
    assert found.sd == pytest.approx(index.mean(axis=1).std(), rel=0.1)


@pytest.mark.parametrize("name", model_names())
def test_a_model_that_ships_is_one_of_covariances_and_mirrored(name):
    model = load_model(name)
    assert model.norm == NORM.name
    for matrix in (model.spread, model.person, *(m for v in model.views.values() for m in (v.view, v.anew))):
        np.testing.assert_allclose(matrix, matrix.T, atol=0.02 * np.abs(matrix).max())
        assert np.linalg.eigvalsh(matrix).min() > -0.01 * np.abs(matrix).max()
    half = len(model.mean) // 2
    np.testing.assert_array_equal(model.views["right"].bias, np.roll(model.views["left"].bias, half))
    np.testing.assert_array_equal(model.views["right"].mirrored().gain, model.views["left"].gain)
    assert 1.0 <= model.widening < 1.5


def test_the_default_fit_of_a_phone_has_a_measured_model():
    """Another version of the fit errs otherwise: measure it (`python -m research.corpus.passes`, `.measurement`)."""
    fit = METHODS[default_fit(("blazepose_33", True))].hash
    for name in ("blazepose-heavy", "blazepose-33"):
        assert model_of_fit(fit, KEYPOINTS[name].params.confidence_curve) == "blazepose-heat-maps"
    for curve in ("blazepose-heavy-v3", ""):  # of points as regressed; of files that do not say
        assert model_of_fit(fit, curve) == "blazepose-33"
    assert model_of_fit("another", "blazepose-heavy-v4") == ""
    earlier = next(h for h in load_model("blazepose-33").fits if h != fit)
    assert model_of_fit(earlier, "blazepose-heavy-v4") == ""  # that fit was not measured with these points


def errors(index: Gdi) -> tuple[float, float]:
    """Its standard deviation and its minimal change."""
    return not_none(index.sd), not_none(index.minimal_change)


def walk(rng: np.random.Generator, far_leg: str, trial: str = "a", model: str = "blazepose-33") -> list[GaitCycle]:
    """Five cycles of each side about a fixed deviation from the norm."""
    true = NORM.mean_deg + 12.0 * NORM.components[0] + 5.0 * NORM.components[1]
    cycles = []
    for i in range(10):
        curves = np.split(true + rng.normal(0, 1.0, len(true)), 3)
        deg = {n: np.append(v, v[0]) for n, v in zip(THREE_ANGLES, curves, strict=True)}
        sd = {n: np.full(51, 6.0) for n in deg}
        cycles.append(
            GaitCycle(
                trial, i, 0, ("left", "right")[i % 2], 0.0, 0.1, 0.5, 0.6, 1.0,
                curves=deg, curves_sd=sd, far_leg=far_leg, error_model=model,
            )
        )  # fmt: skip
    return cycles


def test_the_interval_shrinks_with_passes_and_differs_by_view():
    rng = np.random.default_rng(1)
    side, front = score_gdi(walk(rng, "left")), score_gdi(walk(rng, ""))
    both = score_gdi(walk(rng, "left", "a") + walk(rng, "right", "b"))
    four = score_gdi([c for i, leg in enumerate(["left", "right"] * 2) for c in walk(rng, leg, f"{i}")])
    sd, least = zip(*(errors(g) for g in (four, both, side, front)), strict=True)
    assert sd[:3] == tuple(sorted(sd[:3]))
    assert sd[1] < sd[3]
    assert least[:3] == tuple(sorted(least[:3]))


def test_left_and_right_are_alike():
    cycles = walk(np.random.default_rng(1), "left")
    other = {"left": "right", "right": "left"}
    mirrored = [dataclasses.replace(c, side=other[c.side], far_leg=other[c.far_leg]) for c in cycles]
    one, two = score_gdi(cycles), score_gdi(mirrored)
    # The draws are not mirrored with them.
    assert (one.left, one.right) == pytest.approx((two.right, two.left), abs=0.5)


def test_what_one_more_pass_brings_is_what_it_brought():
    rng = np.random.default_rng(1)
    cycles = walk(rng, "left")
    index = score_gdi(cycles)
    after = intervals_with_one_more(cycles, index)
    then = score_gdi(cycles + walk(rng, "right", "b"))  # filmed from the left
    assert after["left"] == pytest.approx(Z90 * errors(then)[0], rel=0.1)
    assert all(half < Z90 * errors(index)[0] for half in after.values())
    assert intervals_with_one_more(cycles[:-2], index) == {}
    other = walk(rng, "left", model="")
    assert intervals_with_one_more(other, score_gdi(other)) == {}


def test_without_a_measured_model_the_curves_are_averaged():
    rng = np.random.default_rng(1)
    cycles = walk(rng, "left", model="")
    plain = score_gdi(cycles, params=dataclasses.replace(GDI_METHODS[GDI_MODEL].params, average="curves"))
    assert (plain.mean, plain.sd) == (score_gdi(cycles).mean, score_gdi(cycles).sd)
    mixed = cycles[:5] + walk(rng, "left")[5:]
    assert score_gdi(mixed).sd == score_gdi([dataclasses.replace(c, error_model="") for c in mixed]).sd


def test_the_model_of_the_error_lies_with_the_curves(tmp_path):
    cycles = walk(np.random.default_rng(1), "left")
    save_curves(cycles, tmp_path / "w.cycles.npz")
    assert {c.error_model for c in load_curves(tmp_path / "w.cycles.npz").values()} == {"blazepose-33"}


def test_the_interval_holds_nine_of_ten_of_the_models_own_people():
    """Scores and passes drawn from the model itself: the interval before widening is that of the model."""
    model = dataclasses.replace(load_model("blazepose-33"), widening=1.0)
    rng = np.random.default_rng(4)
    inside, n, far, cycles = 0, 300, ["left", "right"], round(model.n_cycles)
    passes: list[Pass] = []
    draw = functools.partial(rng.multivariate_normal, method="eigh", check_valid="ignore")  # of rounded covariances
    for _ in range(n):
        true = draw(model.mean, model.spread)
        person = draw(0 * model.mean, model.person)
        passes.clear()
        for leg in far:
            view = model.views[leg]
            y = model.mean + view.bias + view.gain @ (true - model.mean) + person
            y = y + draw(0 * y, view.view + view.anew)
            passes.append(Pass((y[:9], y[9:]), (cycles, cycles), leg))
        found = expected_index(estimate(model, passes), NORM)
        distance = np.linalg.norm(true.reshape(2, -1), axis=1)
        index = np.mean(100 - 10 * (np.log(distance) - NORM.ln_mean) / NORM.ln_sd)
        inside += abs(index - found.mean) <= normal.isf(0.05) * found.sd
    assert inside / n == pytest.approx(0.9, abs=0.05)
    assert with_one_more(model, passes, NORM)["left"] < expected_index(estimate(model, passes), NORM).sd


@pytest.mark.parametrize(
    ("n", "own", "spread"),
    [
        (8, None, 8.0 * 8.5 + 1.2**2),
        (32, 3.0, 8.0 * 8.5 + 1.2**2),  # less than is usual, which by chance a few cycles are
        (8, 10.0, 0.5 * (8.0 * 8.5 + 1.2**2) + 0.5 * 10.0**2),
    ],
)
def test_the_error_of_a_measure_by_the_number_and_spread_of_cycles(n, own, spread):
    """Mean squares over the views: 5 lasts, 2 is of the visit, 8.5 new in a pass of 8 cycles."""
    found = measure_error(toy_model(), "stance_percent", n, own, 6)
    assert found == pytest.approx((np.sqrt(5.0 + 2.0 + spread / n), np.sqrt(2.0 + spread / n)))
    assert measure_error(toy_model(), "step_width_m", n) is None


@pytest.mark.parametrize("by", [-7.0, 7.0])
def test_probabilities_of_a_change_are_those_of_a_normal_error(by):
    assert change_sd((normal.ppf(0.95) * np.sqrt(2.0) * 3.0,) * 2, (3.0, 3.0)) == pytest.approx(
        np.sqrt(18.0)
    )  # all is anew
    sd = change_sd((normal.ppf(0.95) * np.sqrt(2.0) * 3.0,) * 2, (5.0, 5.0))
    assert sd == pytest.approx(np.sqrt(18.0 + 0.3 * (50.0 - 18.0)))
    assert chances(by, sd).real == pytest.approx(normal.cdf(7.0 / sd))
    assert chances(by, sd).important is None


@pytest.mark.parametrize(("by", "sd"), [(-7.0, 5.0), (3.0, 6.0), (40.0, 2.0), (1.0, 30.0)])
def test_probabilities_of_a_change_of_the_index_weigh_the_usual_changes(by, sd):
    """By numerical integration of Bayes' theorem; large changes are taken as they are."""
    true = np.linspace(-200.0, 200.0, 400_001)
    weight = np.exp(-np.abs(true) / USUAL_CHANGE) * normal.pdf(by, true, sd)
    same = true * np.sign(by)
    found = chances(by, sd, 5.0)
    assert found.real == pytest.approx(weight[same > 0].sum() / weight.sum(), abs=1e-4)
    assert found.important == pytest.approx(weight[same > 5.0].sum() / weight.sum(), abs=1e-4)
    assert chances(0.0, sd, 5.0).real == pytest.approx(0.5)


def test_probabilities_of_the_index_hold_among_changes_that_were_drawn():
    """Many small changes and few large ones: of those called important with 0.65 to 0.8 so many are; a prior that takes
    all changes as equally likely would state 0.1 more."""
    rng = np.random.default_rng(3)
    true, sd = rng.laplace(0.0, USUAL_CHANGE, 40_000), 6.0
    found = true + rng.normal(0.0, sd, len(true))
    said = np.array([chances(by, sd, 5.0) for by in found], float)
    real = true * np.sign(found)
    for column, limit in ((0, 0.0), (1, 5.0)):
        for low, high in itertools.pairwise((0.05, 0.2, 0.5, 0.65, 0.8, 0.9, 0.95, 1.01)):
            inside = (said[:, column] >= low) & (said[:, column] < high)
            if inside.sum() > 500:
                assert (real[inside] > limit).mean() == pytest.approx(said[inside, column].mean(), abs=0.03)


def measured(far_leg: str = "right", error_model: str = "blazepose-33", metric: bool = False) -> Spatiotemporal:
    lengths = Lengths(1.2, 0.6, None, "", metric)
    about = {"lengths": lengths, "far_leg": far_leg, "error_model": error_model}
    sides = ("left", "right")
    cycles = [
        GaitCycle("t", i, 0, sides[i % 2], i, i + 0.1, i + 0.5, i + 0.6, i + 1.0 + 0.01 * (i % 4), **about)
        for i in range(8)
    ]
    return with_errors(spatiotemporal(cycles), cycles, EVENT_METHODS.find().paramset)


def error_sd(found: Spatiotemporal, name: str) -> float | None:
    return not_none(found[name]).error_sd


def test_measures_of_a_visit_state_their_error():
    model, found = load_model("blazepose-33"), measured()
    stance = not_none(found["stance_percent"])
    assert stance.error_sd is not None
    sd, anew = not_none(measure_error(model, "stance_percent", 8, stance.variability, 6))
    assert stance.error_sd == pytest.approx(sd)
    assert stance.minimal_change == pytest.approx(Z90 * np.sqrt(2) * anew, rel=1e-4)
    assert stance.interval == pytest.approx((stance.mean - Z90 * stance.error_sd, stance.mean + Z90 * stance.error_sd))
    assert error_sd(found, "speed_m_per_s") == pytest.approx(0.08, abs=0.02)


def test_measures_without_a_measured_error_state_none():
    assert error_sd(measured(error_model=""), "stance_percent") is None
    stated = measured(metric=True)
    assert error_sd(stated, "speed_m_per_s") is None  # the metres are not the detector's
    assert error_sd(stated, "cadence_steps_per_min") is not None
    cycles = [GaitCycle("t", 0, 0, "left", 0, 0.1, 0.5, 0.6, 1.0, error_model="blazepose-33")]
    zeni = EVENT_METHODS.find("zeni-2008").paramset
    assert error_sd(with_errors(spatiotemporal(cycles), cycles, zeni), "stance_percent") is None
