"""Checks of a session fit. Thresholds are the project's own unless a source is named."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import stature_m
from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers
from pbl_pipeline.qc import FAIL, PASS, WARN, Check, warn_if
from pbl_pipeline.results import DepthFit, SensorFit

from .augmented_pelvis import folds
from .initial_pose import pelvis_path
from .problem import CLOCK_RANGE_S
from .results import SD_WARN_DEG, TrialFit
from .session import GAIT, LEVEL, Session, has_3d
from .solution import Solution
from .world_checks import WRONG_DEG

#: Median 2D residual as a share of the person's height in the picture: 5 px of a 500 px person is the paper's level.
RESIDUAL_2D_WARN, RESIDUAL_2D_FAIL = 0.02, 0.06
RESIDUAL_3D_WARN_CM, RESIDUAL_3D_FAIL_CM = 6.0, 15.0
IN_VIEW_WARN = 0.5
SCALE_LOW, SCALE_HIGH = 0.8, 1.25
LIMIT_MARGIN_RAD, LIMIT_SHARE = np.deg2rad(1.0), 0.2
#: Fall of the loss over the second half of the steps, as a share of its end. The learning rate decays, so the very end
#: is flat whatever happens; this fall is not. On the demo and on a synthetic walker, joint angles after a fall of 0.07
#: to 0.14 were within 1 deg (median) of those after three times the steps, after 0.16 to 0.28 within 2 deg.
FALL_WARN, TRACE_NEEDED = 0.2, 8
CLOCK_WARN_S = 0.3
#: Of wearable sensors: error in standard deviations, share of frames, turn on the segment in likely ones, bias, and the
#: least angular velocity (rad/s, root mean square) that shows how a sensor sits: people who walk have 1 and more.
SENSOR_Z_WARN, SENSOR_DROPPED_WARN, SENSOR_SLIP_WARN = 1.7, 0.2, 2.5
SENSOR_BIAS_WARN_DEG_S, SENSOR_RATE_WARN = 3.0, 0.3
#: Of depths: error in standard deviations; least shares of the large joints with one, and of depths in sight that lie
#: where the person is (0.94 and more on 16 synthetic walks; with the depths of another walk below 0.9 in 58 of 64);
#: distance of the fit without them over theirs, which a detector's guess of a person's size and a guessed focal length
#: allow.
DEPTH_Z_WARN, DEPTH_USED_WARN, DEPTH_FITS_WARN, DEPTH_LOW, DEPTH_HIGH = 2.5, 0.1, 0.9, 0.65, 1.4
#: Standard deviation of the focal length as a share of it, which is also that of depth and of the person's size.
FOCAL_SD_WARN = 0.02

#: Angle (deg) between where the person faces and the camera's axis, from the front (0) to the side (90), below which
#: one camera without 3D points fails. On synthetic walkers (halpe_26, paramset `blazepose`, three people each), the
#: mean error of hips, knees and ankles with and without 3D was 3.6 and 4.0 deg from the side, 3.9 and 4.8 at 42 to 52
#: deg; from the front 4.2 and 12.1 (knees 10 to 21), from the front at an equal distance 4.0 and 4.8 (knees 6 to 10).
FACING_FAIL_DEG = 30.0
#: A turn of the pelvis (deg) within a time (s) that no person makes. Without 3D points, and points on the feet, a part
#: of a walk may be fitted facing the other way.
TURN_FAIL_DEG, TURN_S = 90.0, 0.2


def check_fit(
    session: Session, trials: Sequence[TrialFit], solution: Solution, taller: float | None = None
) -> tuple[Check, ...]:
    """All checks of one session fit, worst trial per check. `taller`: the person's height over the fitted one's
    (`known_height.in_metres`)."""
    checks = [
        _residual_3d(session, trials, solution.metre),
        _in_view(session),
        _limits(session, trials),
        _converged(solution),
    ]
    checks += _height(session, solution.scale, taller)
    if not isinstance(session.trials[0], WorldMarkers):
        checks = [_residual_2d(session, trials), *checks, _intrinsics(trials), _orientation(trials)]
        checks += [*_depth(session, trials), *_assumed(session)]
    for trial, name in zip(session.trials, session.names, strict=True):
        checks += trial.origin.checks(name) if isinstance(trial, WorldMarkers) else ()
    checks += _vertical(session)
    if solution.qpos_sd is not None:
        checks += [_observed(trials)]
    if solution.pelvis_told is not None:
        checks += _pelvis_told(session, trials, solution.pelvis_told)
    if np.any(np.isfinite([t.phone_clock_offset_s for t in trials])):
        checks += [_clock(trials)]
    checks += _sensors([sensor for trial in trials for sensor in trial.sensors])
    checks += _depths([found for found in solution.depths if found is not None])
    # Only a check that did not pass has advice.
    return tuple(dataclasses.replace(c, advice="") if c.outcome == PASS else c for c in checks)


def _sensors(sensors: Sequence[SensorFit]) -> list[Check]:
    """Checks of wearable sensors; empty if there are none."""
    if not sensors:
        return []
    of = {s.segment: [t for t in sensors if t.segment == s.segment] for s in sensors}
    wrong = [f"{k} moves like {found[0].moves_with}" for k, found in of.items() if found[0].moves_with != k]
    elsewhere = ", ".join(wrong)
    n = len(wrong)
    moved = max((s.rate_rad_s for s in sensors if np.isfinite(s.rate_rad_s)), default=0.0)

    def each(value: Callable[[SensorFit], float], most: float) -> tuple[float, str]:
        """The largest value, and the segments whose value is above the most."""
        known = {k: [x for t in found if np.isfinite(x := value(t))] for k, found in of.items()}
        worst = {k: max(x, default=np.inf) for k, x in known.items()}
        return max(worst.values()), ", ".join(k for k, x in worst.items() if x > most)

    z, loose = each(lambda s: s.z, SENSOR_Z_WARN)
    dropped, lost = each(lambda s: s.dropped, SENSOR_DROPPED_WARN)
    slip, slipped = each(lambda s: s.slip, SENSOR_SLIP_WARN)
    bias, drifting = each(lambda s: float(np.rad2deg(np.max(np.abs(s.bias_rad_s)))), SENSOR_BIAS_WARN_DEG_S)
    off = max((abs(s.off_s) for s in sensors if np.isfinite(s.off_s)), default=0.0)
    return [
        Check(
            "sensors_on_another_segment",
            FAIL if n else PASS,
            float(n),
            0.0,
            f"sensors move like other segments than stated, or sides were exchanged: {elsewhere}",
        ),
        warn_if(
            loose,
            "sensor_misfit_sd",
            z,
            SENSOR_Z_WARN,
            f"sensors move otherwise than their segments: {loose}; loose, on another person, or of another recording",
        ),
        warn_if(
            slipped,
            "sensor_slip_sd",
            slip,
            SENSOR_SLIP_WARN,
            f"sensors turned on their segments during the recording: {slipped}; fix them and record again",
        ),
        warn_if(
            lost,
            "sensor_share_dropped",
            dropped,
            SENSOR_DROPPED_WARN,
            f"sensors did not measure in many frames, do not fit there, or fit the video at several times: {lost}",
        ),
        warn_if(
            drifting,
            "sensor_bias",
            bias,
            SENSOR_BIAS_WARN_DEG_S,
            f"gyroscopes drift: {drifting}; let the sensors lie still for some seconds before they are put on",
        ),
        warn_if(
            moved < SENSOR_RATE_WARN,
            "sensor_rate",
            moved,
            SENSOR_RATE_WARN,
            "a person who hardly moves does not show how the sensors sit, nor their clock: they add next to nothing",
        ),
        warn_if(
            off > CLOCK_RANGE_S,  # by which the fit moves a clock
            "sensor_wall_clock_s",
            off,
            CLOCK_RANGE_S,
            f"by its movement a video lies {off:.0f} s from where its time of recording is in the log of the sensors; "
            "set the clocks of phone and sensors, or name the log of this recording",
        ),
    ]


def _depths(found: Sequence[DepthFit]) -> list[Check]:
    """Checks of the depths; empty if there are none."""
    if not found:
        return []
    used, ratio = min(d.used for d in found), found[0].distance
    fits, z = float(np.nanmin([d.fits for d in found])), float(np.nanmax([d.z for d in found]))
    return [
        Check(
            "depth_distance_ratio",
            PASS if DEPTH_LOW <= ratio <= DEPTH_HIGH else FAIL,
            ratio,
            DEPTH_HIGH if ratio > 1 else DEPTH_LOW,
            "the depths make the person much larger or smaller than people are: their scale, their camera, or a child",
        ),
        warn_if(
            not used >= DEPTH_USED_WARN,
            "depth_share_used",
            used,
            DEPTH_USED_WARN,
            "the depth camera saw few of the joints: film from 2 to 5 m, out of the sun",
        ),
        warn_if(
            not fits >= DEPTH_FITS_WARN,
            "depth_share_on_person",
            fits,
            DEPTH_FITS_WARN,
            "many depths do not lie where the person is: another recording, or pictures that are turned or mirrored",
        ),
        warn_if(
            not z <= DEPTH_Z_WARN,
            "depth_misfit_sd",
            z,
            DEPTH_Z_WARN,
            "the depths differ from the person's movement: another recording, pictures that are late, or loose clothes",
        ),
    ]


def _median(values: np.ndarray) -> np.ndarray:
    """Median of finite values along their first axis, in half of the time of numpy's, which looks for NaN as well."""
    half = len(values) // 2
    parted = np.partition(values, half, axis=0)
    return parted[half] if len(values) % 2 else 0.5 * (parted[:half].max(axis=0) + parted[half])


