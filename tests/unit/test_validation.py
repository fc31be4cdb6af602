"""Errors of a fit against a reference, by cases worked by hand."""

import dataclasses
import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.validation import (
    BODY_ROTATIONS,
    JOINTS_CLIP,
    JOINTS_OPENCAP,
    JOINTS_PAPER,
    QPOS,
    KinematicErrors,
    Reference,
    align_path,
    compare,
    compare_angles,
    fit_angles,
    fit_angles_sd,
    reference_of_bodies,
    reference_of_fit,
    reference_of_mot,
    reference_of_qpos,
    view_classes,
)
from tests import not_none, refused
from tests.walking_fit import walking_fit, with_level_pelvis

TIME = np.arange(200) / 100.0
WAVE = 30 * np.sin(2 * np.pi * 1.1 * TIME) + 5 * np.cos(2 * np.pi * 2.3 * TIME)
KNEE = "knee_flexion_r"


def _reference(**angles: np.ndarray) -> Reference:
    return Reference("a", "synthetic", QPOS, TIME, angles)


def _knee(values: np.ndarray, reference: Reference | None = None, time_s: np.ndarray = TIME, **kw):
    return compare_angles(time_s, {KNEE: values}, reference or _reference(knee_flexion_r=WAVE), **kw).joint(KNEE)


@pytest.fixture(scope="module")
def fit() -> TrialFit:
    """A walk of 135 frames in view of 150, from right to left in front of a camera at rest."""
    body = load_body()
    return walking_fit(body.joint_names, "x", seen=(5, 140))


def _turned(fit: TrialFit, yaw: float, shift_m: tuple[float, float, float]) -> TrialFit:
    """The same walk in a world that is turned about the vertical and shifted."""
    column = {n: i for i, n in enumerate(fit.joint_names)}
    poses_path = not_none(reference_of_fit(fit, "").pelvis_m)
    c, s = np.cos(yaw), np.sin(yaw)
    rest = load_body().mj_model.body("pelvis").pos
    moved = poses_path @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + shift_m - rest
    qpos = fit.qpos.copy()
    # The pelvis slides along forward, up and right of the ground; z up: x, z, -y. It walks upright here, so a turn
    # about the vertical is pelvis_rotation alone.
    for name, values in zip(
        ("pelvis_tx", "pelvis_ty", "pelvis_tz"), (moved[:, 0], moved[:, 2], -moved[:, 1]), strict=True
    ):
        qpos[:, column[name]] = values
    qpos[:, column["pelvis_rotation"]] += yaw
    return dataclasses.replace(fit, qpos=qpos)


# --- errors of one joint


def test_equal_angles_have_no_error():
    error = _knee(WAVE)
    assert (error.n, error.median_abs_deg, error.bias_deg, error.rms_deg) == (200, 0, 0, 0)
    assert error.correlation == pytest.approx(1)


def test_a_constant_offset_is_all_bias():
    error = _knee(WAVE - 4.0)
    assert (error.bias_deg, error.median_abs_deg, error.mean_abs_deg, error.rms_deg) == pytest.approx((-4, 4, 4, 4))
    assert error.sd_deg == pytest.approx(0, abs=1e-9)
    assert error.correlation == pytest.approx(1)


def test_errors_worked_by_hand():
    """Errors 1 on half, 3 on a quarter and -5 on a quarter of the frames."""
    pattern = np.tile([1.0, 3.0, 1.0, -5.0], 50)
    error = _knee(WAVE + pattern, max_lag_s=0.0)
    assert error.median_abs_deg == pytest.approx(2.0)  # half are 1, the next is 3
    assert error.mean_abs_deg == pytest.approx(2.5)
    assert error.bias_deg == pytest.approx(0.0)
    assert error.rms_deg == error.sd_deg == pytest.approx(3.0)  # (1 + 9 + 1 + 25) / 4 = 9


def test_known_noise():
    noise = np.random.default_rng(0).normal(0, 2.0, TIME.size)
    error = _knee(WAVE + noise + 1.0, max_lag_s=0.0, sd_deg={KNEE: np.full(TIME.size, 2.0)})
    assert error.sd_deg == pytest.approx(np.std(noise))
    assert error.bias_deg == pytest.approx(1 + noise.mean())
    assert error.within_90 == pytest.approx(np.mean(np.abs(noise + 1) <= 1.645 * 2))
    assert 0.7 < error.within_90 < 0.95


