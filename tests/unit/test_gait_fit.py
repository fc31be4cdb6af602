"""Feet, pelvis angles, curves and metrics of a body that is moved by formulas."""

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.cli.events import events as events_command
from pbl_pipeline.cli.gait import gait as gait_command
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import (
    MEASURES,
    angle_series,
    detect_events,
    feet_from_fit,
    feet_from_keypoints,
    feet_from_markers,
    find_cycles,
    gait_metrics,
    load_events,
    pelvis_angles,
    score_gdi,
)
from pbl_pipeline.gait.normative import load_norm
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.qc import Check
from pbl_pipeline.video import Camera
from pbl_pipeline.visit import Recording, Visit, save_visit
from tests import not_none
from tests.unit.visits import solution_of
from tests.walking_fit import walking_fit

STRIDE_S = 1.1
CAMERA = Camera(np.array([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]]), np.zeros(5), "test")


def make_fit(time_s: np.ndarray, values: dict[str, np.ndarray | float], name: str = "walk", **changes) -> TrialFit:
    body = load_body()
    qpos = np.zeros((len(time_s), 40))
    for joint, value in values.items():
        qpos[:, body.joint_names.index(joint)] = value
    plain = walking_fit(body.joint_names, body.sha256, name=name, n_frames=len(time_s), marker_names=())
    given = {"time_s": time_s, "qpos": qpos, "camera": CAMERA, "image_size_px": (1000, 1000)}
    return dataclasses.replace(plain, **given | changes)


def walking(time_s: np.ndarray, heading_deg: float = 0.0, start_s: float = 0.0, speed: float = 1.2) -> dict:
    """Joint values along the normative mean curves, right initial contact at `start_s`, left half a stride later."""
    norm = load_norm()
    values: dict[str, np.ndarray | float] = {}
    for side, delay in (("r", 0.0), ("l", 0.5)):
        phase = 100 * (((time_s - start_s) / STRIDE_S - delay) % 1.0)
        for joint, curve, sign in (
            ("hip_flexion", "hip_flexion", 1),
            ("hip_adduction", "hip_adduction", 1),
            ("knee_angle", "knee_flexion", -1),
            ("ankle_angle", "ankle_dorsiflexion", 1),
        ):
            band = norm.curves[curve]
            values[f"{joint}_{side}"] = sign * np.radians(np.interp(phase, band["percent"], band["mean_deg"]))
    angle = np.radians(heading_deg)
    values["pelvis_tx"] = speed * time_s * np.cos(angle)
    values["pelvis_tz"] = -speed * time_s * np.sin(angle)  # the slide goes to the right, world -y
    values["pelvis_rotation"] = angle
    return values


def walk(seconds: float = 6.0, heading_deg: float = 0.0, start_s: float = 0.0, **changes) -> TrialFit:
    """A body that walks for so long."""
    time_s = np.arange(0, seconds, 1 / 30)
    return make_fit(time_s, walking(time_s, heading_deg, start_s), **changes)


def standing(seconds: float = 6.0, **changes) -> TrialFit:
    return make_fit(np.arange(0, seconds, 1 / 30), {}, **changes)


def test_feet_of_the_standing_body_by_hand():
    """Positions of the figures added up: pelvis, femur, tibia, talus, calcaneus (x forward, y up, z right)."""
    feet = feet_from_fit(standing(1.3))
    right = np.array([-0.07219 - 0.00167 - 0.05446, -0.06749 - 0.36555 - 0.48017 - 0.04684, 0.08526 + 0.00884])
    heel = right + np.array([-0.01617, -0.00123, 0.0])
    toe = right + np.array([0.19051, -0.00213, 0.00115])
    hip = np.array([-0.07219, -0.06749, 0.0])

    def world(p):
        return np.array([p[0], -p[2], p[1]])  # x forward, y to the left, z up

    np.testing.assert_allclose(feet.heel_m[5, 1] - feet.pelvis_m[5], world(heel - hip), atol=1e-5)
    np.testing.assert_allclose(feet.toe_m[5, 1] - feet.pelvis_m[5], world(toe - hip), atol=1e-5)
    np.testing.assert_allclose(feet.heel_m[5, 0] * [1, -1, 1], feet.heel_m[5, 1], atol=1e-5)
    np.testing.assert_allclose(feet.forward, np.tile([1.0, 0, 0], (len(feet.forward), 1)), atol=1e-5)


