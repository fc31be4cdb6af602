"""GDI of three angles against numpy worked another way, and the normative set that ships."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.io import loadmat

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    NINE_ANGLES,
    NUMBERS,
    THREE_ANGLES,
    Exclusion,
    GaitCycle,
    GdiParams,
    NormativeSet,
    fit_norm,
    interval_90,
    load_norm,
    norm_names,
    score_gdi,
)
from pbl_pipeline.gait.normative.norm import _checksum, _to_json
from pbl_pipeline.stats import minimal_detectable_change
from tests import not_none

PERCENT = np.linspace(0, 98, 50)
ABOUT = {"name": "toy", "version": 1, "source": "made up", "licence": "none", "convention": "none"}


def toy_vectors(n: int = 80, seed: int = 3) -> np.ndarray:
    """Smooth random curves of three angles."""
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * PERCENT / 100
    basis = np.stack([np.ones(50), np.cos(phase), np.sin(phase), np.cos(2 * phase), np.sin(2 * phase)])
    weights = rng.standard_normal((n, 3, 5)) * np.array([6, 4, 3, 2, 1.0])
    return (weights @ basis).reshape(n, 150) + np.repeat([20.0, 0.0, 25.0], 50) + 0.2 * rng.standard_normal((n, 150))


def cycle(vector: np.ndarray, side: str = "left", number: int = 0, **changes) -> GaitCycle:
    curves = {n: np.append(v, v[0]) for n, v in zip(THREE_ANGLES, np.split(vector, 3), strict=True)}
    made = GaitCycle("t", number, 0, side, 0.0, 0.1, 0.5, 0.6, 1.0, curves=curves)
    return dataclasses.replace(made, **changes)


def index_another_way(norm_vectors: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Eigenvectors of the covariance matrix, distances in the original space after projection."""
    mean = norm_vectors.mean(axis=0)
    values, eigen = np.linalg.eigh(np.cov(norm_vectors.T))
    order = np.argsort(values)[::-1]
    share = np.cumsum(values[order]) / values.sum()
    keep = eigen[:, order[: np.flatnonzero(share >= 0.95)[0] + 1]]
    projector = keep @ keep.T

    def ln_distance(x):
        return np.log(np.sqrt((((x - mean) @ projector) ** 2).sum(axis=1)))

    of_norm = ln_distance(norm_vectors)
    z = (ln_distance(vectors) - of_norm.sum() / len(of_norm)) / np.sqrt(
        np.var(of_norm) * len(of_norm) / (len(of_norm) - 1)
    )
    return 100 - 10 * z


@pytest.fixture(scope="module")
def toy():
    return fit_norm(toy_vectors(), variables=THREE_ANGLES, percent=PERCENT, **ABOUT)


def test_against_plain_numpy(toy):
    others = toy_vectors(20, seed=9) + 5.0
    expected = index_another_way(toy_vectors(), others)
    np.testing.assert_allclose(toy.index(others), expected, rtol=0, atol=1e-8)
    cycles = [cycle(v, ("left", "right")[i % 2], i) for i, v in enumerate(others)]
    result = score_gdi(cycles, toy, GdiParams(average="cycles"))
    np.testing.assert_allclose([c.gdi for c in result.cycles], expected, atol=1e-8)
    assert result.left == pytest.approx(expected[::2].mean())
    assert result.right == pytest.approx(expected[1::2].mean())
    assert (result.mean, result.n, result.status) == (pytest.approx(expected.mean()), 20, "PASS")
    assert [c.z for c in result.cycles] == pytest.approx((100 - expected) / 10)
    # The default: each side's mean curves, 14 cycles of the left and 6 of the right here, which count alike.
    cycles = [cycle(v, ("left", "right")[i >= 14], i) for i, v in enumerate(others)]
    sides = index_another_way(toy_vectors(), np.array([others[:14].mean(axis=0), others[14:].mean(axis=0)]))
    result = score_gdi(cycles, toy)
    np.testing.assert_allclose([c.gdi for c in result.cycles], expected, atol=1e-8)
    assert (result.left, result.right, result.mean) == pytest.approx((*sides, sides.mean()))