def test_normality_of_the_errors_of_the_frames():
    g = np.random.default_rng(2)
    normal, skewed = g.normal(0, 2.0, TIME.size), g.exponential(2.0, TIME.size)
    found = [_knee(WAVE + e, max_lag_s=0.0).normal_p for e in (normal, skewed)]
    assert found == pytest.approx([stats.shapiro(e).pvalue for e in (normal, skewed)], rel=1e-6)
    assert found[0] > 0.05 > found[1]
    assert np.isnan(_knee(WAVE + 1.0).normal_p)  # a constant is no distribution


def test_intervals_count_only_where_there_is_an_sd():
    sd = np.full(TIME.size, 1.0)
    sd[100:] = np.nan
    offset = np.where(TIME < 0.5, 0.5, 3.0)  # inside 1.645 in 50 of the 100 frames with an sd
    assert _knee(WAVE + offset, max_lag_s=0.0, sd_deg={KNEE: sd}).within_90 == pytest.approx(0.5)
    assert np.isnan(_knee(WAVE).within_90)


def test_a_joint_at_rest_has_no_correlation():
    assert np.isnan(_knee(np.zeros(TIME.size)).correlation)


def test_angles_are_compared_across_180_degrees():
    turning = (np.arange(TIME.size) * 3.0 + 180) % 360 - 180
    reference = _reference(pelvis_rotation=turning)
    result = compare_angles(TIME, {"pelvis_rotation": (turning + 2 + 180) % 360 - 180}, reference, max_lag_s=0.0)
    assert result.joint("pelvis_rotation").mean_abs_deg == pytest.approx(2.0)


def test_nan_frames_do_not_count():
    values = WAVE + 2.0
    values[20:60] = np.nan
    holes = WAVE.copy()
    holes[100:110] = np.nan
    error = _knee(values, _reference(knee_flexion_r=holes), max_lag_s=0.0)
    assert error.n == 200 - 40 - 10
    assert error.median_abs_deg == pytest.approx(2.0)


def test_nothing_is_interpolated_across_a_hole_in_the_reference():
    keep = (TIME < 0.5) | (TIME > 1.0)
    reference = Reference("a", "x", QPOS, TIME[keep], {KNEE: WAVE[keep]})
    assert _knee(WAVE, reference, max_lag_s=0.0).n == keep.sum()


def test_only_joints_that_both_know_are_compared():
    result = compare_angles(
        TIME, {KNEE: WAVE, "hip_flexion_r": WAVE}, _reference(knee_flexion_r=WAVE, neck_bending=WAVE)
    )
    assert [e.joint for e in result.joints] == [KNEE]
    with pytest.raises(PblError, match="REFERENCE_INPUT"):
        result.joint("hip_flexion_r")


def test_the_trials_error_pools_frames_and_joints():
    """1 deg in one joint, 2 in the second, 9 in the third of which a third of the frames is missing: median 2. The
    other two are not among the paper's joints: with them it would be 9."""
    third = WAVE + 9
    third[::3] = np.nan
    ours = {
        "hip_flexion_r": WAVE + 1,
        KNEE: WAVE + 2,
        "neck_bending": third,
        "subtalar_angle_r": WAVE + 50,
        "pro_sup_r": WAVE + 70,
    }
    reference = _reference(**dict.fromkeys(ours, WAVE))
    result = compare_angles(TIME, ours, reference, max_lag_s=0.0)
    assert result.median_abs_deg == pytest.approx(2.0)
    assert result.mean_abs_deg() == pytest.approx((1 + 2 + 50) / 3)  # OpenCap's joints: hip, knee, subtalar
    assert np.isnan(result.mean_abs_deg(["elbow_flex_r"]))


def test_the_joint_lists_have_the_papers_degrees_of_freedom():
    assert (len(JOINTS_PAPER), len(JOINTS_OPENCAP), len(JOINTS_CLIP)) == (22, 18, 10)
    known = {n.replace("knee_angle", "knee_flexion") for n in load_body().joint_names}
    assert {*JOINTS_PAPER, *JOINTS_OPENCAP, *JOINTS_CLIP} <= known


# --- time