def test_the_foot_grows_with_its_scale():
    scale = np.ones(8)
    scale[load_body().scale_names.index("right_leg_and_foot")] = 1.5
    plain, scaled = feet_from_fit(standing()), feet_from_fit(standing(scale=scale))
    length = [np.linalg.norm(f.toe_m - f.heel_m, axis=2)[0] for f in (plain, scaled)]
    np.testing.assert_allclose(length[1] / length[0], [1.0, 1.5], atol=1e-5)


@pytest.mark.parametrize("heading_deg", [0, 70, 180, -135])
def test_pelvis_angles_do_not_depend_on_the_heading(heading_deg):
    tilt, side_up, ahead = 12.0, 4.0, 9.0
    angle = np.radians(heading_deg)
    forward = np.tile([np.cos(angle), np.sin(angle), 0.0], (60, 1))
    right = np.cross(forward[0], [0, 0, 1])
    frame = np.column_stack([forward[0], [0, 0, 1], right])
    # Front down by `tilt`, right side up by `side_up`, right side ahead by `ahead`, each about the axis as it stands.
    local = Rotation.from_euler("ZXY", [-tilt, -side_up, ahead], degrees=True).as_matrix()
    pelvis = np.tile(frame @ local, (60, 1, 1))
    np.testing.assert_allclose(pelvis_angles(pelvis, forward), np.tile([tilt, side_up, ahead], (60, 1)), atol=1e-9)
    # What the words mean, without Euler angles: small turns one at a time.
    for k, (turned, axis, direction) in enumerate(
        [
            (Rotation.from_euler("z", -5, degrees=True), 0, (1, -1)),  # the front axis sinks
            (Rotation.from_euler("x", -5, degrees=True), 2, (1, 1)),  # the right axis rises
            (Rotation.from_euler("y", 5, degrees=True), 2, (0, 1)),  # the right axis goes ahead
        ]
    ):
        moved = turned.as_matrix()[:, axis]
        assert np.sign(moved[direction[0]]) == direction[1]
        one = pelvis_angles((frame @ turned.as_matrix())[None], forward[:1])[0]
        np.testing.assert_allclose(one, 5.0 * np.eye(3)[k], atol=1e-9)


def test_curves_have_the_signs_of_gait():
    time = np.arange(90) / 30
    values = {"knee_angle_r": np.radians(-60), "hip_flexion_l": np.radians(20), "pelvis_tilt": np.radians(-10)}
    angles = angle_series(make_fit(time, values))
    assert angles.right["knee_flexion"][40] == pytest.approx(60)
    assert angles.left["knee_flexion"][40] == pytest.approx(0)
    assert angles.left["hip_flexion"][40] == pytest.approx(20)
    assert angles.left["pelvis_tilt"][40] == pytest.approx(10, abs=1e-3)  # OpenSim's negative tilt is anterior


@pytest.mark.parametrize("heading_deg", [0, 110])
def test_toes_in_is_positive_on_both_sides(heading_deg):
    """A straight leg that turns inwards at the hip turns its foot by as much, whatever the heading."""
    still = {"pelvis_rotation": np.radians(heading_deg)}
    straight = angle_series(make_fit(np.arange(60) / 30, still))
    turned = angle_series(
        make_fit(np.arange(60) / 30, {**still, "hip_rotation_l": np.radians(15), "hip_rotation_r": np.radians(-10)})
    )
    for side, deg in (("left", 15.0), ("right", -10.0)):
        change = turned.of_side(side)["foot_progression"] - straight.of_side(side)["foot_progression"]
        np.testing.assert_allclose(change, deg, atol=1.0)


def test_pelvis_curves_belong_to_a_side():
    """Right side ahead and right side up are positive for the right, negative for the left."""
    time = np.arange(0, 12, 1 / 30)
    turn = np.radians(8.0) * np.sin(2 * np.pi * time)  # about up: the right side ahead; averages out of the heading
    angles = angle_series(make_fit(time, {"pelvis_rotation": turn, "pelvis_list": np.radians(-5.0)}))
    peak = np.argmin(np.abs(time - 6.25))
    assert angles.right["pelvis_rotation"][peak] == pytest.approx(8, abs=0.5)
    assert angles.left["pelvis_rotation"][peak] == pytest.approx(-8, abs=0.5)
    assert angles.right["pelvis_obliquity"][peak] == pytest.approx(5, abs=0.1)
    assert angles.left["pelvis_obliquity"][peak] == pytest.approx(-5, abs=0.1)


