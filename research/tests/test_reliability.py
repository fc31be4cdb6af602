"""Curves of confidence, the truth that they are fitted to, the table and the page of reliability."""

import dataclasses

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import (
    BOUND_TRUNK,
    confidence_curve,
)
from pbl_pipeline.synthetic import Synthetic, SynthSpec, synthesise
from pbl_pipeline.video import CameraPose
from research.confidence import fit_curve, leave_one_out, save_curve
from research.reliability.__main__ import main
from research.reliability.page import write_reliability
from research.reliability.point_errors import PointErrors, point_errors, reliability_table
from research.reliability.point_truth import resect, truth_of_synthetic, truth_of_trc
from tests.unit.test_shortcomings import person


@pytest.fixture(scope="module")
def trial() -> Synthetic:
    return synthesise(SynthSpec(seed=2, seconds=2.0, marker_set="blazepose_33", view="oblique", noise="none"))


def made(n: int, chance, seed: int = 0, dataset: str = "a", recording: str = "x1") -> PointErrors:
    """N points of which a share of `chance(stated)` lies within the bound."""
    rng = np.random.default_rng(seed)
    stated = rng.random(n)
    error = np.where(rng.random(n) < chance(stated), 0.5, 1.5) * BOUND_TRUNK
    return PointErrors("test", dataset, recording, stated, 100 * error, error, np.full(n, 5.0))


def test_a_curve_finds_the_chance_behind_the_points():
    def chance(c):
        return 0.3 + 0.6 * c**2

    curve = fit_curve([made(60_000, chance)], "test-v1")
    c = np.linspace(0.05, 0.95, 19)
    np.testing.assert_allclose(curve(c), chance(c), atol=0.03)
    assert np.all(np.diff(curve.probability) >= 0)


def test_every_recording_weighs_the_same():
    long, short = made(50_000, lambda c: 0 * c + 0.9), made(1_000, lambda c: 0 * c + 0.5, 1)
    assert fit_curve([long, short], "t")(np.array([0.5]))[0] == pytest.approx(0.7, abs=0.05)


def test_nothing_is_certain_and_a_falling_share_is_pooled():
    assert fit_curve([made(480, lambda c: 0 * c + 1)], "t").probability.max() < 0.97
    falling = fit_curve([made(20_000, lambda c: 0.9 - 0.5 * c)], "t")
    assert np.ptp(falling.probability) == pytest.approx(0, abs=0.01)
    assert falling.probability[0] == pytest.approx(0.65, abs=0.02)


def test_leave_one_out_judges_by_the_others():
    sure = made(5_000, lambda c: c, 1, "a"), made(5_000, lambda c: c, 2, "b"), made(5_000, lambda c: c * 0, 3, "c")
    scores = {s.recording: s for s in leave_one_out(sure)}
    assert scores["c, x1"].within == 0
    assert scores["c, x1"].gap_curve == pytest.approx(0.5, abs=0.03)  # the others say 0.5 on average
    assert scores["a, x1"].gap_stated == pytest.approx(0.0, abs=0.03)
    assert scores["a, x1"].gap_curve == pytest.approx(-0.25, abs=0.04)  # half of the others are never right


def test_too_few_points_and_two_detectors_are_refused():
    one = made(100, lambda c: c)
    for errors in ([one], [made(500, lambda c: c), dataclasses.replace(made(500, lambda c: c), detector="other")]):
        with pytest.raises(PblError, match=r"^REFERENCE_INPUT: "):
            fit_curve(errors, "t")


def test_a_saved_curve_never_changes(tmp_path):
    curve = fit_curve([made(5_000, lambda c: c)], "test-v1")
    save_curve(curve, tmp_path / "curves.json")
    save_curve(curve, tmp_path / "curves.json")
    with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
        save_curve(fit_curve([made(5_000, lambda c: c, 9)], "test-v1"), tmp_path / "curves.json")


def test_without_noise_the_points_are_where_they_are(trial):
    truth = truth_of_synthetic(trial.keypoints, trial.truth)
    errors = point_errors(trial.keypoints, truth, "synth", "walk", "r")
    assert errors.error_px.max() < 0.01
    assert errors.error_3d_cm.max() < 0.01
    assert 0.3 < np.median(truth.trunk_m) < 0.7
    with pytest.raises(PblError, match=r"^REFERENCE_INPUT: "):
        truth_of_synthetic(person(), trial.truth)


def test_errors_are_counted_in_trunks(trial):
    moved = dataclasses.replace(trial.keypoints, xy_px=trial.keypoints.xy_px + np.array([30.0, 40.0]))
    truth = truth_of_synthetic(trial.keypoints, trial.truth)
    errors = point_errors(moved, truth, "synth", "walk", "r")
    np.testing.assert_allclose(errors.error_px, 50.0, atol=0.01)
    known = (moved.confidence > 0) & np.isfinite(moved.xy_px[..., 0])
    np.testing.assert_allclose(errors.error_trunk, (50 / truth.trunk_px[:, None] * np.ones((1, 33)))[known], rtol=1e-3)