@pytest.mark.parametrize("lag_s", [-0.08, -0.013, 0.0, 0.04, 0.099])
def test_a_known_lag_is_found(lag_s: float):
    """The video's clock shows a moment `lag_s` later than the reference's."""
    at = np.arange(15, 180, 3) / 100.0
    ours = np.interp(at, TIME, WAVE) + 10.0  # the offset must not pull it
    result = compare_angles(at + lag_s, {KNEE: ours}, _reference(knee_flexion_r=WAVE))
    assert result.lag_s == pytest.approx(lag_s, abs=1.5e-3)
    assert result.joint(KNEE).sd_deg < 0.3
    assert not result.lag_at_limit


def test_a_lag_beyond_the_search_shows():
    at = np.arange(30, 150, 3) / 100.0
    result = compare_angles(at + 0.16, {KNEE: np.interp(at, TIME, WAVE)}, _reference(knee_flexion_r=WAVE))
    assert result.lag_s == pytest.approx(0.1)
    assert result.lag_at_limit


def test_a_person_at_rest_has_no_lag():
    result = compare_angles(TIME, {KNEE: np.full(200, 3.0)}, _reference(knee_flexion_r=np.full(200, 5.0)))
    assert result.lag_s == 0


def test_the_lag_cannot_choose_its_frames():
    """Noise at the end of the recording must not tempt the search to shift it out of the reference."""
    ours = WAVE.copy()
    ours[-8:] += 150
    assert compare_angles(TIME, {KNEE: ours}, _reference(knee_flexion_r=WAVE)).lag_s == 0
    # Nor where the person is in view for a small part of the video.
    time = np.arange(-500, 700) / 100.0
    part = np.full(1200, np.nan)
    part[500:700] = ours
    assert compare_angles(time, {KNEE: part}, _reference(knee_flexion_r=WAVE)).lag_s == pytest.approx(0, abs=1e-9)


def test_left_and_right_exchanged_shows():
    right, left = WAVE, np.roll(WAVE, 45)
    reference = _reference(knee_flexion_r=right, knee_flexion_l=left)
    good = compare_angles(TIME, {KNEE: right, "knee_flexion_l": left}, reference)
    mixed_up = compare_angles(TIME, {KNEE: left, "knee_flexion_l": right}, reference)
    assert good.median_abs_deg == 0
    assert mixed_up.median_abs_deg > 15
    assert mixed_up.joint(KNEE).correlation < 0


# --- refusals


@pytest.mark.parametrize(
    ("angles", "time", "what"),
    [
        ({KNEE: WAVE[:9]}, TIME[:9], "9 frames"),
        ({KNEE: np.where(np.arange(200) < 5, WAVE, np.nan)}, TIME, "5 frames"),
        ({KNEE: WAVE}, TIME + 100, "no common time"),
        ({KNEE: WAVE}, TIME + 1.95, "frames"),  # five frames overlap, and ten more with the largest lag
        ({"elbow_flex_r": WAVE}, TIME, "no joint that both know"),
    ],
)
def test_what_cannot_be_compared_is_refused(angles: dict, time: np.ndarray, what: str):
    with pytest.raises(PblError, match=what) as error:
        compare_angles(time, angles, _reference(knee_flexion_r=WAVE), max_lag_s=0.01)
    assert error.value.code == "REFERENCE_INPUT"


@pytest.mark.parametrize(
    "change",
    [
        {"time_s": TIME[::-1]},
        {"time_s": np.where(TIME == 0, np.nan, TIME)},
        {"angles_deg": {KNEE: WAVE[:-1]}},
        {"pelvis_m": np.zeros((5, 3))},
        {"convention": "euler"},
    ],
)
def test_a_reference_that_does_not_hold_together_is_refused(change: dict):
    with pytest.raises(PblError, match="REFERENCE_INPUT"):
        dataclasses.replace(_reference(knee_flexion_r=WAVE), **change)


# --- files