@pytest.mark.parametrize("heading_deg", [0.0, 120.0])
def test_a_walking_body(heading_deg):
    metrics = gait_metrics([walk(10, heading_deg)])
    assert metrics.status == "PASS"
    values = metrics.spatiotemporal
    stride, cadence, stance = (
        not_none(values[n]) for n in ("stride_time_s", "cadence_steps_per_min", "stance_percent")
    )
    assert stride.mean == pytest.approx(STRIDE_S, abs=0.004)
    assert cadence.mean == pytest.approx(120 / STRIDE_S, abs=0.5)
    assert stance.left == pytest.approx(stance.right, abs=1.0)
    # The mean curves of normal walking: toe-off at 60 % of the cycle; the method finds it a little late.
    assert 58 < stance.mean < 70
    # Right initial contact at multiples of the stride, by construction of the curves.
    down = np.array(metrics.trials[0].events.times("right", "foot_down"))
    assert np.abs((down + STRIDE_S / 2) % STRIDE_S - STRIDE_S / 2).max() < 0.06
    # Curves of the mean of the norm are closer to it than those of anybody.
    assert not_none(metrics.gdi.mean) > 100
    used = [c for c in metrics.trials[0].cycles if c.used]
    assert 55 < used[0].curves["knee_flexion"].max() < 65
    for c in metrics.qc:
        assert c.outcome in ("PASS", "WARN")


def test_a_session_pools_its_trials_and_an_empty_one_takes_no_part():
    one, two = walk(), walk(heading_deg=90.0, start_s=0.4, name="back")
    alone, together = gait_metrics([one]), gait_metrics([one, two, standing(name="standing")])
    n = [alone.gdi.n, together.trials[1].gdi.n]
    assert together.gdi.n == sum(n)
    assert together.trials[2].status == "EMPTY"
    assert together.status == "PASS"
    assert together.trials[2].gdi.mean is None
    assert together.gdi.mean == score_gdi([c for t in together.trials for c in t.cycles]).mean
    assert together.gdi.mean != alone.gdi.mean


@pytest.mark.parametrize(
    ("camera_m", "heading_deg", "far"),
    [((6.0, 40.0, 1.0), 0.0, "right"), ((6.0, -40.0, 1.0), 0.0, "left"), ((-6.0, 40.0, 1.0), 180.0, "left"),
     ((40.0, 0.0, 1.0), 0.0, ""), ((-40.0, 0.0, 1.0), 0.0, "")],
)  # fmt: skip
def test_legs_that_one_camera_does_not_see_alike_are_not_compared(camera_m, heading_deg, far):
    fit = walk(10, heading_deg, camera_position_m=np.array(camera_m))
    metrics = gait_metrics([fit])
    assert {c.far_leg for c in metrics.trials[0].cycles if c.used} == {far}
    step = not_none(metrics.spatiotemporal["step_time_s"])
    assert (step.left is None, step.asymmetry_percent is None) == (False, bool(far))
    check = next(c for c in metrics.qc if c.check == "legs_seen_alike")
    assert (check.outcome, f"the {far} leg was behind" in check.advice) == (("WARN", True) if far else ("PASS", False))
    # Several cameras see both; so do two passes in opposite directions.
    measured = gait_metrics([dataclasses.replace(fit, orientation_source="measured: calibration")])
    assert {c.far_leg for c in measured.trials[0].cycles} == {""}
    if far:
        there = dataclasses.replace(fit, camera_position_m=np.array(camera_m) * [1, -1, 1])
        both = gait_metrics([fit, there])
        assert next(c for c in both.qc if c.check == "legs_seen_alike").outcome == "PASS"
        step = not_none(both.spatiotemporal["step_time_s"])
        assert step.asymmetry_percent is not None


