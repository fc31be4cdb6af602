"""Forces and moments against closed forms, the motion's own momentum, and what must not be computed."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import SCALE_NAMES, load_body, stature_m
from pbl_pipeline.cli.gait import gait as gait_command
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitEvent, gait_metrics
from pbl_pipeline.kinetics import (
    GRAVITY,
    JOINTS,
    MEASURES,
    METHODS,
    MOMENTS,
    TOO_UNCERTAIN,
    Dynamics,
    Kinetics,
    Motion,
    contact_of,
    ground_reaction,
    inverse_dynamics,
    leg_moments,
    segment_inertia,
    smooth_motion,
    visit_kinetics,
)
from pbl_pipeline.kinetics.compute import HEALTHY_SD, trial_series
from pbl_pipeline.kinetics.dynamics import _dynamic_model
from pbl_pipeline.kinetics.ground import PROGRESS, TRANSIENT
from pbl_pipeline.kinetics.vertical import (
    Noise,
    VerticalModel,
    dimensionless_speed,
    load_vertical_model,
    support_phase,
    vertical_force,
)
from pbl_pipeline.names import check_mass
from pbl_pipeline.report import write_report
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.visit import Recording, Visit, load_kinetics, save_kinetics
from research.benchmarks.kinetics_phone import tilted, vertical_rms
from research.corpus.walks import Walk, synthetic_walk
from tests import not_none
from tests.walking_fit import walking_fit

BODY = load_body()
ONE = np.ones(8)
SCALE = np.array([0.9, 0.95, 0.85, 0.9, 0.86, 0.91, 0.88, 0.87])


def still(n: int = 5, **joints: float) -> Motion:
    """A motion that rests in one pose."""
    qpos = np.zeros((n, len(BODY.joint_names)))
    for name, value in joints.items():
        qpos[:, BODY.joint_names.index(name)] = value
    return Motion(np.arange(n) / 100, qpos, np.zeros_like(qpos), np.zeros_like(qpos))


def dynamics_of(motion: Motion, scale: np.ndarray = ONE) -> Dynamics:
    return inverse_dynamics(BODY, scale, motion)


# ------------------------------------------------------------------------------------------------------------- inertia
def test_the_masses_are_those_of_the_paper() -> None:
    found = segment_inertia(BODY, SCALE)
    assert found.mass.sum() == pytest.approx(1.0, abs=1e-12)
    names = BODY.body_names
    # Mean of women and men (de Leva 1996, table 4), before the sum is brought to 1 (women's and men's add to 1.0000).
    assert found.mass[names.index("femur_l")] == pytest.approx(0.5 * (0.1478 + 0.1416), abs=2e-4)
    assert found.mass[names.index("tibia_r")] == pytest.approx(0.5 * (0.0481 + 0.0433), abs=2e-4)
    trunk = found.mass[[names.index("pelvis"), names.index("torso")]].sum()
    assert trunk == pytest.approx(0.5 * (0.4257 + 0.4346), abs=5e-4)
    feet = [names.index(f"{n}_l") for n in ("talus", "calcn", "toes")]
    assert found.mass[feet].sum() == pytest.approx(0.5 * (0.0129 + 0.0137), abs=1e-4)


def test_the_thigh_scales_with_its_length() -> None:
    thigh = BODY.body_names.index("femur_r")
    longer = ONE.copy()
    longer[SCALE_NAMES.index("right_thigh")] = 1.2
    plain, long = segment_inertia(BODY, ONE), segment_inertia(BODY, longer)
    assert long.centre_m[thigh] == pytest.approx(1.2 * plain.centre_m[thigh])
    assert long.moment_m2[thigh] == pytest.approx(1.44 * plain.moment_m2[thigh])
    length = np.linalg.norm(BODY.mj_model.body_pos[BODY.body_names.index("tibia_r") + 1])
    assert plain.centre_m[thigh, 1] == pytest.approx(-0.5 * (0.3612 + 0.4095) * length, rel=1e-4)


def test_a_standing_body_has_its_centre_of_mass_where_people_have_it() -> None:
    centre = dynamics_of(still()).centre_m[0, 2]
    feet = dynamics_of(still()).xpos[0, BODY.body_names.index("calcn_l"), 2]
    # 55 to 59 % of the height above the floor (Hay, The Biomechanics of Sports Techniques).
    assert 0.54 < (centre - feet) / stature_m(BODY, ONE) < 0.60


# ------------------------------------------------------------------------------------------------------------ dynamics
def test_standing_needs_the_weight_through_the_centre_of_mass() -> None:
    d = dynamics_of(still(), SCALE)
    assert d.force_n == pytest.approx(np.tile([0, 0, GRAVITY], (5, 1)), abs=1e-6)
    assert d.moment_nm == pytest.approx(np.cross(d.centre_m, d.force_n), abs=1e-6)


def test_a_falling_body_needs_nothing() -> None:
    motion = still(hip_flexion_l=0.4, lumbar_bending=0.2)
    motion.qacc[:, BODY.joint_names.index("pelvis_ty")] = -GRAVITY
    d = dynamics_of(motion)
    assert d.force_n == pytest.approx(np.zeros((5, 3)), abs=1e-6)
    assert d.generalised == pytest.approx(np.zeros_like(d.generalised), abs=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.1])
def test_a_swinging_shank_is_a_pendulum(angle: float) -> None:
    # The thigh hangs upright and rests; shank and foot swing about the knee as one body.
    knee = BODY.joint_names.index("knee_angle_r")
    motion = still(knee_angle_r=-angle)
    motion.qvel[:, knee], motion.qacc[:, knee] = 1.7, -4.2
    d = dynamics_of(motion)
    inertia = segment_inertia(BODY, ONE)
    parts = [BODY.body_names.index(f"{n}_r") for n in ("tibia", "talus", "calcn", "toes")]
    anchor, axis = d.anchor_m[0, knee], d.axis[0, knee]
    moment_of_inertia = weight = 0.0
    for b in parts:
        lever = d.xpos[0, b] + d.xmat[0, b] @ inertia.centre_m[b] - anchor
        across = lever - (lever @ axis) * axis
        turned = d.xmat[0, b].T @ axis
        moment_of_inertia += turned @ (inertia.moment_m2[b] * turned) + inertia.mass[b] * across @ across
        weight += np.cross(lever, [0, 0, -GRAVITY * inertia.mass[b]]) @ axis
    assert d.generalised[0, knee] == pytest.approx(moment_of_inertia * -4.2 - weight, abs=1e-6)


def test_the_generalised_forces_are_mujocos() -> None:
    truth = synthesise(SynthSpec(seed=3, seconds=2, fps=100, noise="none")).truth
    (motion,), model = smooth_motion(truth.time_s, truth.qpos, 6.0), _dynamic_model(BODY, tuple(truth.scale.tolist()))
    data, found = mujoco.MjData(model), dynamics_of(motion, truth.scale).generalised
    for row, *values in zip(found, motion.qpos, motion.qvel, motion.qacc, strict=True):
        data.qpos, data.qvel, data.qacc = values
        mujoco.mj_inverse(model, data)
        assert row == pytest.approx(data.qfrc_inverse, abs=1e-9)


def test_the_force_is_the_change_of_momentum_of_a_walker() -> None:
    truth = synthesise(SynthSpec(seed=3, seconds=4, fps=100, noise="none")).truth
    motion = smooth_motion(truth.time_s, truth.qpos, 6.0)[0]
    inertia = segment_inertia(BODY, truth.scale)
    d = inverse_dynamics(BODY, truth.scale, motion)
    centres = d.xpos + np.einsum("nbij,bj->nbi", d.xmat, inertia.centre_m)
    centre = np.einsum("b,nbi->ni", inertia.mass, centres)
    change = make_interp_spline(motion.time_s, centre, k=5).derivative(2)(motion.time_s) + np.array([0, 0, GRAVITY])
    inside = slice(10, -10)
    assert np.abs(change - d.force_n)[inside].max() < 0.01 * GRAVITY


def test_derivatives_are_those_of_a_known_motion() -> None:
    time = np.arange(300) / 60
    qpos = np.zeros((300, 40))
    qpos[:, 7] = 0.3 * np.sin(2 * np.pi * 1.0 * time)
    motion = smooth_motion(time, qpos, 20.0)[0]
    inside = (motion.time_s > 0.5) & (motion.time_s < 4.0)
    expected = -0.3 * (2 * np.pi) ** 2 * np.sin(2 * np.pi * motion.time_s)
    assert motion.qacc[inside, 7] == pytest.approx(expected[inside], abs=0.01 * 0.3 * (2 * np.pi) ** 2)


def test_a_gap_splits_the_motion_and_a_short_one_is_none() -> None:
    time = np.arange(400) / 100
    qpos = np.zeros((400, 40))
    qpos[180:230] = np.nan
    assert [len(m.time_s) for m in smooth_motion(time, qpos, 6.0)] == [180, 170]
    assert smooth_motion(time[:80], qpos[:80], 6.0) == []


# -------------------------------------------------------------------------------------------------------------- ground
#: Frames of standing on the right foot.
ON_RIGHT = np.tile([0.0, 1.0], (50, 1))


def right_both_left() -> np.ndarray:
    """Contact (60, 2) of 20 frames each on the right foot, on both and on the left."""
    contact = np.ones((60, 2))
    contact[:20, 0] = contact[40:, 1] = 0
    return contact


def event(time_s: float, side: str, kind: str) -> GaitEvent:
    return GaitEvent(time_s, side, f"foot_{kind}", 1.0)


def test_contact_follows_the_events_and_is_unknown_elsewhere() -> None:
    events = [
        event(0.10, "left", "down"),
        event(0.20, "right", "up"),
        event(0.50, "right", "down"),
        event(0.60, "left", "up"),
    ]
    contact = contact_of(np.array([0.05, 0.15, 0.3, 0.55, 0.7]), events)
    assert np.isnan(contact[[0, 4]]).all()
    assert contact[1:4].tolist() == [[1, 1], [1, 0], [1, 1]]
    # An event is missing: between two initial contacts of a side its state is not known.
    twice = contact_of(np.array([0.3]), [event(0.1, "left", "down"), event(0.5, "left", "down")])
    assert np.isnan(twice[0, 0])


def test_on_one_foot_that_foot_carries_everything() -> None:
    ground = ground_reaction(BODY, ONE, dynamics_of(still(n=50)), ON_RIGHT)
    assert ground.force_n[:, 1, 2] == pytest.approx(np.full(50, GRAVITY))
    assert not ground.force_n[:, 0].any()
    assert np.isnan(ground.centre_m[:, 0]).all()
    assert ground.residual_n[:, 2] == pytest.approx(np.zeros(50), abs=1e-9)


def test_on_both_feet_the_forces_add_up_and_change_over() -> None:
    ground = ground_reaction(BODY, ONE, dynamics_of(still(n=60)), right_both_left())
    assert ground.force_n[:, :, 2].sum(axis=1) == pytest.approx(np.full(60, GRAVITY), abs=1e-9)
    behind = ground.force_n[20:40, 1, 2]
    assert (np.diff(behind) < 0).all()
    assert behind[0] > 0.8 * GRAVITY > 0.1 * GRAVITY > behind[-1]


def test_unknown_contact_has_no_force() -> None:
    contact = np.ones((30, 2))
    contact[10:20, 0] = np.nan
    ground = ground_reaction(BODY, ONE, dynamics_of(still(n=30)), contact)
    assert np.isnan(ground.force_n[10:20]).all()
    assert np.isfinite(ground.force_n[:10]).all()
    assert np.isnan(ground.residual_n[10:20]).all()


def test_the_centre_of_pressure_stays_under_the_sole() -> None:
    n = 100
    contact = np.tile([1.0, 0.0], (n, 1))
    contact[[0, -1]] = [0.0, 1.0]
    d = dynamics_of(still(n=n))
    ground = ground_reaction(BODY, ONE, d, contact)
    heel = d.xpos[50, BODY.body_names.index("calcn_l")]
    along = ground.centre_m[1:-1, 0] - heel
    assert -0.03 < along[0, 0] < 0.06
    assert 0.22 < along[-1, 0] < 0.27
    assert (np.diff(along[:, 0]) > -1e-9).all()
    assert np.abs(along[:, 1]).max() < 0.04
    assert PROGRESS[:, 1].min() >= 0
    assert PROGRESS[:, 1].max() <= 1


def test_what_is_added_as_feet_land_takes_no_weight() -> None:
    double, single = (np.trapezoid(course, np.linspace(0, 1, len(course))) for course in TRANSIENT)
    share = 0.13  # of double support in a step of those children
    assert abs(share * double + (1 - share) * single) < 0.01


def test_a_foot_that_lands_does_not_push_backwards_at_once() -> None:
    behind = still(n=60, hip_flexion_l=0.4, hip_flexion_r=-0.4)  # the right foot
    ground = ground_reaction(BODY, ONE, dynamics_of(behind), right_both_left())
    landed = -ground.force_n[:, 0, 0] / ground.force_n[:, 0, 2].clip(1e-6)  # backwards, of the vertical force
    assert landed[21] < 0.6 * landed[39]


# -------------------------------------------------------------------------------------------------------------- joints
def test_moments_of_standing_on_one_leg_by_hand() -> None:
    motion = still(n=50)
    d = dynamics_of(motion)
    ground = ground_reaction(BODY, ONE, d, ON_RIGHT)
    moment, power = leg_moments(BODY, d, ground, motion)
    at = 25
    inertia = segment_inertia(BODY, ONE)
    ankle = d.xpos[at, BODY.body_names.index("talus_r")]
    axis = d.axis[at, BODY.joint_names.index("ankle_angle_r")]
    # The joint balances the moments of the foot's weight and of the ground about it.
    outside = np.cross(ground.centre_m[at, 1] - ankle, ground.force_n[at, 1])
    for name in ("talus_r", "calcn_r", "toes_r"):
        b = BODY.body_names.index(name)
        lever = d.xpos[at, b] + d.xmat[at, b] @ inertia.centre_m[b] - ankle
        outside = outside + np.cross(lever, [0, 0, -GRAVITY * inertia.mass[b]])
    assert moment[at, 1, MOMENTS.index("ankle_angle")] == pytest.approx(-outside @ axis, abs=1e-9)
    assert not power.any()


def test_the_knee_has_the_sign_of_flexion() -> None:
    # Crouching on one leg: the knee is held by its extensors, so its flexing moment is negative.
    motion = still(n=50, hip_flexion_r=0.9, knee_angle_r=-1.4, ankle_angle_r=0.4)
    d = dynamics_of(motion)
    ground = ground_reaction(BODY, ONE, d, ON_RIGHT)
    moment, _ = leg_moments(BODY, d, ground, motion)
    assert MOMENTS[JOINTS.index("knee_angle")] == "knee_flexion"
    assert moment[25, 1, MOMENTS.index("knee_flexion")] < -0.2


# -------------------------------------------------------------------------------------------------------------- visits
@pytest.fixture(scope="module")
def walk() -> TrialFit:
    """A walk whose vertical is measured, with errors of the joint values."""
    fit = walking_fit(BODY.joint_names, BODY.sha256, n_frames=240, start_m=(6.0, -4.5, -0.2))
    sd = np.full_like(fit.qpos, 0.01)
    return dataclasses.replace(fit, orientation_source="measured: phone", qpos_sd=sd, height_m=1.8)


def kinetics_of(fit: TrialFit, **kwargs):
    return visit_kinetics([fit], gait_metrics([fit]).trials, METHODS.find(), **kwargs)


@pytest.fixture(scope="module")
def found(walk: TrialFit) -> Kinetics:
    """The kinetics of the walk, of a person of 70 kg."""
    return kinetics_of(walk, mass_kg=70.0)


def test_a_walk_has_measures_with_intervals(walk: TrialFit, found: Kinetics) -> None:
    assert found.status == "PASS"
    assert found.mass_kg == 70.0
    by_markers = kinetics_of(dataclasses.replace(walk, orientation_source="measured: calibration")).measures
    peak = by_markers["vertical_peak_loading_bw"]
    assert 0.9 < peak.mean < 1.6
    low, high = not_none(peak.interval)
    assert low < peak.mean < high
    impulse = found.measures["vertical_impulse_bw_s"]
    # Over a stride both feet carry the weight: half a stride each.
    assert impulse.mean == pytest.approx(0.55, abs=0.05)
    assert by_markers["braking_impulse_bw_s"].mean < 0 < by_markers["propulsion_impulse_bw_s"].mean
    assert not_none(found.residual_bw) < 0.2
    cycle = next(c for c in found.trials[0].cycles if c.used)
    assert cycle.curves["force_vertical_bw"].shape == (51,)
    assert (cycle.curves_sd["force_vertical_bw"] > 0).any()


@pytest.mark.parametrize("tilt_deg", [-1.0, 1.0])
def test_a_vertical_that_is_off_hardly_changes_the_excursion(tilt_deg: float) -> None:
    """The world turned across the way: the height of the centre of mass rises or falls by 2 cm in each stride."""
    known = dataclasses.replace(synthetic_walk(3).fit(), orientation_source="measured: phone")
    true, off = (kinetics_of(f).measures["centre_of_mass_excursion_m"] for f in (known, tilted(known, tilt_deg)))
    assert 0.02 < true.mean < 0.07
    assert (off.left, off.right) == pytest.approx((true.left, true.right), abs=0.003)


def test_the_result_is_the_same_every_time_and_needs_no_mass(walk: TrialFit, found: Kinetics) -> None:
    again = kinetics_of(walk)
    assert (found.mass_kg, again.mass_kg) == (70.0, None)
    assert found.measures == again.measures


def test_what_is_less_certain_than_healthy_people_differ_is_left_out(walk: TrialFit) -> None:
    name = "knee_adduction_moment_peak_nm_per_kg"
    metric = dataclasses.replace(walk, orientation_source="measured: calibration", qpos_sd=0.1 * walk.qpos_sd)
    known = kinetics_of(metric)
    assert known.measures[name].interval is not None
    found = kinetics_of(walk)
    assert found.measures.keys().isdisjoint({name})
    assert found.reasons[name] == TOO_UNCERTAIN
    nothing = kinetics_of(dataclasses.replace(metric, qpos_sd=np.full_like(walk.qpos, 10.0)))
    assert (nothing.status, nothing.code) == ("EMPTY", "NOT_OBSERVED")
    for measure, own in known.measures.items():
        low, high = own.interval or (0.0, 0.0)
        assert high - low <= 2 * 1.96 * HEALTHY_SD[measure]


def test_a_fit_without_errors_has_no_intervals(walk: TrialFit) -> None:
    found = kinetics_of(dataclasses.replace(walk, qpos_sd=np.full_like(walk.qpos, np.nan)))
    assert found.measures["vertical_impulse_bw_s"].interval is None
    # The error of one camera in any walk is known all the same.
    assert found.reasons["ankle_push_off_power_w_per_kg"] == TOO_UNCERTAIN


@pytest.mark.parametrize(
    ("change", "aid", "code"),
    [
        ({"orientation_source": "assumed: level"}, "", "VERTICAL_UNKNOWN"),
        ({"camera_motion": "handheld"}, "", "MOVING_CAMERA"),
        ({}, "cane", "AID"),
    ],
)
def test_what_cannot_have_forces_says_why(walk: TrialFit, change: dict, aid: str, code: str) -> None:
    found = kinetics_of(dataclasses.replace(walk, **change), aid=aid)
    assert (found.status, found.code) == ("EMPTY", code)
    assert found.measures == {}
    assert set(found.reasons) == set(MEASURES)


def test_an_ankle_that_is_not_observed_has_no_forces(walk: TrialFit) -> None:
    sd = np.full_like(walk.qpos, np.radians(2))
    sd[:, BODY.joint_names.index("ankle_angle_l")] = np.radians(25)
    found = kinetics_of(dataclasses.replace(walk, qpos_sd=sd))
    assert (found.code, found.measures) == ("NOT_OBSERVED", {})


def test_a_treadmill_has_no_forces(walk: TrialFit) -> None:
    still_standing = walk.qpos.copy()
    tz = BODY.joint_names.index("pelvis_tx")
    still_standing[:, [tz, tz + 1]] = still_standing[0, [tz, tz + 1]]
    found = kinetics_of(dataclasses.replace(walk, qpos=still_standing))
    assert found.status == "EMPTY"
    assert found.code in ("TREADMILL", "NO_CYCLES")


def test_standing_has_no_forces() -> None:
    fit = walking_fit(BODY.joint_names, BODY.sha256, walks=False)
    found = kinetics_of(dataclasses.replace(fit, orientation_source="measured: phone"))
    assert (found.status, found.code) == ("EMPTY", "NO_CYCLES")


def test_lost_frames_in_a_stance_leave_that_cycle_out(walk: TrialFit) -> None:
    gait = gait_metrics([walk])
    used = [c for c in gait.trials[0].cycles if c.used]
    lost = walk.qpos.copy()
    middle = used[0].start_s + 0.3
    lost[(walk.time_s > middle) & (walk.time_s < middle + 0.25)] = np.nan
    found = visit_kinetics([dataclasses.replace(walk, qpos=lost)], gait.trials, METHODS.find())
    cycle = next(c for c in found.trials[0].cycles if c.number == used[0].number)
    assert not cycle.measures
    assert cycle.missing


def test_mujoco_is_asked_without_joint_limits() -> None:
    # A knee beyond its limit: no constraint force may enter the inverse dynamics.
    knee = BODY.joint_names.index("knee_angle_r")
    limit = BODY.joint_range_rad[knee, 1]
    below, above = (dynamics_of(still(knee_angle_r=limit + x)).generalised[0, knee] for x in (-1e-4, 1e-4))
    assert below == pytest.approx(above, abs=1e-3)


@pytest.mark.parametrize("mass_kg", [0.07, 4.0, 700.0, float("nan")])
def test_a_mass_that_no_person_has_is_refused(mass_kg: float) -> None:
    with pytest.raises(PblError, match=r"^FIT_INPUT: "):
        check_mass(mass_kg)
    check_mass(None)
    check_mass(68.5)


def test_pbl_gait_writes_kinetics_beside_the_fits_and_keeps_the_mass(
    walk: TrialFit, found: Kinetics, tmp_path: Path
) -> None:
    walk.save(tmp_path / "walk.fit.npz")
    save_kinetics(dataclasses.replace(found, trials=()), tmp_path)
    done = CliRunner().invoke(gait_command, [str(tmp_path / "walk.fit.npz"), "--out", str(tmp_path / "metrics.json")])
    assert done.exit_code == 0, done.output
    written = not_none(load_kinetics(tmp_path, ["walk"]))
    assert written.mass_kg == 70.0
    assert written.measures.keys() == found.measures.keys()
    series = not_none(written.trials[0].series)
    assert series.force_bw.shape == (len(series.time_s), 2, 3)


def test_kinetics_of_other_recordings_are_refused(found: Kinetics, tmp_path: Path) -> None:
    save_kinetics(found, tmp_path)
    with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
        load_kinetics(tmp_path, ["another"])
    assert load_kinetics(tmp_path / "empty", ["walk"]) is None


def test_the_report_shows_forces_with_intervals_and_newtons(walk: TrialFit, found: Kinetics, tmp_path: Path) -> None:
    gait = gait_metrics([walk])
    visit = Visit((Recording.of("walk", walk),)).with_measures(gait)
    visit = dataclasses.replace(visit, kinetics=found)
    page = write_report(tmp_path / "report.html", visit).read_text()
    assert "Forces and joint moments" in page
    assert "1 BW is 686 N" in page
    assert page.count(f"Not known ({TOO_UNCERTAIN})") == 1
    nothing = dataclasses.replace(visit, kinetics=visit_kinetics([walk], gait.trials, METHODS.find(), aid="walker"))
    assert "No forces: a walking aid" in write_report(tmp_path / "aid.html", nothing).read_text()


# --- The vertical force of one camera's motion, weighed against how people's force varies, against closed forms.


SHIPPED = load_vertical_model(METHODS.find().params.vertical_model)
NOISE = SHIPPED.noise["blazepose_33"]
SPEED = SHIPPED.speed
N = 300


def steps(n: int = N) -> np.ndarray:
    """Feet on the floor of steps of 0.6 s, of which the first 0.12 s on both."""
    i = np.arange(n)
    both, left = i % 60 < 12, (i // 60) % 2 == 0
    return np.stack([both | left, both | ~left], axis=1)


#: Force of the model's persons over such steps.
USUAL = np.interp(support_phase(steps()), SHIPPED.phase, SHIPPED.expected(SPEED))


def levels(sd: float) -> VerticalModel:
    """A model in which persons differ by a constant force alone."""
    ones = np.ones_like(SHIPPED.phase)
    return dataclasses.replace(
        SHIPPED, mean=ones, slope=0 * ones, person=sd * ones[:, None], step_sd=0.0, noise_memory_s=1e-3
    )


def test_the_posterior_of_a_constant_is_the_closed_form() -> None:
    sd, noise, m = 0.1, Noise(0.3, 0.8, 1.0, 1e-3), N // 3
    found = vertical_force(np.full(N, 1.2), steps(), SPEED, levels(sd), noise)
    kept = noise.gain**2 * sd**2 * m / (noise.gain**2 * sd**2 * m + noise.sd**2)
    np.testing.assert_allclose(found.mean, 1.0 + kept * 0.2 / noise.gain, atol=1e-6)
    rng = np.random.default_rng(0)
    drawn = np.array([found.draw(rng)[0] for _ in range(2000)])
    assert drawn.mean() == pytest.approx(found.mean[0], abs=0.003)
    assert drawn.std() == pytest.approx(sd * np.sqrt(1.0 - kept), rel=0.05)


def test_what_is_certain_stays() -> None:
    needed = USUAL + 0.3 * np.sin(2 * np.pi * 1.3 * np.arange(N) / 100)  # another rhythm than that of the steps
    found = vertical_force(needed, steps(), SPEED, SHIPPED, Noise(1e-5, 1.0, 1.0, 1e-3))
    np.testing.assert_allclose(found.mean[::3], needed[::3], atol=1e-3)
    assert np.sqrt(np.mean((found.mean - needed) ** 2)) < 0.02
    assert np.abs(found.draw(np.random.default_rng(0)) - found.mean)[::3].max() < 0.001


def test_only_one_camera_with_known_noise_and_a_stated_error_is_weighed(walk: TrialFit) -> None:
    params = METHODS.find().params
    fit = dataclasses.replace(walk, marker_set="blazepose_33")
    events = gait_metrics([fit]).trials[0].events.events

    def vertical(**changes) -> np.ndarray:
        changed = dataclasses.replace(fit, **changes)
        series = trial_series(BODY, changed, np.asarray(fit.qpos, float), events, params)
        return not_none(series).force_bw[:, :, 2].sum(axis=1)

    needed = vertical(orientation_source="measured: calibration")
    assert np.nanmax(np.abs(vertical() - needed)) > 0.02
    for changes in ({"marker_set": "bml_movi_87"}, {"qpos_sd": np.full_like(fit.qpos, np.nan)}):
        np.testing.assert_array_equal(vertical(**changes), needed)


@pytest.mark.parametrize("name", ["vertical-force-1", "vertical-force-2"])
def test_the_models_of_stored_methods_stay(name: str) -> None:
    assert load_vertical_model(name).name == name


def test_a_force_unlike_that_of_healthy_people_survives() -> None:
    """A person whose force hardly changes, as few at that speed, keeps most of that."""
    found = vertical_force(np.ones(N), steps(), SPEED, SHIPPED, NOISE)
    assert np.std(found.mean) < 0.4 * np.std(USUAL)


def test_a_push_off_unlike_that_of_the_persons_of_the_model_survives() -> None:
    lower = -0.2 * np.exp(-0.5 * ((support_phase(steps()) - 1.85) / 0.12) ** 2)
    smoothed = gaussian_filter1d(USUAL + lower - 1.0, 100 * NOISE.smoothing_s)
    found = vertical_force(1.0 + NOISE.gain * smoothed, steps(), SPEED, SHIPPED, NOISE)
    assert np.sum(lower * (found.mean - USUAL)) > 0.7 * np.sum(lower**2)


def test_the_smoothing_of_a_fit_is_undone() -> None:
    sharp = USUAL + 0.1 * np.sin(2 * np.pi * np.arange(N) / 20)  # 5 Hz
    known = Noise(3e-3, 0.9, 1.0, 0.03)
    needed = 1.0 + known.gain * gaussian_filter1d(sharp - 1.0, 100 * known.smoothing_s)
    found = vertical_force(needed, steps(), SPEED, SHIPPED, known)
    assert np.std(found.mean - sharp) < 0.2 * np.std(needed - sharp)


def test_noise_is_weighed_against_people() -> None:
    off = np.repeat(np.random.default_rng(1).normal(0.0, NOISE.sd, N // 6), 6)
    found = vertical_force(1.0 + NOISE.gain * (USUAL - 1.0) + off, steps(), SPEED, SHIPPED, NOISE)
    assert np.std(found.mean - USUAL) < 0.7 * np.std(off)


def test_the_benchmark_compares_only_times_that_the_phone_saw(walk: TrialFit) -> None:
    exact = dataclasses.replace(walk, qpos_sd=np.full_like(walk.qpos, np.nan))
    per_frame = {n: np.asarray(getattr(exact, n))[:160] for n in ("time_s", "qpos", "qpos_sd")}
    events = gait_metrics([walk]).trials[0].events.events
    known = Walk("a", "synthetic", "healthy", 0.0, walk.time_s, walk.qpos, walk.scale, events)
    assert vertical_rms(known, dataclasses.replace(exact, **per_frame), exact) < 3.0


def test_where_no_foot_stands_the_force_is_as_it_was() -> None:
    stands = steps()
    stands[100:150] = False
    needed = np.linspace(0.8, 1.2, N)
    found = vertical_force(needed, stands, SPEED, SHIPPED, NOISE)
    np.testing.assert_array_equal(found.mean[100:150], needed[100:150])
    assert not np.allclose(found.mean[:100], needed[:100])


def test_a_support_that_is_seen_in_part_lasts_as_long_as_the_others() -> None:
    phase = support_phase(steps()[30:])
    assert phase[0] == pytest.approx(1.0 + (30 - 12 + 0.5) / 48)
    assert phase[30] == pytest.approx(0.5 / 12)
    assert np.isnan(support_phase(np.zeros((5, 2), bool))).all()


def test_speed_has_no_unit_and_beyond_the_walks_of_the_model_the_nearest_counts() -> None:
    centre = np.zeros((100, 3))
    centre[:, 1] = -1.2 * np.arange(100) / 100
    assert dimensionless_speed(centre, 1.8) == pytest.approx(1.2 / np.sqrt(9.80665 * 1.8))
    low, high = SHIPPED.speed_range
    np.testing.assert_array_equal(SHIPPED.expected(0.5 * low), SHIPPED.expected(low))
    assert np.ptp(SHIPPED.expected(high)) > 2 * np.ptp(SHIPPED.expected(low))


def test_long_recordings_are_estimated_in_parts() -> None:
    n = 4000
    time = np.arange(n) / 100
    needed = 1.0 + 0.1 * np.sin(2 * np.pi * time / 0.6)
    found = vertical_force(needed, steps(n), SPEED, SHIPPED, NOISE)
    onset = slice(59, None, 60)  # of double support
    assert np.delete(np.abs(np.diff(found.mean)), np.arange(n - 1)[onset]).max() < 0.15
    assert found.draw(np.random.default_rng(0)).shape == (n,)