def test_a_reference_survives_its_file(tmp_path: Path):
    pelvis = np.column_stack([TIME, np.zeros(200), np.ones(200)])
    reference = Reference("walk", "optical markers", BODY_ROTATIONS, TIME, {KNEE: WAVE, "hip_flexion_r": -WAVE}, pelvis)
    reference.save(tmp_path / "r.npz")
    back = Reference.load(tmp_path / "r.npz")
    assert (back.name, back.source, back.convention) == ("walk", "optical markers", BODY_ROTATIONS)
    assert list(back.angles_deg) == [KNEE, "hip_flexion_r"]
    np.testing.assert_array_equal(back.angles_deg["hip_flexion_r"], -WAVE)
    np.testing.assert_array_equal(back.pelvis_m, pelvis)
    dataclasses.replace(reference, pelvis_m=None).save(tmp_path / "n.npz")
    assert Reference.load(tmp_path / "n.npz").pelvis_m is None


def test_files_that_are_no_reference_are_refused(tmp_path: Path):
    np.savez(tmp_path / "other.npz", time_s=TIME)
    (tmp_path / "x.mot").write_text("Coordinates\nendheader\ntime a\n0 1\n")
    with gzip.open(tmp_path / "x.json.gz", "wt") as file:
        json.dump({"time": [0.0]}, file)
    for read, name in ((Reference.load, "other.npz"), (reference_of_mot, "x.mot"), (reference_of_bodies, "x.json.gz")):
        with pytest.raises(PblError, match="FILE_FORMAT"):
            read(tmp_path / name)
        with pytest.raises(PblError, match="FILE_MISSING"):
            read(tmp_path / f"absent.{name}")


@pytest.mark.parametrize(("unit", "factor"), [("yes", 1.0), ("no", np.pi / 180)])
def test_a_motion_file_in_degrees_or_radians(tmp_path: Path, unit: str, factor: float):
    rows = "".join(f"{t:.2f} {-20 * factor:.8f} {7 * factor:.8f} 1.0 2.0 {3 + t:.2f}\n" for t in (0, 0.1, 0.2))
    head = f"Coordinates\ninDegrees={unit}\nendheader\ntime knee_angle_r hip_flexion_r pelvis_tx pelvis_ty pelvis_tz\n"
    (tmp_path / "a.mot").write_text(head + rows)
    read = reference_of_mot(tmp_path / "a.mot")
    assert list(read.angles_deg) == [KNEE, "hip_flexion_r"]
    np.testing.assert_allclose(read.angles_deg[KNEE], 20, atol=1e-5)  # positive in flexion, whatever the model's sign
    np.testing.assert_allclose(read.angles_deg["hip_flexion_r"], 7, atol=1e-5)
    np.testing.assert_allclose(not_none(read.pelvis_m)[0], [1.0, -3.0, 2.0])  # y up becomes z up


def test_an_overextended_knee_keeps_its_sign(tmp_path: Path):
    """The left knee is overextended by 8 deg throughout; flexion is negative in this model, as the right knee shows."""
    rows = "".join(f"{t:.2f} {-60 * t:.4f} 8.0\n" for t in (0, 0.5, 1.0))
    (tmp_path / "a.mot").write_text(f"Coordinates\ninDegrees=yes\nendheader\ntime knee_angle_r knee_angle_l\n{rows}")
    read = reference_of_mot(tmp_path / "a.mot")
    np.testing.assert_allclose(read.angles_deg[KNEE], [0, 30, 60])
    np.testing.assert_allclose(read.angles_deg["knee_flexion_l"], -8)


def _motion(path: Path, unit: str, columns: dict[str, np.ndarray]) -> Path:
    rows = "".join("\t".join(f"{v:.6f}" for v in row) + "\n" for row in zip(*columns.values(), strict=True))
    path.write_text(f"Coordinates\ninDegrees={unit}\nendheader\n" + "\t".join(columns) + "\n" + rows)
    return path


def _leg() -> dict[str, np.ndarray]:
    """A leg whose foot stands level for 60 % of each cycle."""
    t = np.arange(0, 4, 0.01)
    hip, swings = 5 + 25 * np.cos(2 * np.pi * t), t % 1 > 0.6
    knee = 10 + np.where(swings, 50 * np.sin(np.pi * (t % 1 - 0.6) / 0.4), 0)
    ankle = knee - hip - 3 + np.where(swings, -30 * np.sin(np.pi * (t % 1 - 0.6) / 0.4), 0)
    tilt = np.full(len(t), 3.0)
    return {"time": t, "pelvis_tilt": tilt, "hip_flexion_r": hip, "knee_angle_r": knee, "ankle_angle_r": ankle}