def test_standing_gives_nulls_with_reasons(tmp_path):
    time = np.arange(0, 6, 1 / 30)
    metrics = gait_metrics([make_fit(time, {"pelvis_tx": 0.01 * np.sin(time)})])
    metrics.save(tmp_path / "metrics.json")
    session = json.loads((tmp_path / "metrics.json").read_text())["session"]
    assert session["status"] == "EMPTY"
    assert "no walking" in session["reason"]
    for name in MEASURES:
        assert session[name] is None
        assert session["reasons"][name]
    assert session["gdi"]["mean"] is None
    assert session["reasons"]["gdi"]
    assert session["outcome"] == "EMPTY"


def test_nothing_is_measured_on_a_fit_that_failed():
    fit = walk()
    fine = Check("residual_2d_share_of_body_height", "WARN", 0.03, 0.02, "look")
    failed = Check("residual_3d_cm", "FAIL", 21.0, 6.0, "the body and the detector's 3D points disagree")
    assert gait_metrics([fit], fit_checks=[fine]).status == "PASS"
    metrics = gait_metrics([fit], fit_checks=[fine, failed]).with_checks([fine, failed])
    content = metrics.to_dict()
    for part in (content["session"], *content["trials"]):
        assert part["status"] == "EMPTY"
        assert "the fit failed its check residual_3d_cm" in part["reason"]
        for name in MEASURES[:-3]:
            assert part[name] is None
            assert part["reasons"][name] == "the fit failed its check residual_3d_cm"
        assert part["gdi"]["mean"] is None
        assert part["reasons"]["gdi"] == "the fit failed its check residual_3d_cm"
        assert part["cycles"]["found"] > 0
    assert content["session"]["outcome"] == metrics.outcome == "FAIL"
    assert "residual_3d_cm" in {c["check"] for c in content["session"]["qc"]}
    assert metrics.trials[0].events.events


def test_an_unusual_cadence_is_measured_only_where_a_person_accepts_it():
    usual = walk()
    hasty = dataclasses.replace(usual, time_s=usual.time_s * 0.6, name="hasty")
    why = "the cadence is unusual for walking, and no one has accepted it"
    metrics = gait_metrics([hasty])
    content = metrics.to_dict()
    for part in (content["session"], *content["trials"]):
        assert part["status"] == "EMPTY"
        assert all(part[name] is None and part["reasons"][name] == why for name in MEASURES)
        assert (part["gdi"]["mean"], part["reasons"]["gdi"]) == (None, why)
    (check,) = [c for c in metrics.checks if c.check == "cadence_plausible"]
    assert (check.outcome, check.threshold, metrics.outcome) == ("FAIL", 150.0, "FAIL")
    assert check.value is not None
    assert check.value > 150.0
    with_another = gait_metrics([usual, hasty])
    assert not_none(with_another.spatiotemporal["cadence_steps_per_min"]).mean < 150.0
    assert (with_another.gdi.mean is None, with_another.outcome) == (False, "FAIL")
    accepted = gait_metrics([hasty], accept_cadence=True)
    assert round(not_none(accepted.spatiotemporal["cadence_steps_per_min"]).mean, 2) == check.value
    assert accepted.gdi.mean is not None
    assert [c.outcome for c in accepted.checks if c.check == "cadence_plausible"] == ["WARN"]
    assert [c.exclusion for c in accepted.trials[0].cycles] == [
        dataclasses.replace(c.exclusion, failed_checks=()) for c in metrics.trials[0].cycles
    ]


def test_a_slow_walk_is_measured_with_a_warning():
    usual = walk(12)
    metrics = gait_metrics([dataclasses.replace(usual, time_s=usual.time_s * 2.0)])
    assert not_none(metrics.spatiotemporal["cadence_steps_per_min"]).mean < 60.0
    assert [(c.outcome, c.threshold) for c in metrics.checks if c.check == "cadence_plausible"] == [("WARN", 60.0)]


def test_the_outcome_counts_what_came_before():
    metrics = gait_metrics([walk()])
    assert metrics.outcome == "WARN"
    seen = Check("leg_confidence", "FAIL", 0.1, 0.5, "the legs are hidden")
    judged = metrics.with_checks([seen])
    assert judged.outcome == "FAIL"
    assert judged.to_dict()["session"]["outcome"] == "FAIL"
    assert "FAIL leg_confidence: the legs are hidden" in judged.table()
    still = gait_metrics([walk(), standing(name="standing")])
    assert still.outcome == "WARN"