def test_chance_in_the_cycles_lowers_the_mean_of_their_indices(toy):
    rng = np.random.default_rng(3)
    person = toy.mean_deg + 60 * toy.components[0]
    chance = 15 * rng.standard_normal((20, len(toy.components))) @ toy.components
    chance = np.concatenate([chance, -chance])  # nothing is left of it in a mean
    cycles = [cycle(person + e, ("left", "right")[i % 2], i) for i, e in enumerate(chance)]
    true = float(toy.index(person)[0])
    of_curves, of_cycles = (score_gdi(cycles, toy, GdiParams(average=a)) for a in ("curves", "cycles"))
    assert of_curves.mean == pytest.approx(true)
    assert of_cycles.mean == pytest.approx(np.mean([c.gdi for c in of_cycles.cycles]))
    assert np.mean([c.gdi for c in of_curves.cycles]) < true - 3.0


def test_the_normative_vectors_average_100_with_sd_10(toy):
    scores = toy.index(toy_vectors())
    assert scores.mean() == pytest.approx(100, abs=1e-9)
    assert scores.std(ddof=1) == pytest.approx(10, abs=1e-9)


def test_components(toy):
    np.testing.assert_allclose(toy.components @ toy.components.T, np.eye(len(toy.components)), atol=1e-12)
    assert np.all(np.diff(toy.explained_variance) < 0)
    assert toy.explained_share >= 0.95
    largest = np.abs(toy.components).argmax(axis=1)
    assert np.all(toy.components[np.arange(len(largest)), largest] > 0)


def test_a_cycle_further_away_scores_less(toy):
    away = [toy.mean_deg + k * 10 * toy.components[0] for k in (1, 2, 4, 8)]
    assert np.all(np.diff(toy.index(np.array(away))) < 0)
    # Twice the distance adds ln 2 to the log distance.
    assert np.diff(toy.index(np.array(away))) == pytest.approx([-10 * np.log(2) / toy.ln_sd] * 3)


def test_deviation_outside_the_components_is_told(toy):
    rng = np.random.default_rng(0)
    odd = rng.standard_normal(150)
    odd -= toy.components.T @ (toy.components @ odd)
    inside = cycle(toy.mean_deg + 20 * toy.components[1])
    outside = cycle(toy.mean_deg + toy.components[1] + 10 * odd, "right")
    result = score_gdi([inside, outside], toy)
    assert result.cycles[0].explained == pytest.approx(1.0)
    assert result.cycles[1].explained < 0.01
    both = score_gdi([outside, cycle(toy.mean_deg + toy.components[1] + 10 * odd)], toy)
    assert next(c for c in both.qc if c.check == "gdi_explained").outcome == "WARN"


def test_unused_cycles_do_not_count(toy):
    good, bad = toy.mean_deg + 10 * toy.components[0], toy.mean_deg + 90 * toy.components[0]
    result = score_gdi(
        [cycle(good), cycle(good, "right", 1), cycle(bad, "right", 2, exclusion=Exclusion(first_step=True))], toy
    )
    assert result.n == 2
    assert result.mean == pytest.approx(toy.index(good)[0])