@pytest.mark.parametrize(("unit", "factor"), [("no", 1.0), ("yes", np.pi / 180)])
def test_a_header_that_contradicts_the_unit_of_the_data(tmp_path: Path, unit: str, factor: float):
    leg = {n: v * (1.0 if n == "time" else factor) for n, v in _leg().items()}
    turning = {"pelvis_rotation": np.linspace(0, 720, len(leg["time"])) * factor}  # two turns of the body prove nothing
    refused("ANGLE_UNITS", reference_of_mot, _motion(tmp_path / "a.mot", unit, leg | turning))


def test_columns_twice_in_a_motion(tmp_path: Path):
    path = tmp_path / "a.mot"
    for names in ("hip_flexion_r hip_flexion_r", "/jointset/hip_r/hip_flexion_r/value hip_flexion_r"):
        path.write_text(f"inDegrees=yes\nendheader\ntime {names}\n0 20 30\n1 21 31\n")
        assert "hip_flexion_r twice" in refused("FILE_FORMAT", reference_of_mot, path).found


def test_a_motion_with_the_paths_of_states(tmp_path: Path):
    leg = _leg()
    paths = {
        (n if n == "time" else f"/jointset/joint/{n}/value"): np.radians(v) if n != "time" else v
        for n, v in leg.items()
    }
    more = {"/jointset/joint/hip_flexion_r/speed": leg["time"] * 50, "/forceset/soleus_r/activation": leg["time"]}
    read = reference_of_mot(_motion(tmp_path / "a.sto", "no", paths | more))
    assert list(read.angles_deg) == ["pelvis_tilt", "hip_flexion_r", KNEE, "ankle_angle_r"]
    np.testing.assert_allclose(read.angles_deg[KNEE], leg["knee_angle_r"], atol=1e-3)


def test_signs_and_zeros_of_other_models_are_brought_to_ours_and_said(tmp_path: Path):
    leg = _leg()
    for sign, knee, zero in ((1, 1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 90), (-1, -1, 90)):
        other = leg | {"knee_angle_r": knee * leg["knee_angle_r"], "ankle_angle_r": sign * leg["ankle_angle_r"] + zero}
        read = reference_of_mot(_motion(tmp_path / "a.mot", "yes", other))
        for name in ("knee", "ankle"):
            ours = KNEE if name == "knee" else "ankle_angle_r"
            np.testing.assert_allclose(read.angles_deg[ours], leg[f"{name}_angle_r"], atol=1e-5)
        said = "; ".join(read.notes)
        assert ("positive in plantarflexion" in said, "90 deg" in said) == (sign < 0, zero > 0)
        assert f"{'positive' if knee > 0 else 'negative'} in flexion" in said


def test_a_pelvis_that_counts_its_tilt_forwards(tmp_path: Path):
    leg = _leg()
    swaying = 15 * np.sin(0.7 * np.pi * leg["time"])
    leg |= {"pelvis_tilt": swaying, "ankle_angle_r": leg["ankle_angle_r"] + 3 - swaying}
    for tilted, ankle in ((1, 1), (-1, 1), (-1, -1)):
        other = leg | {"pelvis_tilt": tilted * swaying, "ankle_angle_r": ankle * leg["ankle_angle_r"]}
        read = reference_of_mot(_motion(tmp_path / "a.mot", "yes", other))
        np.testing.assert_allclose(read.angles_deg["pelvis_tilt"], swaying, atol=1e-5)
        assert any("positive forwards" in n for n in read.notes) == (tilted < 0)


# --- fits


def test_a_fit_equals_itself_in_both_conventions(fit: TrialFit):
    for convention, count in ((QPOS, 37), (BODY_ROTATIONS, 10)):
        result = compare(fit, reference_of_fit(fit, "several cameras", convention))
        assert (result.n, len(result.joints), result.lag_s) == (135, count, 0)
        assert result.median_abs_deg == pytest.approx(0, abs=1e-9)
        assert result.rte_m == pytest.approx(0, abs=1e-9)
        assert (result.residual_2d_px, result.residual_3d_cm) == pytest.approx((4.0, 3.0))