def test_out_of_view_in_the_middle():
    fit = walk(12)
    fit.qpos[170:200] = np.nan
    cycles = find_cycles(detect_events(feet_from_fit(fit)), fit)
    assert {c.bout for c in cycles} == {0, 1}
    assert not [c for c in cycles if c.start_s < fit.time_s[169] and c.end_s > fit.time_s[200]]
    assert all(c.curves for c in cycles)


def test_input_errors():
    fit = standing(2)
    with pytest.raises(PblError, match="GAIT_INPUT"):
        gait_metrics([])
    with pytest.raises(PblError, match="GAIT_INPUT"):
        feet_from_fit(dataclasses.replace(fit, qpos=np.full_like(fit.qpos, np.nan)))
    with pytest.raises(PblError, match="GAIT_INPUT"):
        feet_from_fit(dataclasses.replace(fit, joint_names=tuple(reversed(fit.joint_names))))
    with pytest.raises(PblError, match="NORM_UNKNOWN"):
        gait_metrics([fit], "nobody")


def make_keypoints(fit: TrialFit, marker_set: str, root_relative: bool = True, tilt_deg: float = 0.0) -> Keypoints:
    """Points of the fitted feet in a level (or tilted) camera: x right is world -y, y down world -z, z forward x."""
    feet = feet_from_fit(fit)
    names = {
        "blazepose_33": ("left_hip", "right_hip", "left_heel", "right_heel", "left_foot_index", "right_foot_index"),
        "mpi_inf_3dhp_17": ("left_hip", "right_hip", "left_ankle", "right_ankle"),
    }[marker_set]
    left = np.cross([0.0, 0, 1], feet.forward)
    points = [feet.pelvis_m + 0.09 * left, feet.pelvis_m - 0.09 * left, feet.heel_m[:, 0], feet.heel_m[:, 1]]
    points += [feet.toe_m[:, 0], feet.toe_m[:, 1]]
    world = np.stack(points[: len(names)], axis=1)
    if root_relative:
        world = world - feet.pelvis_m[:, None]
    camera = np.stack([-world[..., 1], -world[..., 2], world[..., 0]], axis=-1)
    camera = camera @ Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix().T
    n, j = len(fit.time_s), len(names)
    return Keypoints(
        time_s=fit.time_s,
        names=names,
        marker_set=marker_set,
        xy_px=np.zeros((n, j, 2)),
        xyz_cam_m=camera,
        root_relative=root_relative,
        confidence=np.full((n, j), 0.8),
        image_size_px=(1000, 1000),
        camera=CAMERA,
        box_px=np.zeros((n, 4)),
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0])
def test_keypoints_give_the_events_of_the_fit(tilt_deg):
    fit = walk(8, 90.0)
    expected = detect_events(feet_from_fit(fit), "zeni-2008")
    found = detect_events(feet_from_keypoints(make_keypoints(fit, "blazepose_33", tilt_deg=tilt_deg)), "zeni-2008")
    assert [(e.side, e.event) for e in found.events] == [(e.side, e.event) for e in expected.events]
    np.testing.assert_allclose(
        [e.time_s for e in found.events], [e.time_s for e in expected.events], atol=1e-6 if not tilt_deg else 0.01
    )
    assert found.source == "keypoints blazepose_33"
    assert max(e.probability for e in found.events) < 0.8


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0])
def test_the_event_model_needs_neither_knees_nor_a_level_camera(tilt_deg):
    """Hips, heels and toes instead of all joints, and a camera that is tilted: the same events within half a frame."""
    fit = walk(8, 90.0)
    expected = detect_events(feet_from_fit(fit))
    found = detect_events(feet_from_keypoints(make_keypoints(fit, "blazepose_33", tilt_deg=tilt_deg)))
    inner = [e for e in expected.events if 0.3 < e.time_s < 7.7]
    assert len(inner) > 22
    for e in inner:
        assert min(abs(np.array(found.times(e.side, e.event)) - e.time_s)) < 0.5 / 30
    assert len([e for e in found.events if 0.3 < e.time_s < 7.7]) == pytest.approx(len(inner), abs=1)


