"""The original index of nine angles, the profile score, units and conventions."""

import dataclasses

import numpy as np
import pytest
from scipy.io import loadmat

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    BODY_ANGLES,
    GDI_METHODS,
    GDI_MODEL,
    GILLETTE_MODEL,
    NINE_ANGLES,
    PAPER_INDEX,
    PLUG_IN_GAIT,
    THREE_ANGLES,
    GaitCycle,
    GdiParams,
    Measure,
    NormativeSet,
    Spatiotemporal,
    fit_norm,
    leg_length_m,
    load_norm,
    movement_profile,
    normal_bands,
    offset_deg,
    score_gdi,
    variable_scores,
)
from pbl_pipeline.gait.normative import GRAVITY, gait_norm
from pbl_pipeline.synthetic.physique import leg_length_m as by_mujoco
from tests import not_none
from tests.unit.test_gait_gdi import ABOUT, PERCENT, cycle, toy_vectors

NINE = "gillette-166-nine-angles"


def nine_cycle(vector: np.ndarray, side: str = "left", model: str = PLUG_IN_GAIT) -> GaitCycle:
    curves = dict(zip(NINE_ANGLES, vector.reshape(9, 51), strict=True))
    return GaitCycle("c", 0, 0, side, 0.0, 0.1, 0.5, 0.6, 1.0, curves=curves, angle_model=model)


