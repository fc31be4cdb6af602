"""A walker with known truth: joint angles, body, camera and clock, seen by phones, cameras or markers.

For tests, for `pbl bench fit` and for the calibration of the fit's uncertainties. Everything is a function of a seed.
World frame: z up, metres, the phone at the origin and 1.2 m above the floor, the walk ahead of it along x.

One walker in three depths: `plain_walk` (textbook curves and nothing else), `walk_qpos` (the same curves, and persons
who differ and vary; what the benchmark's figures were measured with) and `synthesise` (legs by published curves at any
speed, feet that stand still, impairments, other tasks; `pbl synth`).
"""

from pbl_pipeline.gait.normative import GaitNorm, gait_norm

from .camera import LEVEL_R_NC, PHONE_CAMERA, PHONE_SIZE_PX, PhoneSensor, picture_px, resized, zoomed
from .impair import IMPAIRMENTS, Impairment
from .noise import BLAZEPOSE_MEASURED, BLAZEPOSE_NOISE, DETECTORS, METRABS_MEMORY, NO_NOISE, DetectorModel, Noise
from .observe import Seen, observe, pelvis_positions
from ._path import PATHS
from .markers import person, true_markers
from .physique import physique
from .scene import VIEWS_DEG
from .solve import SOLE_POINTS, sole_points
from .synth import TASKS, Synthetic, SynthSpec, Truth, lens, speed_of_group, synthesise
from ._views import VIEW_CAMERA, VIEW_SIZE_PX, observe_markers, observe_views
from .walk import facing, plain_walk, turned, walk_qpos

__all__ = [
    "BLAZEPOSE_MEASURED",
    "BLAZEPOSE_NOISE",
    "DETECTORS",
    "IMPAIRMENTS",
    "LEVEL_R_NC",
    "METRABS_MEMORY",
    "NO_NOISE",
    "PATHS",
    "PHONE_CAMERA",
    "PHONE_SIZE_PX",
    "SOLE_POINTS",
    "TASKS",
    "VIEWS_DEG",
    "VIEW_CAMERA",
    "VIEW_SIZE_PX",
    "DetectorModel",
    "GaitNorm",
    "Impairment",
    "Noise",
    "PhoneSensor",
    "Seen",
    "SynthSpec",
    "Synthetic",
    "Truth",
    "facing",
    "gait_norm",
    "lens",
    "observe",
    "observe_markers",
    "observe_views",
    "pelvis_positions",
    "person",
    "physique",
    "picture_px",
    "plain_walk",
    "resized",
    "sole_points",
    "speed_of_group",
    "synthesise",
    "true_markers",
    "turned",
    "walk_qpos",
    "zoomed",
]