@pytest.mark.slow
def test_a_camera_is_found_from_what_it_saw(trial):
    """Mocap in separate axes, another clock, a lens that is 12 % longer than guessed, noise and gross outliers."""
    keypoints, world = trial.keypoints, trial.truth.markers_world_m
    turn = Rotation.from_euler("xyz", [0.3, -1.1, 2.0])
    room = turn.apply(world.reshape(-1, 3)).reshape(world.shape) + np.array([3.0, -1.0, 0.5])
    rng = np.random.default_rng(0)
    xy = keypoints.xy_px + rng.normal(0, 4, keypoints.xy_px.shape)
    xy[rng.random(xy.shape[:2]) < 0.05] += 150
    matrix = np.array(keypoints.camera.matrix)
    matrix[[0, 1], [0, 1]] /= 1.12
    seen = dataclasses.replace(keypoints, xy_px=xy, camera=dataclasses.replace(keypoints.camera, matrix=matrix))
    truth = resect(seen, keypoints.time_s - 0.04, room)
    known = keypoints.confidence > 0
    inside = np.isfinite(truth.xy_px[..., 0])
    assert inside.mean() > 0.9
    off = np.linalg.norm(truth.xy_px - keypoints.xy_px, axis=-1)[known & inside]
    assert np.median(off) < 2.0
    assert np.percentile(off, 95) < 0.05 * np.nanmedian(truth.trunk_px)
    lag_ms = float(truth.note.split("lag ")[1].split(" ")[0])
    assert abs(lag_ms - 40) <= 20
    with pytest.raises(PblError, match=r"^REFERENCE_INPUT: "):
        resect(seen, keypoints.time_s + 100.0, room)


def test_markers_of_other_cameras(trial, tmp_path):
    """A TRC with the axes of Pose2Sim and OpenPose's names, read back into the picture of one camera."""
    keypoints, world = trial.keypoints, trial.truth.markers_world_m
    names = {"RShoulder": "right_shoulder", "LShoulder": "left_shoulder", "RHip": "right_hip", "LHip": "left_hip"}
    rows = [
        f"{i + 1}\t{t:.6f}\t"
        + "\t".join(f"{v:.9f}" for n in names.values() for v in world[i, keypoints.names.index(n)][[1, 2, 0]])
        for i, t in enumerate(keypoints.time_s)
    ]
    head = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"30\t30\t{len(rows)}\t{len(names)}\tm",
        "Frame#\tTime\t" + "\t\t\t".join(names),
        "\t\tX1\tY1\tZ1",
    ]
    path = tmp_path / "m.trc"
    path.write_text("\n".join([*head, *rows]) + "\n")
    pose = CameraPose(trial.truth.R_nc[0], np.zeros(3))
    truth = truth_of_trc(keypoints, path, keypoints.camera, pose)
    known = np.isfinite(truth.xy_px).all(axis=(0, 2))
    assert sorted(np.array(keypoints.names)[known]) == sorted(names.values())
    errors = point_errors(keypoints, truth, "synth", "walk", "r")
    assert errors.error_px.max() < 0.05
    # Without a pose it is found; four points of a walk are enough where they lie exactly right.
    found = point_errors(keypoints, truth_of_trc(keypoints, path, keypoints.camera), "synth", "walk", "r")
    assert found.error_px.max() < 1.0
    with pytest.raises(PblError, match=r"^REFERENCE_INPUT: "):
        truth_of_trc(person(7), path, keypoints.camera, pose)


def test_the_table_by_hand():
    stated = np.array([0.1, 0.2, 0.8, 0.9])
    trunk = np.array([0.5, 0.1, 0.1, 0.3])
    errors = PointErrors("d", "s", "r", stated, 100 * trunk, trunk, np.array([10.0, np.nan, 2.0, 4.0]))
    table = reliability_table([errors], None, 2)
    assert table["n"].tolist() == [2, 2]
    np.testing.assert_allclose(
        table[["stated_low", "stated_high", "stated_mean"]], [[0.1, 0.2, 0.15], [0.8, 0.9, 0.85]]
    )
    np.testing.assert_allclose(table["error_median_trunk"], [0.3, 0.2])
    np.testing.assert_allclose(table["error_90_trunk"], [0.46, 0.28])
    np.testing.assert_allclose(table["error_3d_median_cm"], [10.0, 3.0])
    np.testing.assert_allclose(table["within_bound"], [0.5, 0.5])
    assert np.isnan(table["probability_mean"].to_numpy()).all()


def test_page_and_csv_name_every_dataset(tmp_path):
    errors = [made(500, lambda c: c, 1, "here & there"), made(500, lambda c: c, 2, "b")]
    csv, page = write_reliability(errors, tmp_path, confidence_curve("blazepose-v1"))
    assert len(csv.read_text().splitlines()) == 21
    text = page.read_text()
    assert text.count("<svg") == 4
    assert "here &amp; there" in text
    assert "blazepose-v1" in text
    assert "src=" not in text


def test_the_command_on_a_synthetic_trial(trial, tmp_path):
    paths = trial.save(tmp_path, "walk")
    keypoints, truth = (next(str(p) for p in paths if end in p.name) for end in ("keypoints", "truth"))
    done = CliRunner().invoke(main, [keypoints, "--truth", truth, "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "out" / "reliability.html").exists()
    assert "within 20 %" in done.output
    wrong = CliRunner().invoke(main, [keypoints, "--truth", truth, "--truth", truth])
    assert wrong.exit_code == 2
    no_camera = CliRunner().invoke(main, [keypoints, "--truth", truth, "--camera", "a"])
    assert no_camera.exit_code == 2
