"""Vertical force of both feet together, from the motion of one camera and a model of people's forces.

Second derivatives of such a motion are noisy, and the force on the floor differs little between people who walk at one
speed. So the force F (body weights) is a Gaussian process over the phase of double and single support,

    F = m(speed, phase) + person(phase) + step(time),

of which the motion shows y - 1 = gain S (F - 1) + noise: a fit smooths (S), and the noise is that of the camera's set
of points. The result is the mean of the normal posterior (Rasmussen & Williams 2006, Gaussian Processes for Machine
Learning, eq. 2.25), and draws from it. Where the noise is small and nothing is smoothed, y remains. A model's numbers
are in `vertical_models`, made by `python -m research.vertical_force`.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve, toeplitz

from pbl_pipeline.runs import runs
from pbl_pipeline.shipped import shipped_model

from .dynamics import GRAVITY, GRID_HZ
from .ground import phases

#: Every third of the observed frames is used: 33 a second suffice for a low-passed motion.
_EVERY = 3
#: Longer recordings are estimated in parts (frames).
_PART = 1500


class Noise(NamedTuple):
    """Error of the force that a motion of one camera needs: its standard deviation (body weights) and gain, by how
    much more than the posterior's standard deviation known walks were off (`widening`), and the standard deviation of
    the Gaussian over time with which the fit smooths."""

    sd: float
    gain: float
    widening: float
    smoothing_s: float


@dataclasses.dataclass(frozen=True, eq=False)  # a model is itself alone, so that results of one can be kept
class VerticalModel:
    """Model of the variation of the vertical force; forces in body weights.

    Attributes
    ----------
    name
        Of the model, with its version.
    phase
        (P,): 0 to 1 over double support, 1 to 2 over single support.
    mean, slope
        (P,): mean force at the dimensionless speed `speed`, and its change with that speed.
    person
        (P, K): components of persons' departures from it, each as large as one standard deviation.
    speed_range
        Least and greatest dimensionless speed (speed over the root of gravity times stature) of the walks.
    step_sd, step_memory_s
        Standard deviation and correlation time of the part of a step.
    noise_memory_s
        Correlation time of the noise.
    noise
        By marker set of one camera; the force of other sets is that of the motion.
    """

    name: str
    phase: np.ndarray
    mean: np.ndarray
    slope: np.ndarray
    person: np.ndarray
    speed: float
    speed_range: tuple[float, float]
    step_sd: float
    step_memory_s: float
    noise_memory_s: float
    noise: dict[str, Noise]

    def expected(self, speed: float) -> Float[np.ndarray, " P"]:
        """Return the mean force at a dimensionless speed; beyond the walks of the model that of the nearest."""
        return self.mean + self.slope * (float(np.clip(speed, *self.speed_range)) - self.speed)


@dataclasses.dataclass(frozen=True)
class VerticalForce:
    """Posterior of the force at N times (body weights): `mean` (N,), and `draw` of it."""

    mean: np.ndarray
    parts: tuple[_Part, ...]

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
        """Return one force that is as likely as the model and the motion allow."""
        out = self.mean.copy()
        for part in self.parts:
            out[part.at] += part.departure(rng)
        return out


@dataclasses.dataclass(frozen=True)
class _Part:
    """A stretch of known phase: its frames, in each the weights of the model's knots and the components of persons;
    what the motion shows of the force in the observed frames, its covariance with the force, and the factor of that of
    the observed frames."""

    at: slice
    model: VerticalModel
    noise: Noise
    knots: np.ndarray
    person: np.ndarray
    shows: np.ndarray
    shared: np.ndarray
    factor: Any

    def update(self, observed: np.ndarray) -> np.ndarray:
        """Return the update of the force by observations (of departures from their expectation)."""
        return self.shared @ cho_solve(self.factor, observed)

    def departure(self, rng: np.random.Generator) -> np.ndarray:
        """Draw force and noise of the prior; what the update makes of them is as far off as the posterior is
        (Matheron's rule)."""
        m, n = self.model, len(self.person)
        force = self.person @ rng.standard_normal(self.person.shape[1])
        force += m.step_sd * _alike(rng, n, m.step_memory_s)
        noise = self.noise.sd * _alike(rng, n, m.noise_memory_s)[::_EVERY]
        return self.noise.widening * (force - self.update(self.shows @ force + noise))


@functools.cache
def load_vertical_model(name: str) -> VerticalModel:
    """Return an included model."""
    data = shipped_model(f"kinetics/vertical_models/{name}.json", ("phase", "mean", "slope", "person"))
    noise = {k: Noise(*v) for k, v in data.pop("noise").items()}
    return VerticalModel(**data, noise=noise)


def support_phase(stands: np.ndarray) -> Float[np.ndarray, " N"]:
    """Return the phase of support: 0 to 1 over double support, 1 to 2 over single support, NaN where no foot stands.
    `stands` (N, 2)."""
    feet = stands.sum(axis=1)
    out = np.full(len(feet), np.nan)
    for n, begin in ((2, 0.0), (1, 1.0)):
        for run, phase in phases(feet == n, feet > 0):
            out[run] = begin + phase
    return out


def dimensionless_speed(centre_m: Float[np.ndarray, "N 3"], stature_m: float) -> float:
    """Return the mean speed of the centre of mass along the floor over the root of gravity times stature."""
    moved = np.linalg.norm(np.diff(centre_m[:, :2], axis=0), axis=1)
    return float(GRID_HZ * moved.mean() / np.sqrt(GRAVITY * stature_m))


def vertical_force(
    needed_bw: Float[np.ndarray, " N"],
    stands: Float[np.ndarray, "N 2"],
    speed: float,
    model: VerticalModel,
    noise: Noise,
) -> VerticalForce:
    """Estimate the vertical force of both feet.

    Parameters
    ----------
    needed_bw
        Force that the motion needs, on the grid of `GRID_HZ`.
    stands
        Whether [left, right] is on the floor.
    speed
        `dimensionless_speed`.
    model, noise
        How forces vary, and how `needed_bw` errs. Without noise the result is `needed_bw`.
    """
    mean, parts = np.array(needed_bw, float), _parts(np.asarray(stands, bool).tobytes(), model, noise)
    for part in parts:
        expected = part.knots @ model.expected(speed)
        mean[part.at] = expected + part.update(needed_bw[part.at][::_EVERY] - 1.0 - part.shows @ (expected - 1.0))
    return VerticalForce(mean, parts)


@functools.lru_cache(maxsize=4)  # what is drawn of a recording has the same steps
def _parts(stands: bytes, model: VerticalModel, noise: Noise) -> tuple[_Part, ...]:
    """Return the stretches of known phase of `stands` (N, 2), as bytes."""
    phase, parts = support_phase(np.frombuffer(stands, bool).reshape(-1, 2)), []
    for run in runs(np.isfinite(phase)):
        for frames in np.array_split(np.arange(run.start, run.stop), -(-(run.stop - run.start) // _PART)):
            at = slice(int(frames[0]), int(frames[-1]) + 1)
            parts.append(_part(at, phase[at], model, noise))
    return tuple(parts)


def _part(at: slice, phase: np.ndarray, model: VerticalModel, noise: Noise) -> _Part:
    n, knots = len(phase), _rows(phase, model.phase)
    person = knots @ model.person
    prior = person @ person.T + model.step_sd**2 * _kernel(n, model.step_memory_s)
    smooth = _kernel(n, noise.smoothing_s)
    shows = noise.gain * (smooth / smooth.sum(axis=1, keepdims=True))[::_EVERY]
    own = noise.sd**2 * _kernel(n, model.noise_memory_s) + 1e-9 * np.eye(n)
    shared = prior @ shows.T
    factor = cho_factor(shows @ shared + own[::_EVERY, ::_EVERY])
    return _Part(at, model, noise, knots, person, shows, shared, factor)


def _rows(phase: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return the matrix that interpolates between knots of the phase, which closes on itself."""
    n = len(knots)
    around = np.concatenate([knots[-1:] - 2.0, knots, knots[:1] + 2.0])
    right = np.clip(np.searchsorted(around, phase), 1, n + 1)
    weight = (phase - around[right - 1]) / (around[right] - around[right - 1])
    out = np.zeros((len(phase), n))
    np.add.at(out, (np.arange(len(phase)), (right - 2) % n), 1.0 - weight)
    np.add.at(out, (np.arange(len(phase)), (right - 1) % n), weight)
    return out


def _kernel(n: int, memory_s: float) -> np.ndarray:
    return toeplitz(np.exp(-0.5 * (np.arange(n) / (GRID_HZ * memory_s)) ** 2))


def _alike(rng: np.random.Generator, n: int, memory_s: float) -> np.ndarray:
    """Draw a process of variance 1 whose correlation is that of `_kernel`."""
    # A kernel of this shape convolved with itself is that of `_kernel`.
    reach = int(5 * GRID_HZ * memory_s) + 1
    weights = np.exp(-((np.arange(-reach, reach + 1) / (GRID_HZ * memory_s)) ** 2))
    return np.convolve(rng.standard_normal(n + 2 * reach), weights / np.linalg.norm(weights), "valid")
