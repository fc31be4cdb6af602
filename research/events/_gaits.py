"""Gaits of walking and running: angles over the phases of both legs, healthy and with impairments."""

from __future__ import annotations

import functools

import numpy as np
from scipy.interpolate import CubicSpline

from pbl_pipeline.gait.normative import gait_norm, harmonic_sum

from ._leg import LEG_ANGLES, PELVIS_ANGLES
from ._rhythm import Rhythm

#: How far the curves of two people differ (deg): standard deviations of harmonics 0 (the mean), 1, 2, 3, 4, 5. They add
#: up to about what Schwartz et al. 2008 give for children, a little more.
_PERSON_DEG = (5.0, 2.0, 1.4, 0.8, 0.4, 0.25)
_SIDE_SHARE = 0.4

#: Running, deg over the stride from initial contact, foot off at 38 %. The project's own numbers, drawn to follow the
#: course of textbook curves (Novacheck 1998, Gait & Posture 7:77): a style for training, not a norm.
_RUN_PERCENT = (0, 8, 16, 24, 32, 38, 46, 55, 65, 75, 85, 93, 100)
#: Foot off in them.
_RUN_FOOT_OFF = 0.38
_RUN_DEG = {
    "hip_flexion": (38, 36, 26, 12, -2, -8, -4, 12, 32, 45, 48, 43, 38),
    "hip_adduction": (4, 9, 10, 7, 2, -1, -3, -4, -3, 0, 1, 2, 4),
    "hip_rotation": (2, 4, 3, 1, -1, -2, -3, -2, 0, 1, 2, 2, 2),
    "knee_flexion": (18, 33, 42, 36, 24, 20, 42, 76, 94, 84, 48, 20, 18),
    "ankle_dorsiflexion": (5, 15, 24, 20, -2, -18, -14, -6, 0, 3, 5, 6, 5),
    "pelvis_tilt": (16, 18, 16, 15, 17, 19, 17, 16, 17, 16, 15, 16, 16),
    "pelvis_obliquity": (2, -3, -4, -2, 0, 2, 3, 5, 3, 1, -1, 0, 2),
    "pelvis_rotation": (4, 3, 1, -2, -4, -5, -4, -2, 0, 3, 5, 5, 4),
}


@functools.cache
def _run_coefficients(angle: str) -> np.ndarray:
    """Mean and five harmonics of a running curve."""
    curve = CubicSpline(np.array(_RUN_PERCENT) / 100, _RUN_DEG[angle], bc_type="periodic")
    spectrum = np.fft.rfft(curve(np.arange(100) / 100)) / 100
    out = np.zeros(11)
    out[0] = spectrum[0].real
    out[1::2], out[2::2] = 2 * spectrum[1:6].real, -2 * spectrum[1:6].imag
    return out


def gait_angles(
    rng: np.random.Generator, rhythm: Rhythm, phase_left: np.ndarray, phase_right: np.ndarray
) -> dict[str, np.ndarray]:
    """Angles (deg) of a person over the phases (turns) of both legs: (T, 2) of the legs, (T,) of the pelvis."""
    phases = (2 * np.pi * phase_left, 2 * np.pi * phase_right)
    n = len(phase_left)
    slow = _slow_noise(rng, n, 14)
    out: dict[str, np.ndarray] = {}
    small = 1.0 if rhythm.runs else _range_of_steps(rng, rhythm)
    for a, angle in enumerate(LEG_ANGLES):
        normal = _run_coefficients(angle) if rhythm.runs else gait_norm().coefficients(angle, rhythm.speed)
        shared = _person(rng, len(normal))
        size = small * np.exp(rng.normal(0, 0.10))
        side_size = np.exp(rng.normal(0, 0.06, 2))
        columns = []
        for s in range(2):
            own = normal.copy()
            own[1:] *= size * side_size[s]
            own = own + shared + _SIDE_SHARE * _person(rng, len(normal))
            columns.append(harmonic_sum(own, phases[s]) + slow[2 * a + s])
        out[angle] = np.stack(columns, axis=1)
    for a, angle in enumerate(PELVIS_ANGLES):
        own = _run_coefficients(angle) if rhythm.runs else gait_norm().coefficients(angle, rhythm.speed)
        own = own + 0.4 * _person(rng, len(own)) * (1.0 if angle == "pelvis_tilt" else 0.6)
        sides = [harmonic_sum(own, p) for p in phases]
        # Both legs say where the pelvis is: tilt is the same for them, the other two are turned over.
        out[angle] = 0.5 * (sides[1] + sides[0] if angle == "pelvis_tilt" else sides[1] - sides[0]) + slow[10 + a]
    swings = np.stack([_swing(p % 1.0, curve_foot_off(rhythm)) for p in (phase_left, phase_right)], axis=1)
    _impair(rng, out, swings)
    return out


