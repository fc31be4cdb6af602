"""Display names of gait measures, joint angles and checks, the units in the ends of names, and formats of numbers."""

from __future__ import annotations

import functools
import math

#: Computed tables, in the order of the chain -> description for people who know no tables.
STAGES = {
    "VideoInfo": "reading of the video",
    "Tracking": "search for people",
    "SubjectChoice": "choice of the person",
    "Keypoints": "detection of body points",
    "TrialInput": "preparation of the recording",
    "SessionFit": "fit of the body",
    "GaitEvents": "detection of gait events",
    "GaitCycle": "division into gait cycles",
    "Spatiotemporal": "measures of the recording",
    "GDI": "index of the recording",
    "SessionGdi": "measures and index of the visit",
    "SessionQc": "quality checks of the visit",
    "Kinetics": "forces and joint moments",
    "KinematicError": "comparison with a reference",
    "Deidentified": "copy with hidden heads",
}


def role_words(role: str) -> str:
    """Return the role of a visit as texts write it: "6 months" of "6_months"."""
    return role.replace("_", " ")


#: Ends of the names of measures and their units, longer ones before those that they end with.
_UNITS = (
    ("_nm_per_kg", "Nm/kg"),
    ("_w_per_kg", "W/kg"),
    ("_j_per_kg", "J/kg"),
    ("_bw_s", "BW s"),
    ("_bw", "BW"),
    ("_steps_per_min", "steps/min"),
    ("_m_per_s", "m/s"),
    ("_percent", "%"),
    ("_deg", "deg"),
    ("_s", "s"),
    ("_m", "m"),
)

#: Gait measures: key of metrics.json -> name, unit, decimals.
MEASURES: dict[str, tuple[str, str, int]] = {
    "cadence_steps_per_min": ("Cadence", "steps/min", 1),
    "stride_time_s": ("Stride time", "s", 2),
    "step_time_s": ("Step time", "s", 2),
    "stance_time_s": ("Stance time", "s", 2),
    "swing_time_s": ("Swing time", "s", 2),
    "stance_percent": ("Stance", "% of stride", 1),
    "swing_percent": ("Swing", "% of stride", 1),
    "single_support_percent": ("Single support", "% of stride", 1),
    "double_support_percent": ("Double support", "% of stride", 1),
    "double_support_time_s": ("Double support time", "s", 2),
    "speed_m_per_s": ("Speed", "m/s", 2),
    "stride_length_m": ("Stride length", "m", 2),
    "step_length_m": ("Step length", "m", 2),
    "step_width_m": ("Step width", "m", 2),
}
#: Measures of tasks (`gait.TASK_MEASURES`): the same.
TASKS: dict[str, tuple[str, str, int]] = {
    "five_rises_time_s": ("Time of five rises", "s", 2),
    "rise_count": ("Rises", "", 0),
    "attempt_count": ("Attempts to rise", "", 0),
    "tug_time_s": ("Timed up and go", "s", 2),
    "squat_count": ("Squats", "", 0),
    "rise_time_s": ("Time of a rise", "s", 2),
    "walk_out_time_s": ("Walk out", "s", 2),
    "turn_time_s": ("Turn", "s", 2),
    "walk_back_time_s": ("Walk back", "s", 2),
    "turn_to_sit_time_s": ("Turn before sitting", "s", 2),
    "sit_time_s": ("Time of sitting down", "s", 2),
    "squat_time_s": ("Time of a squat", "s", 2),
    "squat_knee_flexion_deg": ("Deepest knee flexion", "deg", 0),
    "peak_trunk_lean_deg": ("Furthest lean of the trunk", "deg", 0),
}

#: Measures of forces and moments: key of kinetics.json -> name, unit, decimals.
KINETICS: dict[str, tuple[str, str, int]] = {
    "vertical_peak_loading_bw": ("Vertical force, peak of loading", "BW", 2),
    "vertical_peak_push_off_bw": ("Vertical force, peak of push-off", "BW", 2),
    "vertical_impulse_bw_s": ("Vertical impulse", "BW s", 2),
    "braking_impulse_bw_s": ("Braking impulse", "BW s", 3),
    "propulsion_impulse_bw_s": ("Propulsion impulse", "BW s", 3),
    "knee_extension_moment_peak_nm_per_kg": ("Knee extension moment, peak", "Nm/kg", 2),
    "knee_adduction_moment_peak_nm_per_kg": ("Knee adduction moment, peak (external)", "Nm/kg", 2),
    "ankle_push_off_power_w_per_kg": ("Ankle push-off power, peak", "W/kg", 1),
    "hip_work_j_per_kg": ("Work of the hip in stance", "J/kg", 2),
    "knee_work_j_per_kg": ("Work of the knee in stance", "J/kg", 2),
    "ankle_work_j_per_kg": ("Work of the ankle in stance", "J/kg", 2),
    "centre_of_mass_excursion_m": ("Vertical excursion of the centre of mass", "m", 3),
}
#: Curves of forces and moments in reports: our name -> heading, unit.
KINETICS_CURVES: dict[str, tuple[str, str]] = {
    "force_vertical_bw": ("Vertical force", "BW"),
    "force_forward_bw": ("Forward force", "BW"),
    "force_medial_bw": ("Inward force", "BW"),
    "hip_flexion_moment_nm_per_kg": ("Hip flexion moment", "Nm/kg"),
    "knee_flexion_moment_nm_per_kg": ("Knee flexion moment", "Nm/kg"),
    "ankle_angle_moment_nm_per_kg": ("Ankle dorsiflexion moment", "Nm/kg"),
    "hip_flexion_power_w_per_kg": ("Hip power", "W/kg"),
    "knee_flexion_power_w_per_kg": ("Knee power", "W/kg"),
    "ankle_angle_power_w_per_kg": ("Ankle power", "W/kg"),
}

