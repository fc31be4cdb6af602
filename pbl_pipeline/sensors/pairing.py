"""Which sensor is on which segment, as they move: names sensors that were exchanged or put on another segment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from .orientation import SAMPLE_S, Orientation, rate_of
from .start import BODY_OF, RATE_SD, UP_SD, Moved, smooth

#: Clocks that are tried beside the one found with the stated segments (s): all of half a stride.
RANGE_S, STEP_S = 0.6, 0.02
#: Gain in the sum of the logarithms of the misfits from which on another pairing counts as the right one. Of 16 logs of
#: synthetic walks with the measured wobble and twice it, the right pairing had at most 0.04, wrong ones 0.12 and more
#: (shank and foot of one leg, which move alike) or 0.4 and more (all others).
GAIN = 0.1


def better_pairing(seen: Moved, clock: float, sensors: Sequence[Orientation]) -> tuple[str, ...]:
    """The segment of each sensor: the stated one, unless another pairing of all explains their rates much better at any
    clock that all have in common."""
    names, n = list(BODY_OF), len(seen.time)
    stated = [names.index(s.log.segment) for s in sensors]
    margin = int(RANGE_S / SAMPLE_S)
    starts = np.arange(0, 2 * margin + 1, int(STEP_S / SAMPLE_S))
    time = seen.time[0] + clock + SAMPLE_S * np.arange(-margin, n + margin)
    ours = [seen.rate[k] for k in names], [seen.rotation[k][:, 2] for k in names]
    misfit = np.zeros((len(starts), len(sensors), len(names)))
    for j, sensor in enumerate(sensors):
        quat = sensor.at(time)[0]
        theirs = smooth(rate_of(quat)), Rotation.from_quat(quat, scalar_first=True).as_matrix()[:, 2]
        rates, ups = (np.stack([a[i : i + n] for i in starts]) for a in theirs)
        for i, (rate, up) in enumerate(zip(*ours, strict=True)):
            by_rate = np.einsum("ti,ltj->lij", rate, rates)
            both = by_rate / RATE_SD**2 + np.einsum("ti,ltj->lij", up, ups) / UP_SD**2
            U, _, Vt = np.linalg.svd(both)
            U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
            power = np.sum(rate**2) + np.sum(rates**2, axis=(1, 2))
            misfit[:, j, i] = np.log(np.maximum(1 - 2 * np.sum((U @ Vt) * by_rate, axis=(1, 2)) / power, 1e-3))
    best = min((linear_sum_assignment(m)[1] for m in misfit), key=lambda a: np.min(_sum(misfit, a)))
    gained = np.min(_sum(misfit, stated)) - np.min(_sum(misfit, best))
    return tuple(names[i] for i in (best if gained > GAIN else stated))


def _sum(misfit: np.ndarray, pairing: Sequence[int]) -> np.ndarray:
    """Misfits of a pairing at each clock."""
    return misfit[:, np.arange(len(pairing)), pairing].sum(axis=1)