def _grade(value: float, warn: float, fail: float) -> str:
    return FAIL if not value < fail else WARN if value > warn else PASS


def _residual_2d(session: Session, trials: Sequence[TrialFit]) -> Check:
    shares = []
    for arrays, trial in zip(session.arrays, trials, strict=True):
        seen = (arrays.c_2d > 0) & arrays.used[:, None, None]
        y = np.where(seen, arrays.xy_px[..., 1], np.nan)[seen.any(axis=-1)]
        height = np.median(np.fmax.reduce(y, axis=-1) - np.fmin.reduce(y, axis=-1))
        residual = trial.residual_2d_px
        shares.append(_median(residual[np.isfinite(residual)]) / height)
    value = float(np.max(shares))
    return Check(
        "residual_2d_share_of_body_height",
        _grade(value, RESIDUAL_2D_WARN, RESIDUAL_2D_FAIL),
        value,
        RESIDUAL_2D_WARN,
        "the fitted body does not lie on the person: look at the overlay; wrong person, occlusion or too few steps",
    )


def _residual_3d(session: Session, trials: Sequence[TrialFit], metre: float) -> Check:
    """Check the 3D residual in centimetres of the fit, which are the same for small and tall people."""
    counts = np.asarray(session.markers.weight_3d) > 0
    each = [t.residual_3d_m if counts.all() else t.residual_3d_m[:, counts] for t in trials]
    medians = [100 * _median(seen) / metre for r in each if (seen := r[np.isfinite(r)]).size]
    if not medians:
        # Pixels alone: nothing to compare with.
        return Check("residual_3d_cm", PASS, None, RESIDUAL_3D_WARN_CM, "")
    value = float(np.max(medians))
    return Check(
        "residual_3d_cm",
        _grade(value, RESIDUAL_3D_WARN_CM, RESIDUAL_3D_FAIL_CM),
        value,
        RESIDUAL_3D_WARN_CM,
        "the body and the detector's 3D points disagree: angles towards or away from the camera are uncertain",
    )