@pytest.mark.parametrize("average", ["cycles", "curves"])
def test_the_index_is_as_unsure_as_its_angles_and_its_cycles(toy, average):
    # Small errors, so that the index changes by as much in both directions.
    vectors = toy_vectors(1, seed=9) + 5.0 + 0.01 * (toy_vectors(6, seed=8) - toy.mean_deg)
    sd = dict(zip(THREE_ANGLES, (0.03, 0.01, 0.02), strict=True))
    cycles = [
        cycle(v, ("left", "right")[i % 2], i, curves_sd={k: np.full(51, s) for k, s in sd.items()})
        for i, v in enumerate(vectors)
    ]
    params = GdiParams(average=average)

    def index(x):
        return (
            toy.index(x).mean()
            if average == "cycles"
            else toy.index(np.array([x[::2].mean(0), x[1::2].mean(0)])).mean()
        )

    result = score_gdi(cycles, toy, params)
    assert result.mean == pytest.approx(index(vectors))
    # What all cycles have wrong alike, an angle at a time; and what differs from cycle to cycle.
    step = 1e-3
    moved = [(index(vectors + step * np.repeat(np.eye(3)[k], 50)) - result.mean) / step for k in range(3)]
    fit = float(np.sum((np.array(moved) * list(sd.values())) ** 2))
    walk = np.var([c.gdi for c in result.cycles], ddof=1) / 6
    if average == "curves":
        # What a cycle changes the index by, to first order: the variance of the mean of three follows.
        each = np.array([(index(vectors + (np.arange(6) == i)[:, None] * step * (v - vectors[i % 2 :: 2].mean(0)))
                          - result.mean) / step for i, v in enumerate(vectors)])  # fmt: skip
        walk = sum(np.sum(each[i::2] ** 2) * 3 / 2 for i in range(2))
    assert result.sd == pytest.approx(np.sqrt(fit + walk), rel=1e-3)
    assert result.mean is not None
    half = 1.645 * float(np.sqrt(fit + walk))
    assert result.interval == pytest.approx((result.mean - half, result.mean + half), rel=1e-3)
    least = minimal_detectable_change(float(np.sqrt(0.25 * fit + walk)), 0.9)
    assert result.minimal_change == pytest.approx(least, rel=1e-3)
    content = result.to_dict()
    assert content["interval"] == pytest.approx(result.interval, abs=2e-3)
    # A reader of the file gets it again from the mean and sd beside it, which are rounded.
    assert content["interval"] == pytest.approx(interval_90(content["mean"], content["sd"]), abs=6e-4)
    # Where the fit does not know how sure it is, the index does not either.
    unknown = score_gdi([dataclasses.replace(c, curves_sd={}) if c.number == 0 else c for c in cycles], toy, params)
    assert (unknown.mean, unknown.sd, unknown.interval, unknown.minimal_change) == (result.mean, None, None, None)


def test_errors_that_pass_or_differ_between_the_sides_make_the_mean_surer(toy):
    person = toy.mean_deg + 5.0
    sd = {v: np.full(51, 0.01) for v in THREE_ANGLES}
    both = [cycle(person, side, curves_sd=sd) for side in ("left", "right")]

    def variance(cycles, **params):
        before = GdiParams(average="curves", min_cycles_per_side=0)
        after, all_of_it = (
            not_none(score_gdi(cycles, toy, p).sd) for p in (dataclasses.replace(before, **params), before)
        )
        return (after / all_of_it) ** 2

    assert variance(both, lasting=0.75) == pytest.approx(0.75)
    assert variance(both, both_sides=0.0) == pytest.approx(0.5)
    assert variance(both, both_sides=0.25) == pytest.approx(0.625)
    # One side alone has nobody to differ from.
    one = [cycle(person, "left", curves_sd=sd)]
    assert variance(one, both_sides=0.0) == pytest.approx(1.0)


def test_what_errors_lengthen_is_taken_back_from_the_distance(toy):
    person = toy.mean_deg + 5.0
    sd = dict(zip(THREE_ANGLES, (3.0, 1.0, 2.0), strict=True))
    squares = np.sum((toy.components @ (person - toy.mean_deg)) ** 2)
    variance = sum(np.sum((toy.components @ np.repeat(np.eye(3)[k] * s, 50)) ** 2) for k, s in enumerate(sd.values()))

    def index(lengthening, times=1.0, known=True):
        curves_sd = {v: np.full(51, s * times) for v, s in sd.items()} if known else {}
        both = [cycle(person, side, curves_sd=curves_sd) for side in ("left", "right")]
        return score_gdi(both, toy, GdiParams(average="curves", lengthening=lengthening))

    plain, ten = index(0.0), 10.0 / toy.ln_sd
    assert plain.mean == pytest.approx(toy.index(person)[0])
    shorter = squares**2 / (squares + 0.2 * variance)
    assert index(0.2).mean == pytest.approx(plain.mean + 0.5 * ten * np.log(squares / shorter))
    # Small errors leave it as it is; large ones leave a third of the squared distance that was found.
    assert index(0.2, times=1e-3).mean == pytest.approx(plain.mean, abs=1e-4)
    assert index(0.2, times=1e3).mean == pytest.approx(plain.mean + 0.5 * ten * np.log(3.0))
    # A shorter distance is changed by more by the same error.
    more, before = not_none(index(0.2).sd), not_none(plain.sd)
    assert more > before
    # A fit that does not know how sure it is has the index as it is; so has one that is infinitely unsure.
    for unknown in (index(0.2, known=False), index(0.2, times=np.inf)):
        assert (unknown.mean, unknown.sd) == (pytest.approx(plain.mean), None)