#: Joint angles: our name -> heading, and the positive direction unless the heading states it.
ANGLES: dict[str, tuple[str, str]] = {
    "hip_flexion": ("Hip flexion", ""),
    "hip_adduction": ("Hip adduction", ""),
    "hip_rotation": ("Hip rotation", "internal +"),
    "knee_flexion": ("Knee flexion", ""),
    "ankle_dorsiflexion": ("Ankle dorsiflexion", ""),
}
#: Pelvis angles exist over the cycle only (they need the walking direction).
PELVIS_ANGLES: dict[str, tuple[str, str]] = {
    "pelvis_tilt": ("Pelvis tilt", "anterior +"),
    "pelvis_obliquity": ("Pelvis obliquity", "own side up +"),
    "pelvis_rotation": ("Pelvis rotation", "own side ahead +"),
}
#: So does the direction of the foot.
FOOT_ANGLES: dict[str, tuple[str, str]] = {"foot_progression": ("Foot direction", "toes in +")}

#: Reason why a recording that waits to be computed has no fit.
NOT_COMPUTED = "not computed yet"
#: Reasons why a recording is not usable, by one word; "other" asks for a text.
UNUSABLE: dict[str, str] = {
    "not_in_view": "the person is not in view, or only in part",
    "too_dark": "too dark or blurred",
    "camera_moved": "the camera was moved, or stood badly",
    "other_person": "another person is filmed",
    "other_task": "another task than the registered one",
    "helped": "the person was held or led",
    "interrupted": "the walk was interrupted",
    "duplicate": "the same walk as in another recording",
    "other": "another reason",
}


@functools.cache
def unit_of(name: str) -> str:
    """The unit in the end of a measure's name; empty if it has none, such as an index."""
    return next((unit for end, unit in _UNITS if name.endswith(end)), "")


def without_unit(name: str) -> str:
    """Return the name of an instrument or a measure without the unit in its end: "10MWT" of "10MWT_m_per_s"."""
    return name.removesuffix(next((end for end, _ in _UNITS if name.endswith(end)), ""))


#: Ends of the names of checks and their units, and words of these names that are displayed differently.
_CHECK_UNITS = {"cm": "cm", "px": "px", "s": "s", "deg": "\N{DEGREE SIGN}", "percent": "%", "m": "m"}
_SPELLED = {"2d": "2D", "3d": "3D", "gdi": "GDI", "trial": "recording"}


def check_words(name: str) -> str:
    """ "residual_3d_cm" -> "Residual 3D (cm)"; the name of a recording behind it stays, in brackets."""
    name, _, recording = name.partition(" ")
    words = name.split("_")
    unit = _CHECK_UNITS.get(words[-1]) if len(words) > 1 else None
    words = [_SPELLED.get(w, w) for w in (words[:-1] if unit else words)]
    text = " ".join(words) + (f" ({unit})" if unit else "")
    named = f" {recording}" if recording.startswith("(") else f" ({recording})"
    return capital(text) + (named if recording else "")


def capital(text: str) -> str:
    """The text with a capital at its start."""
    return text[:1].upper() + text[1:]


def number(value: float | None, decimals: int) -> str:
    """The value with so many decimals and a real minus sign; an en dash if it is unknown."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    text = f"{value:.{decimals}f}"
    return (text.lstrip("-") if float(text) == 0 else text).replace("-", "\N{MINUS SIGN}")


def significant(value: float | None, digits: int = 3) -> str:
    """The value with so many significant digits, never in powers of ten; empty if it is unknown."""
    if value is None or not math.isfinite(value):
        return ""
    if value == 0:
        return "0"
    decimals = min(6, max(0, digits - 1 - math.floor(math.log10(abs(value)))))
    text = f"{value:.{decimals}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "\N{MINUS SIGN}")