def test_knee_flexion_is_positive_and_its_sd_too(fit: TrialFit):
    angles = fit_angles(fit, QPOS)
    assert np.nanmax(angles[KNEE]) > 50
    assert "knee_angle_r" not in angles
    assert "pelvis_tx" not in angles
    turned = fit_angles(fit, BODY_ROTATIONS)
    for joint in JOINTS_CLIP:  # the hips' axes are the same in both conventions, knee and ankle nearly so
        np.testing.assert_allclose(turned[joint], angles[joint], atol=1e-3 if "hip" in joint else 3.0)
    with_sd = dataclasses.replace(fit, qpos_sd=np.full_like(fit.qpos, np.radians(3.0)))
    np.testing.assert_allclose(fit_angles_sd(with_sd)[KNEE], 3.0)
    assert list(fit_angles_sd(with_sd, BODY_ROTATIONS)) == list(JOINTS_CLIP)
    with pytest.raises(PblError, match="REFERENCE_INPUT"):
        fit_angles(fit, "euler")


def test_known_joint_values_as_reference(fit: TrialFit):
    truth = reference_of_qpos("w", "synthetic", fit.time_s, fit.joint_names, fit.qpos)
    result = compare(fit, truth, same_world=True)
    assert result.median_abs_deg == 0
    assert result.rte_m == pytest.approx(0, abs=1e-6)  # the path from qpos is that of forward kinematics


def test_an_error_of_one_joint_stays_there(fit: TrialFit):
    qpos = fit.qpos.copy()
    qpos[:, fit.joint_names.index("knee_angle_l")] -= np.radians(6)  # six degrees more flexion
    result = compare(dataclasses.replace(fit, qpos=qpos), reference_of_fit(fit, "x"))
    assert result.joint("knee_flexion_l").bias_deg == pytest.approx(6)
    assert max(e.median_abs_deg for e in result.joints if e.joint != "knee_flexion_l") == pytest.approx(0, abs=1e-6)


# --- space


def test_a_turned_and_shifted_path_is_the_same_path():
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(0, 0.1, (80, 3)), axis=0)
    c, s = np.cos(2.1), np.sin(2.1)
    other = path @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [3.0, -7.0, 1.0]
    np.testing.assert_allclose(align_path(path, other), other, atol=1e-12)


def test_a_tilted_path_is_not_the_same_path():
    """Only the vertical may turn: a walk that climbs is an error."""
    path = np.column_stack([np.linspace(-1, 1, 81), np.zeros(81), np.zeros(81)])
    climbing = path + [0, 0, 1] * np.linspace(-0.2, 0.2, 81)[:, None]
    distance = np.linalg.norm(align_path(climbing, path) - path, axis=1)
    assert distance.mean() == pytest.approx(0.1, abs=0.002)


def test_another_world_costs_neither_path_nor_pelvis_angles(fit: TrialFit):
    fit = with_level_pelvis(fit)
    moved = _turned(fit, 1.2, (2.0, -1.0, 0.5))
    result = compare(moved, reference_of_fit(fit, "x"))
    assert result.rte_m == pytest.approx(0, abs=1e-6)
    assert max(e.rms_deg for e in result.joints) == pytest.approx(0, abs=1e-4)
    same = compare(moved, reference_of_fit(fit, "x"), same_world=True)
    assert same.joint("pelvis_rotation").bias_deg == pytest.approx(np.degrees(1.2), abs=1e-3)
    assert same.rte_m > 1


def test_rte_of_a_known_error(fit: TrialFit):
    """The path sways by +-4 cm up and down: 4 cm from the reference in every frame."""
    truth = reference_of_fit(fit, "x")
    qpos = fit.qpos.copy()
    sway = 0.04 * np.where(np.arange(len(qpos)) % 2 == 0, 1.0, -1.0)
    qpos[:, fit.joint_names.index("pelvis_ty")] += sway
    assert compare(dataclasses.replace(fit, qpos=qpos), truth).rte_m == pytest.approx(0.04, abs=5e-4)
    without = dataclasses.replace(truth, pelvis_m=None)
    assert np.isnan(compare(fit, without).rte_m)


# --- views


