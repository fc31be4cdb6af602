"""Where a track was going: a straight line through a piece of it."""

from __future__ import annotations

import numpy as np

from .associate import Trail, measure


def line_near(trail: Trail, at_s: float, length_s: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Place (2,) px at `at_s`, velocity (2,) px/s and height in px, of the sightings within `length_s` of it.

    None where there are fewer than three.
    """
    near = [i for i, t in enumerate(trail.times) if abs(t - at_s) <= length_s]
    if len(near) < 3:
        return None
    states = np.array([measure(trail.detections[i]) for i in near])
    tau = np.array([trail.times[i] for i in near]) - at_s
    slope, place = np.polyfit(tau, states[:, :2], 1)
    return place, slope, float(np.exp(np.median(states[:, 2])))
