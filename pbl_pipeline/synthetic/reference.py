"""The joint angles that a motion aims at: normal curves by phase and speed, impairments, postures."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import joint_of, load_body
from pbl_pipeline.gait import BODY_ANGLES, LEG_ANGLES, PLUG_IN_GAIT, offset_deg
from pbl_pipeline.gait.normative import GRAVITY, gait_norm, harmonic_sum

from .impair import Style
from .plan import GRID_STEP_S, MIDDLE_CURVES_DEG, OFFSET_SD_DEG, SIDE_CURVES_DEG, Plan, fade, swing, wander, within

#: Curves that drive the pelvis (sign, joint), by the right side's cycle; the model's tilt and list count the other way.
PELVIS = {"pelvis_tilt": (-1, "tilt"), "pelvis_obliquity": (-1, "list"), "pelvis_rotation": (1, "rotation")}
#: How people differ, as fractions of the norm's standard deviation: the mean of a curve, each coefficient of its first
#: harmonics, the mean of one side against the other; and of its range. With these, healthy people of many seeds spread
#: about the norm as the norm's own people do: an index of about 100, standard deviation about 10 (docs/synth.md).
OFFSET_SHARE, SHAPE_SHARE, SIDES_SHARE, RANGE_SD = 1.0, 0.5, 0.2, 0.1
SHAPE_HARMONICS = 2
#: Within a walk: of a curve's range, of its mean (deg), over seconds.
WALK_RANGE_SD, WALK_MEAN_SD_DEG = 0.02, 0.5
_SLOW_HZ = (0.05, 0.7)
#: Standing upright, both sides (deg), as the body's joints count: the pelvis is level (`BODY_ANGLES`).
STANDING_DEG = {
    "hip_flexion": 1.0,
    "knee_flexion": 4.0,
    "ankle_angle": 2.0,
    "tilt": 1.0,
    "lumbar_extension": 0.0,
    "arm_flex": -5.0,
    "elbow_flex": 15.0,
}
#: Further flexion of knee and hip in the swing of a step without walking speed (deg).
STEP_KNEE_DEG, STEP_HIP_DEG = 40.0, 22.0
#: Hip rotation of a foot that points ahead, against the norm's mean (deg).
HIP_ROTATION_DEG = 2.0
#: Side to side over the standing foot (m, half the way).
SWAY_M = 0.020


def side_phases(plan: Plan, foot_off: float) -> dict[str, Float[np.ndarray, " N"]]:
    """Phase of the gait cycle (rad) of each side: 2 pi k at initial contacts, 2 pi (k + foot_off) at toe-offs."""
    out = {}
    for side in "rl":
        knots, phase = [], []
        for k, step in enumerate(s for s in plan.steps if s.side == side):
            if np.isfinite(step.down_s):
                knots.append(step.down_s)
                phase.append(float(k))
            if np.isfinite(step.up_s):
                knots.append(step.up_s)
                phase.append(k + foot_off)
        if len(knots) < 2:
            out[side] = np.full(len(plan.grid_s), 2 * np.pi * 0.3)
            continue
        # Before its first and after its last event a foot stands: no further than the middle of that stance.
        knots = [knots[0] - 0.4, *knots, knots[-1] + 0.4]
        phase = [phase[0] - 0.3, *phase, phase[-1] + 0.3]
        at = np.clip(plan.grid_s, knots[0], knots[-1])
        curve = PchipInterpolator(knots, phase)(at)
        out[side] = 2 * np.pi * gaussian_filter1d(curve, 0.04 / GRID_STEP_S, mode="nearest")
    return out


def swing_bump(plan: Plan, side: str) -> Float[np.ndarray, " N"]:
    """0 in stance, 1 in the middle of each swing of a side."""
    out = np.zeros(len(plan.grid_s))
    own = [s for s in plan.steps if s.side == side]
    for before, after in itertools.pairwise(own):
        fraction = np.clip((plan.grid_s - before.up_s) / (after.down_s - before.up_s), 0, 1)
        out += np.sin(np.pi * fraction) ** 2
    return out


def swing_window(plan: Plan, side: str, early_s: float) -> Float[np.ndarray, " N"]:
    """1 in each swing of a side, smoothly 0 outside; it begins a little before toe-off."""
    out = np.zeros(len(plan.grid_s))
    own = [s for s in plan.steps if s.side == side]
    for before, after in itertools.pairwise(own):
        out += (plan.grid_s > before.up_s - early_s) & (plan.grid_s < after.down_s)
    return gaussian_filter1d(out, 0.04 / GRID_STEP_S, mode="nearest")


def reference(
    plan: Plan, style: Style, seed: int, leg_m: float, foot_off: float, toe_out_rad: float
) -> tuple[Float[np.ndarray, "N 40"], Float[np.ndarray, " N"]]:
    """Joint values (N, 40) that a motion aims at, and the sway (N,) of the pelvis to the left (m).

    The pelvis' three angles are against the direction the person faces; its place is left at zero. Draws are the same
    whatever the style: severity 0 is the healthy walk of the seed.
    """
    norm, body = gait_norm(), load_body()
    rng, shape_rng = np.random.default_rng([seed, 20]), np.random.default_rng([seed, 24])
    column = {n: i for i, n in enumerate(body.joint_names)}
    t = plan.grid_s
    speed = plan.speed_m_per_s / np.sqrt(GRAVITY * leg_m)
    # How much of a walk it is: below half of the slowest group the curves fade to standing.
    walks = fade(speed / (0.5 * norm.speed[0]))
    phases = side_phases(plan, foot_off)
    swings = {s: swing_bump(plan, s) for s in "rl"}
    posture = {k: np.broadcast_to(plan.posture_deg.get(k, v), t.shape) for k, v in STANDING_DEG.items()}
    q = np.zeros((len(t), len(body.joint_names)))

    for angle, of_body in LEG_ANGLES.items():
        joint, sign = joint_of(of_body)
        z, size = within(rng, 0.0, OFFSET_SHARE, 1.6), within(rng, 1.0, RANGE_SD)
        shape = _shape(shape_rng)
        for side in "rl":
            own = z + within(rng, 0.0, SIDES_SHARE)
            if angle == "hip_rotation":
                # The shank of the body has no torsion: the foot's direction on the floor is the hip's rotation.
                own = (HIP_ROTATION_DEG - np.degrees(toe_out_rad)) / norm.sd_deg[angle][2, 0]
            deg = _curve(rng, t, angle, phases[side], speed, own, size, shape)
            if angle == "knee_flexion":
                deg = _knee(deg, plan, style, side, phases[side], speed, foot_off)
            deg = _impaired(deg, angle, style, side, swings[side])
            q[:, column[f"{joint}_{side}"]] = sign * (walks * deg + (1 - walks) * _rest(angle, posture, swings[side]))
    pace = np.clip(speed / norm.speed[2], 0.0, 1.4)
    for angle, (sign, joint) in PELVIS.items():
        z, size = within(rng, 0.0, OFFSET_SHARE, 1.6), within(rng, 1.0, RANGE_SD)
        z = z if angle == "pelvis_tilt" else 0.3 * z
        deg = _curve(rng, t, angle, phases["r"], speed, z, size)
        if angle == "pelvis_obliquity":
            deg = deg + style.swing_hike["r"] * swings["r"] - style.swing_hike["l"] * swings["l"]
        rest = sign * posture["tilt"] if angle == "pelvis_tilt" else np.zeros(len(t))
        q[:, column[f"pelvis_{joint}"]] = sign * (walks * deg + (1 - walks) * rest)

    for joint, curve in SIDE_CURVES_DEG.items():
        if joint in LEG_ANGLES.values():
            continue
        middle, size = within(rng, 0.0, OFFSET_SD_DEG[joint]), within(rng, 1.0, 0.08)
        foot = joint in ("subtalar_angle", "mtp_angle")
        for side in "rl":
            gain = size * (walks if foot else walks * pace * style.arm_swing[side])
            deg = curve[0] + (0.3 if foot else 1.0) * middle + gain * swing(curve, phases[side])
            deg = deg + wander(rng, t, WALK_MEAN_SD_DEG, *_SLOW_HZ)
            if joint == "elbow_flex":
                deg = deg + style.elbow[side] * walks
            if joint in posture:
                deg = walks * deg + (1 - walks) * posture[joint]
            elif foot:
                deg = walks * deg
            q[:, column[f"{joint}_{side}"]] = deg
    for joint, curve in MIDDLE_CURVES_DEG.items():
        if joint not in column:
            continue
        middle, size = within(rng, 0.0, 0.7 * OFFSET_SD_DEG[joint]), within(rng, 1.0, 0.08)
        deg = curve[0] + middle + walks * size * swing(curve, phases["r"])
        deg = deg + wander(rng, t, WALK_MEAN_SD_DEG, *_SLOW_HZ)
        if joint == "lumbar_bending":
            # Positive to the right: over the right foot in its stance.
            deg = deg + style.trunk_sway * walks * np.sin(phases["r"] - 0.15)
        if joint == "lumbar_extension":
            deg = walks * deg + (1 - walks) * (posture[joint] + middle)
        q[:, column[joint]] = deg
    # To the left is away from the right foot's stance.
    sway = -(SWAY_M + style.sway_m) * np.sin(phases["r"] - 0.3) * walks
    return np.radians(q), sway


def _shape(rng) -> tuple[float, ...]:
    """Difference of a person's curve in shape: a harmonic sum without a mean, in standard deviations of the norm."""
    return (0.0, *(within(rng, 0.0, SHAPE_SHARE) for _ in range(2 * SHAPE_HARMONICS)))