@pytest.mark.parametrize(
    ("heading_deg", "right", "left"),
    [
        (180, "front", "front"),  # the person stands at +x of the camera and looks back at it
        (0, "back", "back"),
        (90, "contralateral", "ipsilateral"),  # looks along +y: the camera is on the left
        (-90, "ipsilateral", "contralateral"),
        (180 - 40, "front", "front"),
        (180 - 50, "contralateral", "ipsilateral"),
    ],
)
def test_view_of_four_headings(heading_deg: float, right: str, left: str):
    angle = np.radians(heading_deg)
    forward = np.tile([np.cos(angle), np.sin(angle), 0.3], (20, 1))
    found = view_classes(np.tile([4.0, 0.0, -0.2], (20, 1)), forward, np.zeros(3))
    assert found == {"right": right, "left": left}


def test_a_turn_is_seen_from_mixed_views():
    angle = np.linspace(0, np.pi, 40)
    forward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(40)])
    assert view_classes(np.tile([4.0, 0, 0], (40, 1)), forward, np.zeros(3))["right"] == "mixed"
    nowhere = np.full(3, np.nan)
    assert view_classes(np.tile([4.0, 0, 0], (40, 1)), forward, nowhere) == {"right": "mixed", "left": "mixed"}


def test_the_view_of_a_fit(fit: TrialFit):
    """The walker crosses the picture from right to left, so its left side is towards the camera."""
    column = fit.joint_names.index("pelvis_rotation")
    seen = {}
    for turn in (0.0, np.pi):
        qpos = fit.qpos.copy()
        qpos[:, column] += turn
        seen[turn] = compare(dataclasses.replace(fit, qpos=qpos), reference_of_fit(fit, "x"))
    assert (seen[0.0].view_right, seen[0.0].view_left) == ("contralateral", "ipsilateral")
    assert (seen[np.pi].view_right, seen[np.pi].view_left) == ("ipsilateral", "contralateral")


# --- real data

PEERS = {  # mean absolute error, right side: hip flexion, adduction, rotation, knee, ankle (../shared/data/README.md)
    ("walk", "sample_mono"): (5.8, 2.5, 3.2, 4.6, 3.5),
    ("walk", "sample_wham"): (5.2, 6.9, 9.2, 5.6, 7.3),
    ("STS", "sample_mono"): (6.4, 2.4, 4.7, 4.7, 3.6),
    ("STS", "sample_wham"): (5.9, 2.5, 5.7, 6.4, 4.7),
}


def _compared(ours: Reference, reference: Reference, max_lag_s: float = 0.1) -> KinematicErrors:
    """Compare the kinematics of another system, which have no sd, view or residuals."""
    return compare_angles(ours.time_s, ours.angles_deg, reference, pelvis_m=ours.pelvis_m, max_lag_s=max_lag_s)


@pytest.mark.slow
@pytest.mark.parametrize(("clip", "system"), PEERS)
def test_peers_on_real_clips(shared_data: Path, clip: str, system: str):
    """The published figures are without alignment in time; with it the knees follow better, never worse."""
    folder = shared_data / "real" / "video_mocap" / clip
    if not folder.is_dir():
        pytest.skip("the recordings with motion capture are absent")
    mocap, peer = (reference_of_bodies(folder / f"{n}.json.gz") for n in ("sample_mocap", system))
    joints = ("hip_flexion_r", "hip_adduction_r", "hip_rotation_r", KNEE, "ankle_angle_r")
    plain = _compared(peer, mocap, max_lag_s=0.0)
    assert [plain.joint(j).mean_abs_deg for j in joints] == pytest.approx(PEERS[clip, system], abs=0.1)
    aligned = _compared(peer, mocap)
    assert not aligned.lag_at_limit
    assert aligned.joint(KNEE).correlation > max(0.97, plain.joint(KNEE).correlation)


def test_two_experts_on_real_markers(shared_data: Path):
    """The same markers solved twice: their figures stand in the data's README; one file is in radians."""
    folder = shared_data / "real" / "marker_ik"
    if not folder.is_dir():
        pytest.skip("the recordings with two solutions are absent")
    one, two = (reference_of_mot(folder / f"walking1_ik_{n}.mot") for n in ("addbiomechanics", "opensim_manual"))
    result = _compared(one, two, max_lag_s=0.0)
    assert 3 <= result.joint("hip_flexion_r").rms_deg <= 5.1
    assert 7 <= result.joint("ankle_angle_r").rms_deg <= 11.5
    assert result.joint("hip_flexion_r").sd_deg < 1
    assert result.rte_m < 0.005