def test_absolute_keypoints_know_the_way():
    keypoints = make_keypoints(walk(8, 90.0), "blazepose_33", root_relative=False)
    assert feet_from_keypoints(keypoints).heading_agreement > 0.99


def test_a_turned_phone_is_turned_back():
    fit = walk(8, 90.0)
    plain = make_keypoints(fit, "blazepose_33")
    # A level camera's orientation: columns are its axes in the world; then rolled by 90 deg as a phone held upright.
    level = np.column_stack([[0, -1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
    roll = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    quat = Rotation.from_matrix(level @ roll).as_quat(scalar_first=True)
    rolled = dataclasses.replace(
        plain,
        xyz_cam_m=plain.xyz_cam_m @ roll,
        phone_time_s=np.array([0.0, 8.0]),
        phone_quat_wxyz=np.stack([quat, quat]),
    )
    a, b = detect_events(feet_from_keypoints(plain)), detect_events(feet_from_keypoints(rolled))
    np.testing.assert_allclose([e.time_s for e in a.events], [e.time_s for e in b.events], atol=1e-6)


def test_ankles_alone_are_enough_for_events():
    found = detect_events(feet_from_keypoints(make_keypoints(walk(8), "mpi_inf_3dhp_17")))
    assert found.status == "PASS"
    assert len(found.events) >= 20


def test_keypoints_without_feet_or_depth_are_refused():
    keypoints = make_keypoints(walk(3), "blazepose_33")
    flat = dataclasses.replace(keypoints, xyz_cam_m=np.full_like(keypoints.xyz_cam_m, np.nan))
    renamed = dataclasses.replace(keypoints, names=("a", *keypoints.names[1:]))
    for wrong in (flat, dataclasses.replace(keypoints, marker_set="hands"), renamed):
        with pytest.raises(PblError, match="GAIT_INPUT"):
            feet_from_keypoints(wrong)
    with pytest.raises(PblError, match="GAIT_INPUT"):
        feet_from_markers(np.arange(90) / 30, ["LHEE"], "plug_in_gait", np.zeros((90, 1, 3)))


def test_commands(tmp_path):
    fit = walk()
    paths = {"fit": tmp_path / "walk.fit.npz", "keypoints": tmp_path / "keypoints.npz", "still": tmp_path / "s.fit.npz"}
    fit.save(paths["fit"])
    make_keypoints(fit, "blazepose_33").save(paths["keypoints"])
    standing().save(paths["still"])
    run = CliRunner()
    for name in ("fit", "keypoints"):
        out = tmp_path / f"{name}.csv"
        result = run.invoke(events_command, [str(paths[name]), "--out", str(out)])
        assert result.exit_code == 0, result.output
        assert len(load_events(out)) >= 12
    result = run.invoke(events_command, [str(paths["still"]), "--out", str(tmp_path / "none.csv")])
    assert "no walking" in result.output
    assert load_events(tmp_path / "none.csv") == ()
    out = tmp_path / "metrics.json"
    result = run.invoke(gait_command, [str(paths["fit"]), str(paths["still"]), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "cadence_steps_per_min" in result.output
    assert [t["status"] for t in json.loads(out.read_text())["trials"]] == ["PASS", "EMPTY"]
    for command in (events_command, gait_command):
        assert "Example: pbl" in run.invoke(command, ["--help"]).output


def fit_with_points(time_s: np.ndarray, unseen: np.ndarray, side: str = "left") -> TrialFit:
    """A walk whose points were all observed but those of one foot in the frames `unseen` (T,)."""
    points = marker_set("blazepose_33")
    residual = np.zeros((len(time_s), len(points)))
    foot = np.isin(points.names, [f"{side}_ankle", f"{side}_heel", f"{side}_foot_index"])
    residual[unseen[:, None] & foot] = np.nan
    return make_fit(
        time_s,
        walking(time_s),
        marker_names=points.names,
        markers_world_m=np.zeros((*residual.shape, 3)),
        site_offset_m=np.zeros((len(points), 3)),
        residual_2d_px=residual,
        residual_3d_m=residual,
    )


@pytest.mark.parametrize("method", ["phase-transformer", "zeni-2008", "oconnor-2007"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_foot_that_the_fit_never_saw_takes_no_steps(method, side):
    """The fit moves it all the same, by its priors: here even as it walked."""
    time = np.arange(0, 5, 1 / 30)
    seen = detect_events(feet_from_fit(fit_with_points(time, np.zeros(len(time), bool))), method)
    assert seen.status == "PASS"
    found = detect_events(feet_from_fit(fit_with_points(time, np.ones(len(time), bool), side)), method)
    assert (found.status, found.events, found.reason) == ("EMPTY", (), f"the {side} foot is never seen")


def test_a_foot_out_of_sight_for_a_moment_is_bridged_and_for_longer_is_not():
    time = np.arange(0, 8, 1 / 30)
    whole = feet_from_fit(fit_with_points(time, np.zeros(len(time), bool)))
    short = feet_from_fit(fit_with_points(time, (time > 4) & (time < 4.45)))
    np.testing.assert_array_equal(not_none(short.legs_m), not_none(whole.legs_m))
    long = feet_from_fit(fit_with_points(time, (time > 3) & (time < 5)))
    assert long.legs_m is not None
    hidden = (time > 3.3) & (time < 4.7)
    assert np.isnan(long.legs_m[hidden, 1:, 0]).all()
    assert np.isnan(long.heel_m[hidden, 0]).all()
    assert np.isfinite(long.legs_m[:, :, 1]).all()
    assert np.isfinite(long.legs_m[(time < 3.2) | (time > 4.8)]).all()


def test_the_checks_of_the_fit_lie_beside_it(tmp_path):
    """`pbl gait` obeys the session.json of the fit, as `pbl run` and the tables obey its checks."""
    fit = walk()
    path, out, beside = tmp_path / "walk.fit.npz", tmp_path / "metrics.json", tmp_path / "session.json"
    fit.save(path)
    run = CliRunner()

    def session() -> dict:
        result = run.invoke(gait_command, [str(path), "--out", str(out)], catch_exceptions=False)
        assert result.exit_code == 0
        return json.loads(out.read_text())["session"]

    def write(outcome: str, **changes) -> None:
        check = Check("residual_3d_cm", outcome, 20.0, 6.0, "they disagree")
        save_visit(Visit((Recording.of("walk", fit),), solution_of(fit), (check,)), tmp_path)
        beside.write_text(json.dumps({**json.loads(beside.read_text()), **changes}))

    alone = session()
    assert alone["status"] == "PASS"
    assert {c["check"]: c["outcome"] for c in alone["qc"]}["fit_checks_known"] == "WARN"
    write("WARN")
    good = session()
    assert good["cadence_steps_per_min"] == alone["cadence_steps_per_min"]
    assert {c["check"]: c["outcome"] for c in good["qc"]}["residual_3d_cm"] == "WARN"
    assert "fit_checks_known" not in {c["check"] for c in good["qc"]}
    write("FAIL")
    failed = session()
    assert (failed["status"], failed["outcome"], failed["gdi"]["mean"]) == ("EMPTY", "FAIL", None)
    assert "residual_3d_cm" in failed["reason"]
    for other in ({"trials": ["another"]}, {"params_hash": "another"}):  # of other fits
        write("FAIL", **other)
        assert {c["check"] for c in session()["qc"]} == {c["check"] for c in alone["qc"]}
    for text in ("{", "{}", '{"trials": [], "params_hash": "", "qc": [{"check": 1}]}', "[]"):
        beside.write_text(text)
        with pytest.raises(PblError, match="FILE_FORMAT"):
            session()


def test_an_error_names_the_trial():
    good = walk(4)
    upside_down = make_fit(good.time_s, {**walking(good.time_s), "pelvis_list": np.pi}, name="the second")
    with pytest.raises(PblError, match="GAIT_INPUT") as error:
        gait_metrics([good, upside_down])
    assert error.value.key == "the second"


def test_joints_in_degrees_are_refused():
    fit = walk(4)
    with pytest.raises(PblError, match="GAIT_INPUT") as error:
        gait_metrics([fit, dataclasses.replace(fit, name="degrees", qpos=np.degrees(fit.qpos))])
    assert (error.value.key, "radians" in error.value.expected) == ("degrees", True)
    round_and_round = make_fit(fit.time_s, {**walking(fit.time_s), "pelvis_rotation": 20.0})
    assert gait_metrics([round_and_round]).status == "PASS"
