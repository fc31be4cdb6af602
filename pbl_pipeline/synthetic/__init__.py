"""A walker with known truth: joint angles, gait events, body, camera and clock, seen by a phone (docs/synth.md).

For `pbl synth`, `pbl bench fit`, the self-test of workers, and tests. Everything is a function of a seed. World frame:
z up, metres, the phone at the origin and 1.2 m above the floor, the walk ahead of it along x. `synthesise` makes the
trials of `pbl synth`: legs by published curves at any speed, feet that stand still, impairments, other tasks;
`plain_walk` is textbook curves and nothing else.
"""

from .camera import LEVEL_R_NC, PHONE_CAMERA, PHONE_SIZE_PX, VIEWS_DEG, PhoneSensor, picture_px
from .impair import IMPAIRMENTS, Impairment
from .noise import CORRELATED_NOISE, NO_NOISE, Disturbance, Noise, correlated
from .observe import Seen, film, pelvis_positions, seen_by, true_markers
from .physique import physique
from .plan import plain_walk
from .solve import SOLE_POINTS, sole_points
from .synth import TASKS, Synthetic, SynthSpec, Truth, lens, speed_of_group, synthesise
