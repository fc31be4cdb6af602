"""Names of gait measures and joint angles as people read them, and the units that names end with."""

from __future__ import annotations

import functools

#: Ends of the names of measures and their units, longer ones before those that they end with.
_UNITS = (
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

#: Joint angles: our name -> heading, and what positive means where the heading does not say it.
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


@functools.cache
def unit_of(name: str) -> str:
    """The unit that a measure's name ends with; empty where it has none, such as an index."""
    return next((unit for end, unit in _UNITS if name.endswith(end)), "")
