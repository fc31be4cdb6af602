"""Parameters of the session fit and the named paramsets."""

from __future__ import annotations

import dataclasses
import json
from importlib import resources

from pbl_pipeline.paramset import later

#: By joint, or the beginning of the names of several: what stands at the constants below.
_TABLES = json.loads(resources.files("pbl_pipeline.fit").joinpath("data/joint_sds.json").read_text(encoding="utf-8"))


@dataclasses.dataclass(frozen=True)
class CostParams:
    """Weights and Huber widths of the cost terms (defaults: the paper, section Model Fitting, which has no priors).

    `weight_3d` and `weight_2d` count costs that are means over markers, in cm^2 and px^2; the priors are half sums of
    squares in standard deviations. The 2D cost of 33 independent markers with 5 px noise is about 10 times less than
    its negative log-likelihood, so a prior of weight 0.1 counts as its standard deviations say.

    `pixel`: unit of px, "file", "1080x1920" or "crop"; `metre`: unit of the metres and cm of a single camera's points,
    "detector" or "body" (`units.py`).
    """

    pixel: str = later("file")
    metre: str = later("detector")

    weight_3d: float = 1.0
    weight_2d: float = 0.1
    #: On the marker set's places. 100 is a standard deviation of about 2 cm per axis, by the same count; 25 of 4 cm.
    weight_offset_per_m2: float = 100.0
    weight_phone: float = 1.0
    #: Weight of a 3D distance along the camera's axis relative to one across it.
    depth_ratio: float = 1.0
    huber_3d_cm: float = 10.0
    huber_2d_px: float = 5.0
    weight_pose: float = 0.0
    #: (joint, without its side where it has one; neutral angle in deg; standard deviation in deg) of each with a prior.
    pose_prior_deg: tuple[tuple[str, float, float], ...] = ()
    #: A prior with its full covariance, by name, in the place of those of its joints; none: "".
    pose_prior: str = later("")
    weight_scale: float = 0.0
    #: Of a segment's scale against the whole body's, and of a left segment's against the right one's.
    scale_sd: float = 0.1
    scale_sides_sd: float = 0.02


@dataclasses.dataclass(frozen=True)
class ViewParams:
    """Selection of frames: whole person in view, shorter gaps of partial view bridged (paper, Keypoint Detection).

    `max_blind_s` is our own addition: longer runs in which nothing was detected are left unknown.
    """

    #: Mean over the markers of a frame.
    min_confidence: float = 0.5
    max_gap_s: float = 1.0
    max_blind_s: float = 0.15
    min_in_view_s: float = 1.0


@dataclasses.dataclass(frozen=True)
class ImplicitAdamParams:
    """Solver `implicit-adam`: one network per trial, one body per session, Adam (defaults: the paper)."""

    solver: str = "implicit-adam"
    steps: int = 25_000
    samples_per_trial: int = 300
    learning_rate_start: float = 1e-3
    learning_rate_end: float = 1e-6
    adam_b1: float = 0.8
    weight_decay: float = 1e-5
    clip_norm: float = 0.1
    hidden: tuple[int, ...] = (256, 256, 256, 256)
    n_skip: int = 2
    max_frequency_rad_s: float = 80.0
    pairs_per_octave: int = 2
    #: "paper": pelvis `start_distance_m` ahead of the camera, every angle at the middle of its range.
    #: "keypoints": pelvis position and heading from the keypoints, every other angle at the standing pose.
    start: str = "paper"
    start_distance_m: float = 1.5
    seed: int = 0
    cost: CostParams = CostParams()
    view: ViewParams = ViewParams()


#: Of joints that 33 points, with two on the pelvis, three on a hand and two on a foot, hardly determine: turns of the
#: trunk against the pelvis, turns of a limb about its own axis, sideways joints. Without a prior these absorb the
#: detector's errors (a pelvis tipped back by 25 deg in sitting). Standard deviations are the project's own round
#: numbers, set by anatomy and not by fitting: about the movement of a joint in walking and standing up, together with
#: the differences between people's standing poses. Hip and knee flexion, ankle, shoulders and elbows are seen well and
#: have none, except the turn of the upper arm, which a straight elbow hides. Forearm: 90 deg turns the palms inwards.
#: Lumbar spine: the mean of two walks fitted from a laboratory's markers (-7 and -5 deg; nimblephysics' OpenSim data).
POSE_PRIOR_DEG: tuple[tuple[str, float, float], ...] = tuple((n, *v) for n, v in _TABLES["pose_prior_deg"].items())

