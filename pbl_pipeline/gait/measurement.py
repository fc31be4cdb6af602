"""Measurement model of the index: scores of a person, their error, and the probability that a change is real.

A pass p in view v shows the scores y of a person's mean curves, of both sides in the components of a normative set:

    y_p = m + b_v + G_v (s - m) + person + visit + view + pass_p

s are the true scores, m their mean over people; b_v and G_v bias and gain of detector and fit (a prior pulls postures
together, so G is not 1); `person` is the same in all passes of a person, `visit` in all that are fitted together, with
one body, `view` in all of one view, `pass_p` is new in each pass. All terms are normal; their covariances are variance
components of walks whose truth is known, on persons who are not held out (`research.corpus.measurement`;
docs/measures.md). From several passes, s is estimated at once: the mean and covariance of a normal posterior (Rasmussen
& Williams 2006, Gaussian Processes for Machine Learning, eq. A.6).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincc

from pbl_pipeline.results.events import LEFT, RIGHT
from pbl_pipeline.results.measures import minimal_change_of
from pbl_pipeline.shipped import shipped_model

from .cycle_measures import CYCLE_SPREAD, sampling_sd
from .normative import NormativeSet

#: Minimal important change of the index: half a standard deviation of healthy people, which is 10 points. A convention
#: (Norman, Sloan & Wyrwich 2003, Medical Care 41:582-592), not measured with patients.
IMPORTANT_CHANGE = 5.0
#: Fraction of the variance of two visits' common errors that does not cancel when the gait has changed
#: (`research.corpus.measurement`). Of the index: the one of 0, 0.1 ... with the least logarithmic loss of the two
#: probabilities over pairs of walks of tuning persons; on passes drawn again 0.2 to 0.5 differ by at most 0.02. Of gait
#: measures: 1 less the products of the errors of two walks of a person by those of one walk at two visits; 0.14 to 0.21
#: where the common error is the larger part of a measure.
REMAINS, MEASURES_REMAIN = 0.3, 0.2
#: Mean absolute change of the true index between two walks of one tuning person (`research.corpus.true_changes`).
USUAL_CHANGE = 7.8


class Chances(NamedTuple):
    """Probabilities that the true change has the sign of the measured one, and that it also is at least the minimal
    important change; None if that is not defined."""

    real: float
    important: float | None


def change_sd(minimal_changes: tuple[float, float], sds: tuple[float, float], remains: float = REMAINS) -> float:
    """Return the standard deviation of the error of a change between two visits filmed alike.

    Parameters
    ----------
    minimal_changes
        Minimal detectable change (90 %) of each visit, from its new error.
    sds
        Standard deviation of the whole error of each.
    remains
        `REMAINS` or `MEASURES_REMAIN`.
    """
    anew = sum((c / minimal_change_of(1.0)) ** 2 for c in minimal_changes)
    whole = sum(s**2 for s in sds)
    return math.sqrt(anew + remains * max(whole - anew, 0.0))


def chances(by: float, sd: float, important: float | None = None) -> Chances:
    """Return the probabilities of a true change, from the measured one `by` whose error is normal with standard
    deviation `sd`.

    A change of the index, which has an `important` one, is a priori double exponential with the mean absolute value
    `USUAL_CHANGE`; the posterior is the two normal tails of Bayes' theorem. One of a measure is a priori uniform.
    """
    size, least = abs(by), important or 0.0
    rate = 0.0 if important is None else 1.0 / USUAL_CHANGE

    def beyond(limit: float) -> float:
        return math.exp(-rate * size) * _tail((limit - size) / sd + rate * sd)

    real = beyond(0.0)
    whole = real + math.exp(rate * size) * _tail(size / sd + rate * sd)
    return Chances(real / whole, None if important is None else beyond(least) / whole)


def _tail(z: float) -> float:
    return 0.5 * math.erfc(z / math.sqrt(2.0))


#: Draws of the scores for an expected index, of two visits' errors for the index's own error, and of people.
N_DRAWS, N_VISITS, N_PEOPLE = 512, 64, 2048
#: The index where the line of `unshrunk_index` bends, one standard deviation below the healthy mean, and the largest
#: standard deviation of its error with which it is stated.
BEND, MOST_UNSURE = 90.0, 30.0
#: How much the gains of all models are drawn towards 1 (ridge regression; deg^2 of the scores' variance): of 30, 100,
#: 300 the one with the least mean square error of one pass of tuning persons left out in turn.
RIDGE = 300.0
_FOLDER = resources.files("pbl_pipeline.gait").joinpath("measurement_models")


#: Passes disagree where the probability of a difference like theirs, times their number, is below this. Of visits of
#: tuning persons 0.2 % do, of persons held out 0.2 % (`research.corpus.measurement`, model `blazepose-33`).
DISAGREE = 1e-4


class Pass(NamedTuple):
    """Scores (K,) of the mean curves of the left and the right side, NaN for a side without cycles, the number of
    cycles of each, the leg behind the other (`GaitCycle.far_leg`), which defines the view, and the name of the trial.

    `doubt` (2K,): error of one standard deviation that it has in addition (`with_doubts`)."""

    scores: tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]
    n_cycles: tuple[int, int]
    far_leg: str
    trial: str = ""
    doubt: Float[np.ndarray, " 2K"] | None = None


@dataclasses.dataclass(frozen=True)
class View:
    """Terms of one view for the scores of both sides, left before right: `bias` (2K,), `gain` (2K, 2K), and the
    covariances (2K, 2K) of the errors of a view and of a pass."""

    bias: np.ndarray
    gain: np.ndarray
    view: np.ndarray
    anew: np.ndarray

    def mirrored(self) -> View:
        """The same view of a mirrored person."""
        turn = np.roll(np.arange(len(self.bias)), len(self.bias) // 2)
        both = np.ix_(turn, turn)
        return View(self.bias[turn], self.gain[both], self.view[both], self.anew[both])


class MeasureError(NamedTuple):
    """Root mean squares, in its unit, of the parts of a gait measure's error: `lasting` at all visits of a person
    (with the bias), `visit` the same in all passes of one visit, `anew` drawn in each pass."""

    lasting: float
    visit: float
    anew: float


@dataclasses.dataclass(frozen=True)
class MeasurementModel:
    """A measured model."""

    #: Its own and that of the normative set whose components the scores belong to.
    name: str
    norm: str
    fits: Sequence[str]  # hashes of the fit parameters that it was measured with
    #: Mean (2K,) and covariance (2K, 2K) of people's true scores.
    mean: np.ndarray
    spread: np.ndarray
    person: np.ndarray  # covariance (2K, 2K) of the error that all passes of a person share
    visit: np.ndarray  # and of the one that passes fitted together share
    #: By `GaitCycle.far_leg`: "left", "right", or "" where neither leg is behind the other (front, back).
    views: dict[str, View]
    #: Covariance (K, K) of a cycle's scores about the mean of its side, and how many cycles of a side the passes had.
    cycle: np.ndarray
    n_cycles: float
    widening: float  # factor of the index's standard deviation with which 90 % intervals of persons left out held 90 %
    events: str  # hash of the event method that the gait measures were found with
    pass_cycles: float  # cycles of both sides of one pass, of which the gait measures are means
    #: Errors of the gait measures, by view (far leg "left" or "", mirrored views alike) and measure.
    measures: Mapping[str, Mapping[str, MeasureError]]
    curves: Sequence[str] = ()  # `Keypoints.confidence_curve` of the detectors that it is for; none: of all others


class Posterior(NamedTuple):
    """Mean (2K,) and covariance (2K, 2K) of the scores, and the covariance that errors of passes drawn anew give the
    mean."""

    mean: np.ndarray
    covariance: np.ndarray
    anew: np.ndarray


class ExpectedIndex(NamedTuple):
    """Expectation of the index of each side and of their mean over the scores' error, the standard deviation of the
    mean, and that which passes drawn anew give it."""

    left: float
    right: float
    mean: float
    sd: float
    sd_anew: float


def model_names() -> tuple[str, ...]:
    """Return the names of the models that ship."""
    return tuple(sorted(f.name.removesuffix(".json") for f in _FOLDER.iterdir() if f.name.endswith(".json")))


@functools.cache
def load_model(name: str) -> MeasurementModel:
    """Return a model that ships, by its name."""
    arrays = ("mean", "spread", "person", "visit", "cycle")
    data = shipped_model(f"gait/measurement_models/{name}.json", arrays)
    errors = {k: {n: MeasureError(*e) for n, e in view.items()} for k, view in data.pop("measures").items()}
    views = {k: View(**{n: np.array(v) for n, v in view.items()}) for k, view in data.pop("views").items()}
    views[RIGHT] = views[LEFT].mirrored()
    return MeasurementModel(**data, views=views, measures=errors)


@functools.cache
def model_of_fit(params_hash: str, confidence_curve: str) -> str:
    """Return the name of the model that was measured with a fit's parameters and the detector of this curve; empty if
    there is none."""
    models = [load_model(n) for n in model_names()]
    known = any(confidence_curve in m.curves for m in models)
    suited = (
        m.name for m in models if params_hash in m.fits and (confidence_curve in m.curves or not (known or m.curves))
    )
    return next(suited, "")


class _Joint(NamedTuple):
    """All seen scores of some passes (N,) less those of the mean person, their gain (N, 2K), the covariances of their
    error with the true scores (N, 2K), of their whole error (N, N) and of its new part, and which pass each is of."""

    off: np.ndarray
    gain: np.ndarray
    slip: np.ndarray
    error: np.ndarray
    anew: np.ndarray
    owner: np.ndarray


def _joint(model: MeasurementModel, passes: Sequence[Pass]) -> _Joint:
    size, n = len(model.mean), len(passes)
    views = [model.views[p.far_leg] for p in passes]
    scores = np.concatenate([np.concatenate(p.scores) for p in passes])
    gain = np.vstack([v.gain for v in views])
    expected = np.concatenate([model.mean + v.bias for v in views])
    anew = _blocks(v.anew + _fewer_cycles(model, p) + _doubted(p) for v, p in zip(views, passes, strict=True))
    anew += np.tile(model.visit, (n, n))
    error = anew + np.tile(model.person, (n, n))
    for far_leg, view in model.views.items():
        same = np.repeat([p.far_leg == far_leg for p in passes], size)
        error += np.tile(view.view, (n, n)) * np.outer(same, same)
    seen = np.isfinite(scores)
    both, owner = np.ix_(seen, seen), np.repeat(np.arange(n), size)
    slip = RIDGE * (gain - np.tile(np.eye(size), (n, 1)))  # what ridge regression leaves, exactly
    return _Joint((scores - expected)[seen], gain[seen], slip[seen], error[both], anew[both], owner[seen])


def estimate(model: MeasurementModel, passes: Sequence[Pass]) -> Posterior:
    """Estimate the scores of a person from all passes of a visit together. At least one pass has cycles of a side."""
    off, gain, _, error, anew, _ = _joint(model, passes)
    weighed = np.linalg.solve(error, gain)
    covariance = np.linalg.inv(gain.T @ weighed + np.linalg.inv(model.spread))
    filtered = covariance @ weighed.T
    return Posterior(model.mean + filtered @ off, covariance, filtered @ anew @ filtered.T)


def unshrunk_index(
    model: MeasurementModel, passes: Sequence[Pass], norm: NormativeSet
) -> tuple[float, float] | tuple[None, None]:
    """Return the index without people's distribution as prior knowledge of this person, and the standard deviation of
    its error, of people like those whom the passes suggest; None where that is above `MOST_UNSURE`. Both sides must
    have cycles.

    Errors lower the index of generalised least-squares scores, high ones most; independent ones would lower it more. So
    it is calibrated, among people of the model filmed alike, by a line with a bend, which is as large on average as the
    true index whatever that is (classical calibration by the moment equations of an instrument, the true index).
    """
    off, gain, slip, error, *_ = _joint(model, passes)
    weighed = np.linalg.solve(error, gain)
    covariance = np.linalg.inv(gain.T @ weighed)
    slip = covariance @ weighed.T @ slip
    turn = np.linalg.solve(model.spread, slip.T)
    errors = _drawn(covariance - slip @ turn, N_PEOPLE, 3)

    def found(true: np.ndarray) -> np.ndarray:
        return _index(true + (true - model.mean) @ turn + errors, norm).mean(axis=-1)

    people = model.mean + _drawn(model.spread, N_PEOPLE, 2)
    true = _index(people, norm).mean(axis=-1)
    line = np.linalg.solve(_bent(true) @ _bent(found(people)).T, _bent(true) @ true)
    likely = estimate(model, passes)
    alike = likely.mean + _drawn(likely.covariance, N_PEOPLE, 4)
    sd = model.widening * float(np.std(line @ _bent(found(alike)) - _index(alike, norm).mean(axis=-1)))
    if not sd <= MOST_UNSURE:
        return None, None
    return float(line @ _bent(_index(model.mean + covariance @ (weighed.T @ off), norm).mean(axis=-1))), sd


def _bent(index: np.ndarray) -> np.ndarray:
    """Terms (3, ...) of a line that bends at `BEND`."""
    return np.stack([np.ones_like(index), index, np.maximum(index - BEND, 0.0)])


def with_doubts(model: MeasurementModel, passes: Sequence[Pass]) -> list[Pass]:
    """Return the passes, those that disagree with the others with a doubt: how far their scores are from those that the
    others let expect.

    One after another the least probable pass given the others is taken out, until the rest agree (`DISAGREE`,
    chi-square). Where no majority agrees it cannot be told which ones are wrong, and all of them are doubted.
    """
    left, doubts = list(range(len(passes))), {}
    while len(left) > 1:
        found = _apart(model, [passes[i] for i in left])
        worst = min(range(len(left)), key=lambda i: found[i][0])
        if found[worst][0] * len(left) >= DISAGREE:
            break
        doubts[left.pop(worst)] = found[worst][1]
    if 2 * len(doubts) >= len(passes) > 1:
        doubts = {i: doubt for i, (_, doubt) in enumerate(_apart(model, passes))}
    return [p._replace(doubt=doubts.get(i)) for i, p in enumerate(passes)]


def _apart(model: MeasurementModel, passes: Sequence[Pass]) -> list[tuple[float, np.ndarray]]:
    """Of each pass the probability of scores at least so far from those that the others let expect, and how far they
    are (2K,), 0 where it has none."""
    off, gain, _, error, _, owner = _joint(model, passes)
    precision = np.linalg.inv(gain @ model.spread @ gain.T + error)
    pull, out = precision @ off, []
    for i, p in enumerate(passes):
        own = owner == i
        away = np.linalg.solve(precision[np.ix_(own, own)], pull[own])
        far = np.zeros(len(model.mean))
        far[np.isfinite(np.concatenate(p.scores))] = away
        out.append((float(gammaincc(own.sum() / 2, max(away @ pull[own], 0.0) / 2)), far))
    return out


def expected_index(posterior: Posterior, norm: NormativeSet, widening: float = 1.0) -> ExpectedIndex:
    """Return the index of scores with an error: its expectation, not the index of the expected scores, because an
    error in any direction lengthens a short distance from the norm."""
    spread, visits = _drawn(posterior.covariance, N_DRAWS, 0), _drawn(posterior.anew, N_VISITS, 1)
    sides = _index(posterior.mean + spread, norm)
    anew = _index(posterior.mean + visits[:, None] + spread[None, ::4], norm).mean(axis=(1, 2))
    left, right = sides.mean(axis=0)
    sd = widening * float(sides.mean(axis=1).std())
    return ExpectedIndex(float(left), float(right), float(sides.mean()), sd, float(anew.std()))


def measure_error(
    model: MeasurementModel, name: str, n: int, own: float | None = None, freedom: int = 0
) -> tuple[float, float] | None:
    """Return the standard deviation of the error of a gait measure that is the mean over n cycles of a visit, and of
    the part that is new at another visit, both in its unit; None if it was not measured in all views.

    Views count alike, so that neither gets smaller when cycles or passes are left out. `own` is the spread of the
    cycles within a side, with `freedom` degrees of freedom: a larger one than is usual counts by `sampling_sd`.
    """
    errors = [of_view[name] for of_view in model.measures.values() if name in of_view]
    if len(errors) < len(model.measures):
        return None
    lasting, visit, anew = np.sqrt(np.mean(np.square(errors), axis=0))
    usual = float(np.hypot(CYCLE_SPREAD.get(name, 0.0), anew * np.sqrt(model.pass_cycles)))
    new = math.hypot(visit, sampling_sd(usual, n, own, freedom))
    return math.hypot(lasting, new), new


def with_one_more(model: MeasurementModel, passes: Sequence[Pass], norm: NormativeSet) -> dict[str, float]:
    """Return the standard deviation that the index would have after one more pass, by the leg that is behind in it:
    that of the present scores with the posterior covariance after such a pass."""
    now, unseen = estimate(model, passes), np.zeros(len(model.mean) // 2)
    cycles = round(model.n_cycles)
    out = {}
    for far_leg in model.views:
        typical = Pass((unseen, unseen), (cycles, cycles), far_leg)
        then = now._replace(covariance=estimate(model, [*passes, typical]).covariance)
        out[far_leg] = expected_index(then, norm, model.widening).sd
    return out


def _fewer_cycles(model: MeasurementModel, seen: Pass) -> np.ndarray:
    """Covariance (2K, 2K) that a pass with fewer cycles than the measured ones has in addition."""
    return _blocks(max(0.0, 1.0 / max(n, 1) - 1.0 / model.n_cycles) * model.cycle for n in seen.n_cycles)


def _doubted(seen: Pass) -> np.ndarray:
    return np.zeros(()) if seen.doubt is None else np.outer(seen.doubt, seen.doubt)


def _index(scores: np.ndarray, norm: NormativeSet) -> np.ndarray:
    return norm.index_of_scores(scores.reshape(*scores.shape[:-1], 2, -1))


def _drawn(covariance: np.ndarray, n: int, seed: int) -> np.ndarray:
    """Normal draws (n, 2K) of this covariance, the same at each call and each with its opposite and its mirror image:
    an index changes only with its scores, and mirrored scores have the mirrored index."""
    own = np.random.default_rng(seed).standard_normal((n // 4, len(covariance)))
    both = np.concatenate([own, np.roll(own, len(covariance) // 2, axis=1)])
    return np.concatenate([both, -both]) @ _root(covariance).T


def _root(covariance: np.ndarray) -> np.ndarray:
    """A matrix whose product with its transpose is a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T


def _blocks(parts: Iterable[np.ndarray]) -> np.ndarray:
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*parts))