def test_near_the_norm_an_error_has_two_directions(toy):
    person = toy.mean_deg + 1e-6 * toy.components[0]
    sd = {v: np.full(51, s) for v, s in zip(THREE_ANGLES, (3.0, 0.0, 0.0), strict=True)}
    result = score_gdi([cycle(person, side, curves_sd=sd) for side in ("left", "right")], toy, GdiParams())
    error = 3.0 * np.repeat([1.0, 0.0, 0.0], 50)
    down = toy.index(np.array([person + error, person - error])) - toy.index(person)[0]
    assert result.sd == pytest.approx(np.sqrt(np.mean(down**2)))
    assert np.all(down < 0)


@pytest.mark.parametrize("n_left", [0, 2])
def test_too_few_cycles_give_none_with_a_reason(toy, n_left):
    result = score_gdi([cycle(toy.mean_deg + 1.0, number=i) for i in range(n_left)], toy)
    assert (result.status, result.mean, result.left) == ("EMPTY", None, None)
    assert f"{n_left} left and 0 right" in result.reason
    # The reason asks for as many cycles as the check does.
    (check,) = [c for c in result.qc if c.check == "gdi_cycles"]
    assert f"needs {check.threshold:g} complete gait cycles with curves, 1 or more on each side" in result.reason
    none = dict.fromkeys((*NUMBERS, "interval"))
    counted = {"n": n_left, "n_left": n_left, "n_right": 0, "norm": "toy", "params_hash": result.params_hash}
    assert result.to_dict() == {**none, **counted, "cycles": [dataclasses.asdict(c) for c in result.cycles]}
    assert [(c.number, c.side) for c in result.cycles] == [(i, "left") for i in range(n_left)]


def test_cycles_without_curves_are_named(toy):
    bare = cycle(toy.mean_deg, curves={}, curves_missing="frames are missing for more than 0.15 s")
    assert "frames are missing" in score_gdi([bare], toy).reason


def test_norms_of_another_convention_are_warned_of(toy):
    # The toy norm is of a laboratory's model, the cycles of the fitted body.
    result = score_gdi([cycle(toy.mean_deg + 3), cycle(toy.mean_deg + 3, "right")], toy)
    checks = {c.check: c for c in result.qc}
    assert checks["norm_convention"].outcome == "WARN"
    assert checks["gdi_cycles"].outcome == "WARN"
    assert score_gdi([], toy, GdiParams(min_cycles_per_side=3)).params_hash != result.params_hash


def test_bad_norms(toy):
    wrong = [
        toy_vectors(10),
        toy_vectors()[:, :149],
        np.full((40, 150), 20.0),
        np.where(np.eye(80, 150), np.nan, toy_vectors()),
    ]
    for vectors in wrong:
        with pytest.raises(PblError, match="NORM_INVALID"):
            fit_norm(vectors, variables=THREE_ANGLES, percent=PERCENT, **ABOUT)
    with pytest.raises(PblError, match="NORM_UNKNOWN"):
        load_norm("gillette")
    with pytest.raises(PblError, match="NORM_UNKNOWN"):
        load_norm("absent.json")


