"""Which angles an index is made of, by our names and in the order of its vectors."""

from __future__ import annotations

#: The original index (Schwartz & Rozumalski 2008): nine angles x 51 points.
NINE_ANGLES: tuple[str, ...] = (
    "pelvis_tilt",
    "pelvis_obliquity",
    "pelvis_rotation",
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
    "knee_flexion",
    "ankle_dorsiflexion",
    "foot_progression",
)
#: The paper's index.
THREE_ANGLES: tuple[str, ...] = ("hip_flexion", "hip_adduction", "knee_flexion")