def _curve(rng, t, angle: str, phase, speed, z: float, size: float, shape: tuple[float, ...] = (0.0,)) -> np.ndarray:
    """A person's curve: the norm's, its mean moved by z standard deviations, its range stretched, as the body counts.

    The norm's curves are Plug-in Gait's.
    """
    norm = gait_norm()
    mean = norm.curve(angle, phase, speed)
    middle = norm.coefficients(angle, speed)[..., 0]
    sd = norm.coefficients(angle, speed, sd=True)[..., 0]
    offset = sd * (z + swing(shape, phase)) + offset_deg(angle, PLUG_IN_GAIT, BODY_ANGLES)
    stretch = size * (1 + wander(rng, t, WALK_RANGE_SD, *_SLOW_HZ))
    return middle + offset + stretch * (mean - middle) + wander(rng, t, WALK_MEAN_SD_DEG, *_SLOW_HZ)


def _knee(deg, plan: Plan, style: Style, side: str, phase, speed, foot_off: float) -> np.ndarray:
    """The knee's flexion of the swing, above the least of the cycle, multiplied by the style's fraction."""
    if style.swing_knee[side] == 1.0:
        return deg
    # The norm's own flexion of late stance and swing: what the fraction takes away.
    norm = gait_norm()
    table = norm.coefficients("knee_flexion", speed)
    least = harmonic_sum(table, np.full(np.shape(phase), 2 * np.pi * 0.40))
    return deg - (1 - style.swing_knee[side]) * np.clip(deg - least, 0, None) * swing_window(plan, side, 0.12)


def _impaired(deg, angle: str, style: Style, side: str, swing) -> np.ndarray:
    if angle == "hip_flexion":
        return deg + style.stance_hip[side] + style.swing_hip[side] * swing
    if angle == "knee_flexion":
        # A bent knee bends less on top of it.
        return deg + style.stance_knee[side] * (1 - 0.6 * swing) + style.swing_more_knee[side] * swing
    if angle == "ankle_dorsiflexion":
        return deg + style.stance_ankle[side] * (1 - 0.5 * swing) + style.swing_ankle[side] * swing**0.5
    if angle == "hip_adduction":
        return deg - style.swing_abduction[side] * swing
    return deg


def _rest(angle: str, posture: dict[str, np.ndarray], swing: np.ndarray) -> np.ndarray:
    if angle == "knee_flexion":
        return posture["knee_flexion"] + STEP_KNEE_DEG * swing
    if angle == "hip_flexion":
        return posture["hip_flexion"] + STEP_HIP_DEG * swing
    if angle == "ankle_dorsiflexion":
        return posture["ankle_angle"]
    return np.zeros(len(swing))