def _depth(session: Session, trials: Sequence[TrialFit]) -> list[Check]:
    """Check the view of trials of one camera whose detector has no 3D points; empty if there are none."""
    facing, turns = [], []
    for trial, fit in zip(session.trials, trials, strict=True):
        known = np.isfinite(fit.qpos[:, 0])
        if not isinstance(trial, Keypoints) or has_3d(trial) or not known.any():
            continue
        way = pelvis_path(session.body, np.asarray(fit.qpos[known], float))[1][:, :, 0]
        heading, time = np.unwrap(np.arctan2(way[:, 1], way[:, 0])), np.asarray(fit.time_s)[known]
        turns.append(float(np.rad2deg(np.max(np.abs(np.interp(time + TURN_S, time, heading) - heading)))))
        forward = way.mean(axis=0)
        axis = Rotation.from_quat(fit.phone_quat_wxyz[known], scalar_first=True).apply([0.0, 0.0, 1.0]).mean(axis=0)
        across = np.linalg.norm(np.cross(forward, axis)) / (np.linalg.norm(forward) * np.linalg.norm(axis))
        facing.append(float(np.rad2deg(np.arcsin(min(across, 1.0)))))
    if not facing:
        return []
    value, turn = min(facing), max(turns)
    advice = (
        "the fitted pelvis turns faster than a person can: one view without 3D points, and without points on the feet, "
        "does not always show which way a person faces; use a model with feet, or with 3D"
    )
    fast = Check("pelvis_turn_without_3d_deg", FAIL, turn, TURN_FAIL_DEG, advice)
    return [
        *[fast] * (turn > TURN_FAIL_DEG),
        Check(
            "facing_without_3d_deg",
            WARN if value >= FACING_FAIL_DEG else FAIL,
            value,
            FACING_FAIL_DEG,
            "the keypoint model gives pixels only, and one camera then tells nothing of depth: film from the side, or "
            "use a model with 3D, or several cameras; from the front knee angles come out wrong by 6 to 21 deg",
        ),
    ]