#: Factor of `qpos_sd`, per group of joints, unless a paramset has its own: such that 90 % intervals of `gauss-newton` 1
#: held the truth in 90 % of the samples of the synthetic walker, with independent pixel noise.
SD_FACTOR: tuple[tuple[str, float], ...] = tuple(_TABLES["sd_factor"].items())
#: The same for `gauss-newton` with temporally correlated pixel noise (`python -m research.benchmarks.uncertainty`
#: prints them and checks them on other walks).
SD_FACTOR_METRABS: tuple[tuple[str, float], ...] = tuple(_TABLES["sd_factor_metrabs"].items())
#: Least standard deviations of `blazepose` (deg, slides cm): a detector that leans a person, or marks another place
#: than the model, does so in every frame, and no residual shows it. Such that 90 % intervals hold 90 % of the samples
#: of walks seen with the detector's errors: hip, knee and ankle of the tuning persons of `research.corpus --quick`;
#: pelvis, trunk and arms of twelve recorded walks of nine persons, each with a pose prior learned without them; slides,
#: neck, mtp, forearm and wrist of the synthetic walker.
SD_FLOOR_BLAZEPOSE: tuple[tuple[str, float], ...] = tuple(_TABLES["sd_floor_blazepose"].items())


@dataclasses.dataclass(frozen=True)
class GaussNewtonParams:
    """Solver `gauss-newton`: per-frame poses with a prior on their second differences; the paper's costs otherwise."""

    solver: str = "gauss-newton"
    #: At most 200, the space that the solver keeps for its trace.
    max_iterations: int = 60
    #: The solver ends after a step in which no joint moved further (rad; m for the pelvis) ...
    tolerance_rad: float = 1e-3
    #: ... or after three in a row whose gain was below this share of the cost.
    tolerance_cost: float = 1e-5
    #: Weight of half the squared second difference of each joint over frames at 30 Hz, per rad^2 and m^2.
    smooth_per_rad2: float = 200.0
    smooth_per_m2: float = 20_000.0
    #: Of the pelvis' height, which the picture shows better than its depth; 0: `smooth_per_m2`.
    smooth_up_per_m2: float = later(0.0)
    #: Weight of half the squared angle beyond a joint's limit, per deg^2.
    weight_limit_per_deg2: float = 0.1
    #: The angle between fitted and measured camera counts linearly beyond this, as in the paper, and smoothly below.
    huber_phone_deg: float = 0.5
    #: Standard deviation (s) of the offset between the phone's clock and the video's.
    clock_sd_s: float = 0.2
    #: Feet on the floor (`feet_terms.py`): height over it, and movement of a standing sole, per cm^2. 0: none.
    weight_floor: float = 0.0
    weight_slide: float = 0.0
    huber_floor_cm: float = 2.0
    huber_slide_cm: float = 1.0
    slope_sd_deg: float = 5.0
    #: Constant error of a detector's 3D points of one camera over a trial, as unknowns with a prior: a lean of the
    #: whole person, and the depth of each marker. The prior counts as the pose's does. 0: no such unknowns.
    weight_detector: float = later(0.0)
    lean_sd_deg: float = later(5.0)
    depth_sd_m: float = later(0.08)
    #: Of the augmenter's tilt and list of the pelvis if a person sits or squats (`augmented_pelvis.py`): half squares
    #: in standard deviations. 0: the augmenter is not used.
    weight_pelvis: float = later(0.0)
    pelvis_sd_deg: float = later(6.0)
    #: Median residual of a point (px of the cost; cm) at which it counts as `weight_2d` and `weight_3d` say: others
    #: more or less, by the residuals of a first solution to one camera (`measured_weights.py`). 0: all alike.
    points_px: float = later(0.0)
    points_cm: float = later(0.0)
    #: Wearable sensors (`imu_term.py`): half squares in standard deviations, as many keypoint residuals' as they are.
    weight_sensor: float = later(1.0)
    huber_sensor: float = later(3.0)
    #: Standard deviations of how a sensor sits on its segment, found from the video (deg), and of the clock's start (s)
    #: and gain in a minute (s).
    mount_sd_deg: float = later(20.0)
    sensor_clock_sd_s: float = later(0.2)
    sensor_gain_sd_s: float = later(0.006)
    #: Depths (`depth_term.py`): half squares in standard deviations, in the same way; that of a depth (m).
    weight_depth: float = later(1.0)
    huber_depth: float = later(2.0)
    depth_point_sd_m: float = later(0.02)
    #: Share of `depth_ratio` at points whose depth was measured: a detector's own errs for long times.
    depth_ratio_measured: float = later(0.3)
    sd_factor: tuple[tuple[str, float], ...] = SD_FACTOR
    #: Least standard deviation in deg (slides: cm), added in squares: detector errors that are common to many frames,
    #: which averaging does not reduce.
    sd_floor: tuple[tuple[str, float], ...] = ()
    cost: CostParams = CostParams()
    view: ViewParams = ViewParams()


