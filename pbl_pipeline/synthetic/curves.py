"""Curves of normal gait as harmonics of the gait cycle, and smooth variation that does not repeat."""

from __future__ import annotations

import json
from importlib import resources

import numpy as np

from pbl_pipeline.gait.normative import harmonic_sum

_TABLES = json.loads(resources.files("pbl_pipeline.synthetic").joinpath("data/curves.json").read_text(encoding="utf-8"))

#: Degrees over one gait cycle of one side, its foot contact at phase 0: the mean, then (cosine, sine) of harmonic 1, 2
#: and so on. The project's own numbers: harmonics through values written down every 5 % of the cycle to follow the
#: course of textbook curves of healthy adults at their own speed (Perry and Burnfield, Gait Analysis, 2010; the shape
#: of the group means of Schwartz et al. 2008, J Biomech 41:1639). Hip flexion is that of the fitted body, whose pelvis
#: is level where Plug-in Gait's tips forward by 12 deg (`normative.offset_deg`). Subtalar: inversion positive; mtp:
#: extension positive. The arm swings against the leg of its side and is furthest back at that side's foot contact.
SIDE_CURVES_DEG: dict[str, tuple[float, ...]] = {n: tuple(c) for n, c in _TABLES["side_curves_deg"].items()}

#: The same for pelvis and trunk over the cycle of the right side. Pelvis: posterior tilt, right side down and right
#: side ahead positive, against the walking direction (the signs of the model's axes forward, up, right).
MIDDLE_CURVES_DEG: dict[str, tuple[float, ...]] = {n: tuple(c) for n, c in _TABLES["middle_curves_deg"].items()}

#: How the means of the curves differ between people (standard deviation, deg), about what Schwartz et al. 2008 give
#: for the legs; drawn within two standard deviations.
OFFSET_SD_DEG: dict[str, float] = _TABLES["offset_sd_deg"]


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