def curve_foot_off(rhythm: Rhythm) -> float:
    """Fraction of the stride at which the foot leaves in the curves themselves, whatever the person's rhythm."""
    return _RUN_FOOT_OFF if rhythm.runs else gait_norm().foot_off_at(rhythm.speed)


def _range_of_steps(rng: np.random.Generator, rhythm: Rhythm) -> float:
    """Swing of the legs relative to the curve of that speed; small in shuffling people."""
    if rhythm.speed < 0.35 and rng.random() < 0.35:
        return float(rng.uniform(0.35, 1.0))
    return float(np.clip(rng.normal(1.0, 0.1), 0.7, 1.3))


def _person(rng: np.random.Generator, size: int) -> np.ndarray:
    out = np.zeros(size)
    out[0] = rng.normal(0, _PERSON_DEG[0])
    for k, sd in enumerate(_PERSON_DEG[1:], 1):
        out[2 * k - 1 : 2 * k + 1] = rng.normal(0, sd / np.sqrt(2), 2)
    return out


def _swing(phase: np.ndarray, foot_off: float) -> np.ndarray:
    """0 in stance, 1 in the middle of the swing."""
    fraction = np.clip((phase - foot_off) / (1 - foot_off), 0, 1)
    return np.sin(np.pi * fraction) ** 2


def _impair(rng: np.random.Generator, a: dict[str, np.ndarray], swings: np.ndarray) -> None:
    """Signs of impaired walking, some of them, on one side or both; sizes as in `pbl_pipeline.synthetic`, by hand."""
    if rng.random() < 0.45:
        return
    for sign in rng.choice(9, int(rng.integers(1, 4)), replace=False):
        severity = float(rng.uniform(0.1, 1.0))
        sides = np.array([1.0, 1.0]) if rng.random() < 0.5 else np.eye(2)[int(rng.integers(2))]
        on, swing = severity * sides, swings
        if sign == 0:  # crouch
            a["knee_flexion"] += 32 * on * (1 - 0.6 * swing)
            a["hip_flexion"] += 18 * on
            a["ankle_dorsiflexion"] += 13 * on * (1 - 0.5 * swing)
        elif sign == 1:  # stiff knee
            least = np.percentile(a["knee_flexion"], 10, axis=0)
            a["knee_flexion"] -= 0.7 * on * np.clip(a["knee_flexion"] - least, 0, None) * (swing**0.5)
            a["hip_adduction"] -= 10 * on * swing
        elif sign == 2:  # drop foot
            a["ankle_dorsiflexion"] -= 22 * on * swing**0.5
            a["hip_flexion"] += 12 * on * swing
            a["knee_flexion"] += 16 * on * swing
        elif sign == 3:  # walks on the toes
            a["ankle_dorsiflexion"] -= 20 * on
            a["knee_flexion"] += 8 * on
        elif sign == 4:  # leg swung around
            a["hip_adduction"] -= 12 * on * swing
            a["hip_rotation"] -= 8 * on * swing
        elif sign == 5:  # weak push-off: the ankle moves little
            middle = a["ankle_dorsiflexion"].mean(axis=0)
            a["ankle_dorsiflexion"] -= 0.7 * on * (a["ankle_dorsiflexion"] - middle)
        elif sign == 6:  # feet turned in or out
            a["hip_rotation"] += rng.uniform(-25, 15) * on
        elif sign == 7:  # wide base
            a["hip_adduction"] -= 7 * on
        else:  # knees that go back in stance
            a["knee_flexion"] -= 14 * on * (1 - swing)


def _slow_noise(rng: np.random.Generator, n: int, rows: int) -> np.ndarray:
    """(rows, n) curves that wander within about 1 degree over seconds."""
    time = np.arange(n) / 50.0
    f = np.exp(rng.uniform(np.log(0.05), np.log(0.8), (rows, 4)))
    p = rng.uniform(0, 2 * np.pi, (rows, 4))
    sd = np.exp(rng.normal(np.log(0.5), 0.5))
    return sd / np.sqrt(2) * np.sin(2 * np.pi * f[..., None] * time + p[..., None]).sum(axis=1)