def test_a_changed_file_is_refused(toy, tmp_path):
    path = tmp_path / "toy.json"
    toy.save(path)
    again = load_norm(str(path))
    np.testing.assert_allclose(again.index(toy_vectors()), toy.index(toy_vectors()), atol=1e-4)
    data = json.loads(path.read_text())
    data["ln_sd"] *= 1.01
    path.write_text(json.dumps(data))
    with pytest.raises(PblError, match="NORM_INVALID"):
        load_norm(str(path))
    path.write_text("{}")
    with pytest.raises(PblError, match="NORM_INVALID"):
        load_norm(str(path))


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({"n": 5}, "NORM_INVALID", "5 vectors"),
        ({"n": 31, "repeat": 4}, "NORM_INVALID", "components"),
        ({"radians": ["mean_deg"]}, "ANGLE_UNITS", "radians"),
        ({"ln_sd": 0.0}, "NORM_INVALID", "spread"),
        ({"angle_model": "another"}, "NORM_INVALID", "another"),
        ({"curves": 3}, "NORM_INVALID", ""),
        ({"curves": {"a": {"percent": [0.0], "mean_deg": [0.0, 1.0], "sd_deg": [1.0]}}}, "NORM_INVALID", ""),
        ({"ln_mean": [0.0] * 9}, "NORM_INVALID", "ln_mean"),
        ({"name": 3}, "NORM_INVALID", "name"),
        ({"percent": 3.0}, "NORM_INVALID", ""),
        ({"explained_variance": [1.0]}, "NORM_INVALID", "sizes"),
    ],
)
def test_a_set_by_another_program_is_looked_at(toy, tmp_path, changes, code, words):
    """Its checksum is right, its content is not: too few people for its components, another unit, numbers missing."""
    changes = dict(changes)
    fields = {f.name: getattr(toy, f.name) for f in dataclasses.fields(toy)}
    for name in changes.pop("radians", ()):
        fields[name] = np.radians(fields[name])
    if times := changes.pop("repeat", 0):
        fields |= {k: np.repeat(fields[k], times, axis=0) for k in ("components", "explained_variance")}
    path = tmp_path / "set.json"
    data = _to_json(NormativeSet(**fields), None) | changes
    path.write_text(json.dumps({**data, "sha256": _checksum(data)}))
    with pytest.raises(PblError, match=code) as error:
        load_norm(str(path))
    assert words in error.value.found


def test_the_set_that_ships():
    norm = load_norm("gillette-166-three-angles")
    assert set(norm_names()) == {"gillette-166-three-angles", "gillette-166-body-angles", "gillette-166-nine-angles"}
    assert (norm.n, norm.variables, norm.components.shape[1]) == (166, THREE_ANGLES, 150)
    assert set(norm.curves) == set(NINE_ANGLES)
    assert all(band["mean_deg"].shape == (51,) for band in norm.curves.values())
    # Signs of normal walking: knee bends most in swing, hip extends before toe-off, adducts in early stance.
    knee, hip, adduction = (norm.curves[n]["mean_deg"] for n in ("knee_flexion", "hip_flexion", "hip_adduction"))
    assert 55 < knee.max() < 65
    assert 68 <= 2 * knee.argmax() <= 78
    assert 48 <= 2 * hip.argmin() <= 58
    assert adduction[5:15].mean() > 3 > adduction[35]
    np.testing.assert_allclose(np.concatenate([hip[:50], adduction[:50], knee[:50]]), norm.mean_deg, atol=1e-5)


def test_the_arithmetic_reproduces_the_original_index(shared_data, toy):
    """With the published 15 features of nine angles in place of our components: the known log distance."""
    data = loadmat(shared_data / "real" / "gdi_gillette" / "GDI_Calc_Fast_Data.mat")
    vectors, features = data["all_ctrl_gait_vectors"].T, data["gait_features"].T
    original = dataclasses.replace(toy, mean_deg=vectors.mean(axis=0), components=features)
    distance = original.log_distance(vectors)
    assert distance.mean() == pytest.approx(4.694223, abs=1e-6)
    assert distance.std(ddof=1) == pytest.approx(0.297627, abs=1e-6)
