"""Sequences of the training corpus: walking with starts, stops and turns, running, and what is not walking."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ._gaits import curve_foot_off, gait_angles
from ._leg import LEG_ANGLES, PELVIS_ANGLES, leg_points
from ._rhythm import Rhythm, draw_rhythm, draw_run, leg_phase, schedule
from ._sequence import GRID_HZ, Bout, Sequence

#: Length of a sequence (s), and how often each kind is made.
SECONDS = 12.0
KINDS = (("walk", 0.60), ("start_stop", 0.20), ("run", 0.04), ("backwards", 0.04), ("other", 0.12))


def scene(seed: int) -> Sequence:
    """One sequence. The same seed gives the same."""
    rng = np.random.default_rng([seed, 602])
    kind = str(rng.choice([k for k, _ in KINDS], p=[p for _, p in KINDS]))
    time = np.arange(round(SECONDS * GRID_HZ)) / GRID_HZ
    leg_m = rng.uniform(0.45, 1.02)
    proportions = np.exp(rng.normal(0, 0.06, 8)) * np.exp(rng.normal(0, 0.01, (2, 8)))
    if kind == "other":
        angles, heading = not_walking(rng, time)
        return Sequence((leg_m * leg_points(angles, heading, proportions)).astype(np.float32), (), kind)
    rhythm = draw_run(rng) if kind == "run" else draw_rhythm(rng)
    events = schedule(rng, rhythm, SECONDS)
    off = curve_foot_off(rhythm)
    left = leg_phase(events[0], events[3], off, time)
    right = leg_phase(events[2], events[1], off, time)
    angles = gait_angles(rng, rhythm, left, right)
    heading = _heading(rng, time, turns=kind != "run")
    bouts: tuple[Bout, ...] = (Bout(_within(events, 0.0, SECONDS), open_ends=True),)
    if kind == "start_stop":
        bouts, angles = _starts_and_stops(rng, time, events, angles, rhythm)
    xyz = (leg_m * leg_points(angles, heading, proportions)).astype(np.float32)
    if kind == "backwards":  # walking backwards is close to walking played backwards (Winter et al. 1989)
        return Sequence(xyz[::-1].copy(), (), kind)
    return Sequence(xyz, bouts, kind)


def _within(events, start: float, stop: float):
    return tuple(e[(e >= start) & (e <= stop)] for e in events)


def _heading(rng: np.random.Generator, time: np.ndarray, *, turns: bool) -> np.ndarray:
    """Straight on, or with turns of any angle within one to three seconds."""
    heading = np.full(len(time), rng.uniform(0, 2 * np.pi))
    if turns and rng.random() < 0.3:
        for _ in range(int(rng.integers(1, 3))):
            at, lasts = rng.uniform(0, time[-1]), rng.uniform(1.0, 3.0)
            heading = heading + np.radians(rng.uniform(-180, 180)) / (1 + np.exp(-(time - at) / (0.15 * lasts)))
    return heading


def _starts_and_stops(rng, time, events, angles, rhythm: Rhythm):
    """Cut the walk into bouts: between them the person stands or does something else."""
    other, _ = not_walking(rng, time, calm=True)
    goes = np.zeros(len(time))
    bouts = []
    at = rng.uniform(0.0, 3.0) if rng.random() < 0.7 else -1.0
    while at < time[-1]:
        lasts = rng.uniform(2.5, 9.0)
        # A bout begins when a foot leaves and ends when one comes down.
        ups, downs = np.sort(np.concatenate([events[1], events[3]])), np.sort(np.concatenate([events[0], events[2]]))
        if at < 0:
            start = -np.inf
        else:
            later = ups[ups >= at]
            if len(later) == 0:
                break
            start = float(later[0])
        earlier = downs[downs <= max(at, 0) + lasts]
        if len(earlier) == 0 or earlier[-1] <= start + rhythm.step_s:
            at = max(at, 0) + lasts
            continue
        stop = float(earlier[-1])
        half = min(0.8 * rhythm.step_s, 0.7)
        goes += _ramp(time, start - 0.10, start + half) - _ramp(time, stop - 0.6 * half, stop + 0.25)
        bouts.append(Bout(_within(events, max(start, 0.0) - 1e-6, min(stop, SECONDS) + 1e-6), open_ends=False))
        at = stop + rng.uniform(0.6, 3.0)
    goes = np.clip(goes, 0, 1)
    mixed = {}
    for name in (*LEG_ANGLES, *PELVIS_ANGLES):
        weight = goes[:, None] if angles[name].ndim == 2 else goes
        mixed[name] = weight * angles[name] + (1 - weight) * other[name]
    return tuple(bouts), mixed


def _ramp(time: np.ndarray, start: float, stop: float) -> np.ndarray:
    if not np.isfinite(start):
        return np.ones(len(time))
    x = np.clip((time - start) / (stop - start), 0, 1)
    return x * x * (3 - 2 * x)


def not_walking(rng: np.random.Generator, time: np.ndarray, *, calm: bool = False):
    """Angles and heading of a person who stands, sits, squats, steps on the spot or sideways, sways or turns."""
    n = len(time)
    out = {name: np.zeros((n, 2)) + rng.normal(0, 2, 2) for name in LEG_ANGLES}
    out |= {name: np.zeros(n) + rng.normal(0, 1) for name in PELVIS_ANGLES}
    out["hip_flexion"] += 12
    out["knee_flexion"] += 5 + abs(rng.normal(0, 6))
    out["pelvis_tilt"] += 11
    out["hip_adduction"] -= abs(rng.normal(2, 3))
    for name in LEG_ANGLES:
        out[name] += _wander(rng, time, 2, rng.uniform(0.3, 2.0))
    heading = np.full(n, rng.uniform(0, 2 * np.pi))
    doing = str(rng.choice(["stand", "shift"] if calm else list(_DOINGS)))
    if doing in ("sit", "squat"):
        deep = _pulses(rng, time, rng.uniform(2.0, 6.0), rng.uniform(0.35, 0.9))
        if doing == "sit" and rng.random() < 0.4:
            deep = np.ones(n)
        depth = rng.uniform(0.5, 1.0) if doing == "squat" else 1.0
        out["hip_flexion"] += 75 * depth * deep[:, None]
        out["knee_flexion"] += 85 * depth * deep[:, None]
        out["ankle_dorsiflexion"] += (25 if doing == "squat" else 5) * depth * deep[:, None]
    elif doing in ("spot", "side", "turn"):
        lift = _lifts(rng, time, rng.uniform(0.35, 1.0))
        high = rng.uniform(15, 60) if doing == "spot" else rng.uniform(12, 30)
        out["hip_flexion"] += high * lift
        out["knee_flexion"] += 1.6 * high * lift
        out["ankle_dorsiflexion"] += rng.uniform(-0.4, 0.5) * high * lift
        if doing == "side":
            wide = rng.uniform(6, 20) * np.sin(2 * np.pi * np.cumsum(np.full(n, rng.uniform(0.4, 0.9))) / GRID_HZ)
            out["hip_adduction"] -= np.clip(wide, 0, None)[:, None] * rng.uniform(0.6, 1.0, 2)
        if doing == "turn":
            heading = heading + np.radians(rng.uniform(-90, 90)) * time
    elif doing == "shift":
        sway = _wander(rng, time, 1, rng.uniform(2, 8))[:, 0]
        out["hip_adduction"] += sway[:, None] * [1, -1]
        lean = _wander(rng, time, 1, rng.uniform(1, 5))[:, 0]
        out["hip_flexion"] += lean[:, None]
        out["ankle_dorsiflexion"] += 0.7 * lean[:, None]
    elif doing == "leg":  # one leg swings, kicks or is lifted
        side = int(rng.integers(2))
        swing = np.sin(2 * np.pi * rng.uniform(0.3, 1.2) * time + rng.uniform(0, 6))
        out["hip_flexion"][:, side] += rng.uniform(10, 40) * swing
        out["knee_flexion"][:, side] += rng.uniform(0, 50) * np.clip(swing, 0, None)
    elif doing == "both":  # rocking to and fro over the feet
        rock = np.sin(2 * np.pi * rng.uniform(0.2, 1.0) * time)
        out["hip_flexion"] += rng.uniform(5, 20) * rock[:, None]
        out["ankle_dorsiflexion"] += rng.uniform(2, 12) * rock[:, None]
        out["knee_flexion"] += rng.uniform(0, 20) * (1 + rock[:, None])
    return out, heading


_DOINGS = ("stand", "sit", "squat", "spot", "side", "turn", "shift", "leg", "both")


def _wander(rng: np.random.Generator, time: np.ndarray, columns: int, sd: float) -> np.ndarray:
    f = np.exp(rng.uniform(np.log(0.1), np.log(1.2), (columns, 4)))
    p = rng.uniform(0, 2 * np.pi, (columns, 4))
    return sd / np.sqrt(2) * np.sin(2 * np.pi * time[:, None, None] * f + p).sum(axis=2)


def _pulses(rng: np.random.Generator, time: np.ndarray, period: float, fraction: float) -> np.ndarray:
    """0 and 1 in turn, smoothly."""
    wave = ((time / period + rng.random()) % 1.0 < fraction).astype(float)
    return gaussian_filter1d(wave, rng.uniform(0.2, 0.5) * GRID_HZ, mode="nearest")


def _lifts(rng: np.random.Generator, time: np.ndarray, step_s: float) -> np.ndarray:
    """(T, 2): how far each foot is lifted (0..1), left and right in turn."""
    jitter = 0.05 * gaussian_filter1d(rng.standard_normal(len(time)), 10) * np.sqrt(20)
    turns = time / (2 * step_s) + rng.random() + jitter
    fraction = rng.uniform(0.35, 0.5)
    out = []
    for delay in (0.0, 0.5):
        p = (turns + delay) % 1.0
        out.append(np.where(p < fraction, np.sin(np.pi * p / fraction) ** 2, 0.0))
    return np.stack(out, axis=1)