#: The paper's own. Its pixels are those of pictures of 1080 x 1920, so in a picture of another size they count as many
#: of the file as make the same share of it. With `pixel="file"` they count as they are, as version 1 did.
PAPER_2025 = ImplicitAdamParams(cost=CostParams(pixel="1080x1920"))
#: The paper's costs unchanged, for comparison: the optimum of `paper-2025` found by `gauss-newton`.
PAPER_GAUSS_NEWTON = GaussNewtonParams(smooth_per_rad2=30.0, smooth_per_m2=3_000.0, cost=CostParams(pixel="1080x1920"))
#: For 87 points of MeTRAbs. Pixels count more against 3D than in the paper, and depth less than what lies across the
#: line of sight, because it errs more and together (research/reports). Tuned on the synthetic walker, with temporally
#: correlated and with independent pixel noise. With a gain of 1e-5 as the end, wrists were 0.1 deg short of where one
#: step more, or other padding, had them.
GAUSS_NEWTON = GaussNewtonParams(
    tolerance_cost=1e-6,
    smooth_per_rad2=150.0,
    sd_factor=SD_FACTOR_METRABS,
    cost=CostParams(
        pixel="crop",
        metre="body",
        weight_3d=3.0,
        weight_2d=16.0,
        depth_ratio=0.4,
        huber_3d_cm=8.0,
        huber_2d_px=2.1,
        weight_offset_per_m2=45.0,
    ),
)
#: For BlazePose: its 3D leans and its depths are off in every frame, so both are unknowns; what 33 points leave open is
#: held by postures of people. Its depth is much less certain than its pixels, so it counts half. Its points were marked
#: by eye in pictures and not felt on bone, so they may lie further from the marker set's places than a laboratory's.
#: Weights were chosen on the two phone clips with marker mocap and on recorded walks with the detector's errors,
#: persons held out of the prior (`research.corpus`, research/benchmarks/real_clips); that of the augmenter's pelvis
#: also on recorded squats with the same errors. Its 33 points and their smoothing weigh less than MeTRAbs's 87.
BLAZEPOSE = GaussNewtonParams(
    smooth_per_rad2=20.0,
    weight_floor=0.03,
    weight_slide=0.03,
    weight_detector=0.1,
    weight_pelvis=0.2,
    sd_factor=(),
    sd_floor=SD_FLOOR_BLAZEPOSE,
    cost=CostParams(
        pixel="crop",
        metre="body",
        weight_3d=0.35,
        weight_2d=1.0,
        depth_ratio=0.5,
        huber_2d_px=2.2,
        weight_offset_per_m2=40.0,
        weight_pose=0.07,
        pose_prior_deg=POSE_PRIOR_DEG,
        pose_prior="people-3",
        weight_scale=0.1,
    ),
)
#: `BLAZEPOSE` with weights that follow the errors of each point: points that fit well count more against priors, and
#: what was steady only by smoothing may move. Chosen on the walk of the two phone clips (research/reports).
BLAZEPOSE_MEASURED = dataclasses.replace(
    BLAZEPOSE,
    smooth_per_rad2=5.0,
    smooth_up_per_m2=2_000.0,
    points_px=1.0,
    points_cm=1.5,
    cost=dataclasses.replace(BLAZEPOSE.cost, weight_offset_per_m2=30.0),
)
#: For markers of a laboratory, known to millimetres but placed by hand; a marker that jumped counts little. Postures of
#: people hold what few markers leave open, such as the tilt of a pelvis seen as two hip centres. The neutral angle of
#: the toes is the mean of a walk; with 0, ankles of feet with one marker on the toes were 1 deg further dorsiflexed.
MARKERS = GaussNewtonParams(
    smooth_per_rad2=2.0,
    smooth_per_m2=200.0,
    cost=CostParams(
        huber_3d_cm=3.0,
        weight_offset_per_m2=100.0,
        weight_pose=0.01,
        pose_prior_deg=(*POSE_PRIOR_DEG, ("mtp_angle", 10.0, 20.0)),
        pose_prior="people-3",
        weight_scale=0.01,
    ),
)

Params = GaussNewtonParams | ImplicitAdamParams