def _in_view(session: Session) -> Check:
    value = float(np.min(session.in_view_share))
    advice = "keep head and feet in the picture; frames without them are not used"
    return warn_if(value < IN_VIEW_WARN, "share_of_frames_with_whole_person", value, IN_VIEW_WARN, advice)


def _scale(scale: np.ndarray) -> Check:
    worst = float(scale[np.argmax(np.abs(np.log(scale)))])
    return Check(
        "scale_furthest_from_1",
        PASS if SCALE_LOW <= worst <= SCALE_HIGH else WARN,
        worst,
        SCALE_HIGH if worst > 1 else SCALE_LOW,
        "a body segment is scaled beyond what adults show: a child, or the camera's focal length is wrong",
    )


def _height(session: Session, scale: np.ndarray, taller: float | None) -> list[Check]:
    """Check the proportions, and a stated height against the observed one."""
    if taller is None:
        return [_scale(scale)]
    return [
        _scale(scale * stature_m(session.body, np.ones_like(scale)) / stature_m(session.body, scale)),
        Check(
            "body_height_stated",
            PASS if SCALE_LOW <= taller <= SCALE_HIGH else FAIL,
            taller,
            SCALE_HIGH if taller > 1 else SCALE_LOW,
            "the stated height is far from what is seen (value: their ratio): a mistyped height, another person, or a "
            "child, whom a phone's detector takes for an adult, and whose index was never validated",
        ),
    ]


def _pelvis_told(session: Session, trials: Sequence[TrialFit], told: np.ndarray) -> list[Check]:
    """Check the trials with sitting or squatting; empty if there are none."""
    folded = [i for i, t in enumerate(trials) if folds(session.body, t.qpos[np.isfinite(t.qpos[:, 0])])]
    silent = sum(not np.any(told[session.frames(i)]) for i in folded)
    check = Check(
        "sitting_trials_without_augmented_pelvis",
        WARN if silent else PASS,
        float(silent),
        0.0,
        "the marker augmenter could not be asked (too short a trial, feet never in view, or a person of a size that it "
        "does not know): how far the pelvis is tipped in sitting is most people's, not this person's",
    )
    return [check] if folded else []


def _limits(session: Session, trials: Sequence[TrialFit]) -> Check:
    low, high = np.asarray(session.body.joint_range_rad).T
    qpos = np.concatenate([t.qpos[np.isfinite(t.qpos[:, 0])] for t in trials])
    share = np.mean((qpos < low + LIMIT_MARGIN_RAD) | (qpos > high - LIMIT_MARGIN_RAD), axis=0)
    names = [n for n, s in zip(session.body.joint_names, share, strict=True) if s > LIMIT_SHARE]
    advice = f"held at a limit in over {LIMIT_SHARE:.0%} of the frames: {', '.join(names)}"
    return warn_if(names, "joints_at_their_limit", float(len(names)), 0.0, advice)