def published(shared_data) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (166, 459) of the controls and the published features (459, 15)."""
    data = loadmat(shared_data / "real" / "gdi_gillette" / "GDI_Calc_Fast_Data.mat")
    return data["all_ctrl_gait_vectors"].T, data["gait_features"]


def original_index(vectors: np.ndarray, controls: np.ndarray, features: np.ndarray) -> np.ndarray:
    """As the paper of 2008 describes it: feature components c = g . f, distance to their mean over the controls."""

    def raw(g):
        return np.log(np.sqrt(np.sum((g @ features - (controls @ features).mean(axis=0)) ** 2, axis=-1)))

    of_controls = raw(controls)
    z = (raw(vectors) - np.mean(of_controls)) / np.sqrt(np.sum((of_controls - of_controls.mean()) ** 2) / 165)
    return 100 - 10 * z


def test_all_controls_to_a_millionth(shared_data):
    controls, features = published(shared_data)
    expected = original_index(controls, controls, features)
    cycles = [nine_cycle(v, ("left", "right")[i % 2]) for i, v in enumerate(controls)]
    result = score_gdi(cycles, model=GILLETTE_MODEL)
    assert (result.model, result.norm, result.n) == (GILLETTE_MODEL, NINE, 166)
    assert np.abs(np.array([c.gdi for c in result.cycles]) - expected).max() < 1e-6
    assert result.mean == pytest.approx(100.0, abs=1e-6)
    assert np.std([c.gdi for c in result.cycles], ddof=1) == pytest.approx(10.0, abs=1e-6)


def test_far_from_the_controls_to_a_millionth(shared_data):
    controls, features = published(shared_data)
    rng = np.random.default_rng(1)
    others = controls[:40] * rng.uniform(0.3, 1.8, (40, 1)) + rng.normal(0, 8, (40, 459))
    expected = original_index(others, controls, features)
    found = load_norm(NINE).index(others)
    assert expected.min() < 70
    assert np.abs(found - expected).max() < 1e-6


def test_the_mapped_set_is_the_same_but_for_the_pelvis():
    laboratory, body = load_norm("gillette-166-three-angles"), load_norm()
    assert (laboratory.angle_model, body.angle_model) == (PLUG_IN_GAIT, BODY_ANGLES)
    shift = np.repeat([offset_deg(a, PLUG_IN_GAIT, BODY_ANGLES) for a in THREE_ANGLES], 50)
    np.testing.assert_allclose(body.mean_deg, laboratory.mean_deg + shift, atol=1e-4)
    assert shift[0] == -12.0
    assert not shift[50:].any()
    vectors = laboratory.mean_deg + np.random.default_rng(0).normal(0, 5, (20, 150))
    np.testing.assert_allclose(body.index(vectors + shift), laboratory.index(vectors), atol=1e-3)
    tilt = [n.curves["pelvis_tilt"]["mean_deg"] for n in (laboratory, body)]
    np.testing.assert_allclose(tilt[1], tilt[0] - 12.0, atol=1e-4)
    with pytest.raises(PblError, match="NORM_INVALID"):
        offset_deg("hip_flexion", "another", BODY_ANGLES)


def test_profile_by_hand():
    norm = load_norm(NINE)
    # Left: every angle 3 deg off, hip flexion 9; right: pelvis 6, all others 0.
    left, right = norm.mean_deg.copy(), norm.mean_deg.copy()
    left += 3.0
    left[3 * 51 : 4 * 51] += 6.0
    right[: 3 * 51] -= 6.0
    profile = movement_profile({"left": variable_scores(left, norm), "right": variable_scores(right, norm)}, norm)
    assert profile.left == pytest.approx(dict.fromkeys(NINE_ANGLES, 3.0) | {"hip_flexion": 9.0})
    assert profile.right == pytest.approx(dict.fromkeys(NINE_ANGLES[3:], 0.0) | dict.fromkeys(NINE_ANGLES[:3], 6.0))
    # Root mean squares: (8 x 9 + 81) / 9 = 17; 3 x 36 / 9 = 12; of the person (8 x 9 + 81 + 6 x 0) / 15.
    assert profile.gps_left == pytest.approx(np.sqrt(17.0))
    assert profile.gps_right == pytest.approx(np.sqrt(12.0))
    assert profile.gps == pytest.approx(np.sqrt(153 / 15))


def test_a_score_is_the_root_mean_square_over_the_cycle():
    norm = load_norm(NINE)
    wave = norm.mean_deg.copy()
    wave[:51] += np.where(np.arange(51) % 2, 4.0, -4.0)
    wave[51:102] += np.r_[np.zeros(26), np.full(25, 10.0)]
    scores = variable_scores(wave, norm)[0]
    assert scores == pytest.approx([4.0, np.sqrt(25 * 100 / 51), *[0.0] * 7])


def test_profile_stands_beside_the_index():
    norm = load_norm(NINE)
    cycles = [
        nine_cycle(norm.mean_deg + 4.0),
        nine_cycle(norm.mean_deg + 2.0),
        nine_cycle(norm.mean_deg + 5.0, "right"),
    ]
    profile = not_none(score_gdi(cycles, norm).profile)
    assert profile.left["knee_flexion"] == pytest.approx(3.0)
    assert (profile.gps_left, profile.gps_right) == pytest.approx((3.0, 5.0))
    assert score_gdi(cycles[:2], norm).profile is None
    three = not_none(score_gdi([dataclasses.replace(c, angle_model=BODY_ANGLES) for c in cycles]).profile)
    assert set(three.left) == set(THREE_ANGLES)
    assert three.gps is None


def test_radians_are_refused():
    norm = load_norm(NINE)
    for factor in (np.pi / 180, 180 / np.pi):
        with pytest.raises(PblError, match="ANGLE_UNITS"):
            score_gdi([nine_cycle(norm.mean_deg * factor)], norm)
        with pytest.raises(PblError, match="ANGLE_UNITS"):
            make(toy_vectors() * factor)


def test_index_and_norm_must_fit_together():
    cycles = [nine_cycle(load_norm(NINE).mean_deg + 3.0)]
    with pytest.raises(PblError, match="NORM_INVALID"):
        score_gdi(cycles, "gillette-166-three-angles", model=GILLETTE_MODEL)
    with pytest.raises(PblError, match="SOLVER_UNKNOWN"):
        score_gdi(cycles, model="gdi")


def make(vectors: np.ndarray, **changes) -> NormativeSet:
    return fit_norm(vectors, variables=THREE_ANGLES, percent=PERCENT, **ABOUT, **changes)


#: A set of the body's angles.
OWN = make(toy_vectors(), angle_model=BODY_ANGLES)


@pytest.mark.parametrize(
    ("models", "norm", "outcome"),
    [
        ((PLUG_IN_GAIT, PLUG_IN_GAIT), NINE, "PASS"),
        ((BODY_ANGLES, BODY_ANGLES), NINE, "WARN"),
        ((BODY_ANGLES, BODY_ANGLES), "gillette-166-three-angles", "WARN"),
        ((BODY_ANGLES, BODY_ANGLES), "gillette-166-body-angles", "PASS"),  # the usual: described with the index
        ((PLUG_IN_GAIT, BODY_ANGLES), NINE, "WARN"),
        ((BODY_ANGLES, BODY_ANGLES), dataclasses.replace(OWN, mapped_from=PLUG_IN_GAIT), "WARN"),
        ((BODY_ANGLES, BODY_ANGLES), OWN, "PASS"),
    ],
)
def test_mixed_and_mapped_conventions_warn(models, norm, outcome):
    mean = load_norm(NINE).mean_deg
    cycles = [nine_cycle(mean + 3, s, m) for s, m in zip(("left", "right"), models, strict=True)]
    check = next(c for c in score_gdi(cycles, norm).qc if c.check == "norm_convention")
    assert check.outcome == outcome
    assert bool(check.advice) == (outcome == "WARN")
    assert ("mapped" in check.advice) == (isinstance(norm, NormativeSet) and bool(norm.mapped_from))


def test_no_more_components_than_cycles():
    with pytest.raises(PblError, match="40 vectors for 40 components"):
        make(toy_vectors(40), n_components=40)
    assert len(make(toy_vectors(40), n_components=12).components) == 12


def test_pooled_components_come_from_patients_too():
    tremor = np.tile(np.sin(2 * np.pi * 9 * PERCENT / 100), 3)
    patients = toy_vectors(60, seed=5) + 12 * np.random.default_rng(2).standard_normal((60, 1)) * tremor
    alone, pooled = make(toy_vectors()), make(toy_vectors(), pooled=patients)
    np.testing.assert_allclose(alone.mean_deg, pooled.mean_deg)
    scores = pooled.index(toy_vectors())
    assert (scores.mean(), scores.std(ddof=1)) == pytest.approx((100, 10))
    # The direction in which only the patients differ is among the components of the pooled set alone.
    seen = [np.linalg.norm(n.components @ tremor) / np.linalg.norm(tremor) for n in (alone, pooled)]
    assert seen[0] < 0.1
    assert seen[1] > 0.95
    both = np.vstack([toy_vectors(), patients])
    values = np.linalg.eigvalsh(np.cov(both.T))[::-1]
    np.testing.assert_allclose(pooled.explained_variance, values[: len(pooled.components)])


def test_the_papers_index_is_the_mean_over_all_steps_with_nothing_taken_back():
    """The paper, Gait Deviation Index: components of norm and patients together, index of every step, their mean."""
    g = np.random.default_rng(1)
    norm_curves, patients = toy_vectors(), toy_vectors(60, seed=5) + 8.0
    norm = make(norm_curves, pooled=patients)
    walked = patients[:7] + g.normal(0, 2, (7, 150))
    sd = {v: np.full(51, 5.0) for v in THREE_ANGLES}
    cycles = [cycle(v, "right" if i < 5 else "left", number=i, curves_sd=sd) for i, v in enumerate(walked)]
    found = score_gdi(cycles, norm, model=PAPER_INDEX)
    both = np.vstack([norm_curves, patients])
    values, vectors = np.linalg.eigh(np.cov(both.T))
    k = 1 + int(np.searchsorted(np.cumsum(values[::-1]) / values.sum(), 0.95))
    components = vectors[:, ::-1][:, :k].T
    middle = norm_curves.mean(axis=0)
    ln = [np.log(np.linalg.norm((x - middle) @ components.T, axis=1)) for x in (norm_curves, walked)]
    expected = 100 - 10 * (ln[1] - ln[0].mean()) / ln[0].std(ddof=1)
    assert found.mean == pytest.approx(expected.mean(), abs=1e-6)
    assert found.right == pytest.approx(expected[:5].mean(), abs=1e-6)
    assert found.model == PAPER_INDEX
    assert GDI_METHODS[PAPER_INDEX].hash != found.params_hash  # the set's name is part of it
    # The default corrects for the angles' errors and averages curves.
    assert score_gdi(cycles, norm).mean != pytest.approx(found.mean, abs=0.5)


def test_paramsets():
    assert {name: p.version for name, p in GDI_METHODS.items()} == {
        GDI_MODEL: 8,
        GILLETTE_MODEL: 1,
        PAPER_INDEX: 1,
    }
    # A row of version 1 is understood as it was.
    first = GDI_METHODS.make(GDI_MODEL, 1, GdiParams())
    old, new = (score_gdi([], "gillette-166-three-angles", GdiParams(), model) for model in (first, GDI_MODEL))
    assert old.params_hash != new.params_hash


# --- Normal curves at a person's speed.


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
    bands = normal_bands(measures(speed_m_per_s=speed, cadence_steps_per_min=60.0).measures, LEG_M, PLUG_IN_GAIT)
    assert (bands.matched, bands.clipped) == ("speed", False)
    for angle in ("knee_flexion", "pelvis_obliquity"):
        mean, sd = bands.curves[angle]
        np.testing.assert_allclose(mean, norm.curve(angle, PHASE, norm.speed[group]), atol=1e-9)
        np.testing.assert_allclose(sd, norm.curve(angle, PHASE, norm.speed[group], sd=True), atol=1e-9)


@pytest.mark.parametrize("group", [0, 1, 3, 4])
def test_without_speed_the_cadence_decides(group):
    norm = gait_norm()
    cadence = 60 * float(norm.cadence[group]) / np.sqrt(LEG_M / GRAVITY)
    bands = normal_bands(measures(cadence_steps_per_min=cadence).measures, LEG_M)
    assert bands.matched == "cadence"
    assert bands.speed == pytest.approx(norm.speed[group], abs=1e-6)


@pytest.mark.parametrize(("cadence", "end"), [(30.0, 0), (200.0, -1)])
def test_beyond_the_groups_it_says_so(cadence, end):
    bands = normal_bands(measures(cadence_steps_per_min=cadence).measures, LEG_M)
    assert bands.clipped
    assert bands.speed == pytest.approx(gait_norm().speed[end])
    assert "slower or faster" in bands.words()


def test_without_a_leg_the_free_speed():
    bands = normal_bands(measures(cadence_steps_per_min=60.0).measures)
    assert (bands.matched, bands.speed) == ("", pytest.approx(0.4294))
    assert bands.words() == "at the speed that they choose"


def test_bands_are_mapped_to_the_body():
    body, laboratory = (normal_bands(None, None, m).curves for m in (BODY_ANGLES, PLUG_IN_GAIT))
    assert {"hip_flexion", "pelvis_tilt", "knee_flexion"} < set(body)
    for angle in body:
        shift = 12.0 if angle in ("hip_flexion", "pelvis_tilt") else 0.0
        np.testing.assert_allclose(laboratory[angle][0] - body[angle][0], shift)
        np.testing.assert_allclose(laboratory[angle][1], body[angle][1])
