"""Curves of normal gait as harmonics of the gait cycle, and smooth variation that does not repeat."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.gait.normative import harmonic_sum

#: Degrees over one gait cycle of one side, its foot contact at phase 0: the mean, then (cosine, sine) of harmonic 1, 2
#: and so on. The project's own numbers: harmonics through values written down every 5 % of the cycle to follow the
#: course of textbook curves of healthy adults at their own speed (Perry and Burnfield, Gait Analysis, 2010; the shape
#: of the group means of Schwartz et al. 2008, J Biomech 41:1639). Hip flexion is that of the fitted body, whose pelvis
#: is level where Plug-in Gait's tips forward by 12 deg (`normative.offset_deg`). Subtalar: inversion positive; mtp:
#: extension positive.
SIDE_CURVES_DEG: dict[str, tuple[float, ...]] = {
    "hip_flexion": (6.0, 21.0, -3.9, -3.3, -0.9, -0.1, 1.2, -0.2, -0.2),
    "hip_adduction": (0.0, 1.7, 5.8, -0.3, -0.8, -0.9, 1.1, -0.1, -0.1),
    "hip_rotation": (0.2, 0.6, 2.8, -0.3, 0.0, -0.5, 1.1, 0.2, 0.0),
    "knee_flexion": (23.9, -1.7, -19.9, -14.8, 6.4, -0.8, 3.8, -0.8, 0.1, -0.2, 0.6, 0.2, 0.0),
    "ankle_angle": (1.0, -1.7, 6.2, 2.0, -7.0, -3.9, -0.1, 1.7, 0.2, 0.0, -1.0, 0.2, 0.3, 0.5, -0.2),
    "subtalar_angle": (0.5, -0.9, -4.2, 1.1, 0.8, 0.5, -0.9),
    "mtp_angle": (8.5, -4.0, -7.2, 5.1, 1.7, -1.2, -4.1, 0.6, 1.2, 0.7, -0.8),
    # The arm swings against the leg of its side and is furthest back at that side's foot contact.
    "arm_flex": (-7.0, -16.0, 2.0, 0.8, 0.3),
    "arm_add": (-9.0, 0.8, 1.2, 0.4, 0.0),
    "arm_rot": (4.0, -3.0, 1.0),
    "elbow_flex": (28.0, -9.0, 1.5, 1.5, -0.5),
    "pro_sup": (85.0, 3.0, 1.0),
    "wrist_flex": (6.0, -3.0, 1.0),
    "wrist_dev": (2.0, 1.0, 0.5),
}

#: The same for pelvis and trunk over the cycle of the right side. Pelvis: posterior tilt, right side down and right
#: side ahead positive, against the walking direction (the signs of the model's axes forward, up, right).
MIDDLE_CURVES_DEG: dict[str, tuple[float, ...]] = {
    "tilt": (2.0, 0.0, 0.0, 0.8, 0.9),
    "list": (0.0, -2.3, -2.8, 0.0, 0.0, -0.6, 0.5),
    "rotation": (0.0, 4.2, -1.2, 0.0, 0.0, 0.4, 0.3),
    "lumbar_extension": (-6.0, 0.0, 0.0, -0.9, -0.7),
    "lumbar_bending": (0.0, 2.6, 3.3, 0.0, 0.0, 0.5, -0.4),
    "lumbar_rotation": (0.0, -8.2, 1.6, 0.0, 0.0, -0.3, -0.2),
    "neck_extension": (2.0, 0.0, 0.0, 0.5, -0.4),
    "neck_bending": (0.0, -0.4, -0.6),
    "neck_rotation": (0.0, 3.6, -0.4),
}

#: How the means of the curves differ between people (standard deviation, deg), about what Schwartz et al. 2008 give
#: for the legs; drawn within two standard deviations.
OFFSET_SD_DEG: dict[str, float] = {
    "hip_flexion": 4.0,
    "hip_adduction": 2.0,
    "hip_rotation": 5.0,
    "knee_flexion": 2.0,
    "ankle_angle": 3.0,
    "subtalar_angle": 3.0,
    "mtp_angle": 3.0,
    "arm_flex": 5.0,
    "arm_add": 3.0,
    "arm_rot": 8.0,
    "elbow_flex": 8.0,
    "pro_sup": 12.0,
    "wrist_flex": 6.0,
    "wrist_dev": 4.0,
    "tilt": 4.0,
    "list": 1.0,
    "rotation": 1.5,
    "lumbar_extension": 4.0,
    "lumbar_bending": 1.0,
    "lumbar_rotation": 1.5,
    "neck_extension": 4.0,
    "neck_bending": 1.5,
    "neck_rotation": 3.0,
}


def swing(curve: tuple[float, ...], phase_rad: np.ndarray) -> np.ndarray:
    """A curve of `SIDE_CURVES_DEG` or `MIDDLE_CURVES_DEG` at phases, without its mean."""
    return harmonic_sum(np.array([0.0, *curve[1:]]), phase_rad)


def wander(
    rng: np.random.Generator, time_s: np.ndarray, sd: float, low_hz: float, high_hz: float, n: int = 10
) -> np.ndarray:
    """(T,) a smooth curve of mean 0 that does not repeat: `n` sines with random frequencies and phases.

    Frequencies are drawn evenly on a logarithmic scale, all with the same amplitude; over a long time the standard
    deviation is `sd`. It is a function of time, so other time stamps show the same curve.
    """
    frequency = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), n))
    phase = rng.uniform(0, 2 * np.pi, n)
    turns = 2 * np.pi * np.multiply.outer(np.asarray(time_s, np.float64), frequency)
    return sd * np.sqrt(2 / n) * np.sin(turns + phase).sum(axis=-1)


def within(rng: np.random.Generator, mean: float, sd: float, bound_sd: float = 2.0) -> float:
    """A normal number cut off at `bound_sd` standard deviations."""
    return mean + sd * float(np.clip(rng.standard_normal(), -bound_sd, bound_sd))