def _converged(solution: Solution) -> Check:
    if solution.qpos_sd is not None:
        advice = "the solver stopped at its bound on steps, not at a minimum: look at the overlay, raise max_iterations"
        return warn_if(not solution.result.converged, "iterations", float(solution.iterations), None, advice)
    loss = solution.loss_trace[:, 1]
    enough = len(loss) >= TRACE_NEEDED
    fall = float(loss[len(loss) // 2 - 1] / loss[-1] - 1) if enough else None
    advice = "the optimisation was still moving: use a paramset with more steps"
    return warn_if(not (fall is not None and fall < FALL_WARN), "loss_fall_over_second_half", fall, FALL_WARN, advice)


def _intrinsics(trials: Sequence[TrialFit]) -> Check:
    sources = sorted({t.camera.source for t in trials if not t.camera.calibrated})
    spread = np.array([t.camera.focal_rel_sd for t in trials])
    worst = float(np.nanmax(spread)) if np.isfinite(spread).any() else None
    unsure = worst is not None and worst > FOCAL_SD_WARN
    advice = (
        f"the focal length is not measured ({'; '.join(sources)}): pass --camera with a calibration (`pbl calibrate`)"
        if sources
        else "the calibration of the camera leaves the focal length uncertain: calibrate again (docs/camera.md)"
    )
    # The value is the standard deviation of the focal length as a share of it.
    return warn_if(sources or unsure, "camera_intrinsics_measured", worst, FOCAL_SD_WARN, advice)


def _assumed(session: Session) -> list[Check]:
    """Report fields of keypoints files that are replaced by a default; empty if all are stated."""
    views = [v for t in session.trials for v in (t.views if isinstance(t, MultiView) else [t])]
    fields = sorted({f for v in views if isinstance(v, Keypoints) for f in v.assumed})
    if not fields:
        return []
    advice = (
        f"the keypoints do not state {', '.join(fields)}: a lens without distortion, an unmeasured camera and "
        "the box around the points stand for them; write the fields (docs/files.md)"
    )
    return [Check("keypoints_fields_assumed", WARN, float(len(fields)), 0.0, advice)]


def _orientation(trials: Sequence[TrialFit]) -> Check:
    sources = {t.orientation_source for t in trials}
    if LEVEL in sources:
        advice = (
            "the camera is taken as level and still: its own tilt adds to the pelvis angles and to positions, not to "
            "the angles between segments (hip, knee, ankle)"
        )
    else:
        advice = (
            "the vertical is taken from the walk, on a level floor by a person who does not lean to a side: a lean of "
            "the trunk to a side is lost; pass the phone's log with --attitude"
        )
    return warn_if(sources & {LEVEL, GAIT}, "camera_orientation_known", None, None, advice)


def _vertical(session: Session) -> list[Check]:
    """Report trials whose vertical axis was wrong and that were turned; empty if there are none."""
    if not session.turned:
        return []
    names = ", ".join(t.name for t in session.turned)
    axes = ", ".join(sorted({t.axis for t in session.turned}))
    advice = f"trial {names}: the body stands along {axes} of the world as read, not along z: turned by right angles"
    return [Check("vertical_from_body", WARN, max(t.off_deg for t in session.turned), WRONG_DEG, advice)]


def _observed(trials: Sequence[TrialFit]) -> Check:
    unseen = [n for n in trials[0].joint_names if any(n in t.not_observed for t in trials)]
    advice = f"standard deviation of {SD_WARN_DEG:.0f} deg and more, angles withheld: {', '.join(unseen)}"
    return warn_if(unseen, "joints_not_observed", float(len(unseen)), 0.0, advice)


def _clock(trials: Sequence[TrialFit]) -> Check:
    offsets = np.array([t.phone_clock_offset_s for t in trials])
    worst = float(offsets[np.nanargmax(np.abs(offsets))])
    advice = "the phone's clock and the video's are far apart: the log may belong to another recording"
    return warn_if(abs(worst) > CLOCK_WARN_S, "phone_clock_offset_s", worst, CLOCK_WARN_S, advice)
