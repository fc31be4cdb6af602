"""Gait Deviation Index: the paper's of three angles, and the original of nine."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import FILMED_FROM
from pbl_pipeline.methods import Method, Stage
from pbl_pipeline.paramset import Paramset, later
from pbl_pipeline.qc import EMPTY, PASS, Check, warn_if
from pbl_pipeline.results.cycles import GaitCycle
from pbl_pipeline.results.events import LEFT, RIGHT
from pbl_pipeline.results.index import GDI_MODEL, GILLETTE_MODEL, NUMBERS, PAPER_INDEX, Gdi, GdiCycle
from pbl_pipeline.results.measures import Z90, minimal_change_of

from .cycle_measures import far_leg_of
from .measurement import (
    MeasurementModel,
    Pass,
    estimate,
    expected_index,
    load_model,
    unshrunk_index,
    with_doubts,
    with_one_more,
)
from .normative import (
    DEFAULT_NORM,
    NINE_ANGLES,
    THREE_ANGLES,
    NormativeSet,
    check_degrees,
    load_norm,
    norm_names,
)
from .types import ANY_PACE, SELF_SELECTED, feature_vector, movement_profile, variable_scores


@dataclasses.dataclass(frozen=True)
class GdiParams:
    """Parameters of the index.

    norm
        Name of the normative set.
    min_cycles_per_side
        With fewer used cycles of either side there is no index.
    advised_cycles
        With fewer in all there is a warning: single cycles vary by several points.
    min_explained
        Least fraction of a cycle's deviation inside the normative components, below which there is a warning.
    repeated
        Fraction of the variance of the angles' error that two visits of one person, filmed alike, have in common:
        errors of the marker positions and priors for this person, not the detector's random ones.
    lasting
        Fraction of the variance of a sample's error (`GaitCycle.curves_sd`) that counts as the same over a cycle and in
        all cycles of a side; the rest differs from sample to sample, and means of curves lose it.
    both_sides
        Correlation of that lasting error between the two sides.
    lengthening
        Fraction of the variance of a sample's error that counts as lengthening the distance from the norm (`_shorter`).
    pace
        Measures and index of a session pool the trials that are walked at this pace: one of `PACES`, another word, or
        "any".
    average
        Average over cycles: of their indices ("cycles", as in the paper) or, for each side, of their curves ("curves").
        Random differences between cycles add to the distance of each cycle from the norm, and so lower a mean of
        indices, most of all near 100. "passes": the index expected from all passes together by the measured model of
        their error (`gait/measurement.py`); as "curves" if these cycles or this norm have none.
    """

    norm: str = DEFAULT_NORM
    min_cycles_per_side: int = 1
    advised_cycles: int = 10
    min_explained: float = 0.5
    repeated: float = later(0.75)
    pace: str = later(SELF_SELECTED)
    average: str = later("cycles")
    lasting: float = later(1.0)
    both_sides: float = later(1.0)
    lengthening: float = later(0.0)


#: Angles that an index is made of.
MODEL_ANGLES: dict[str, tuple[str, ...]] = {GDI_MODEL: THREE_ANGLES, GILLETTE_MODEL: NINE_ANGLES}
#: Version 1 of the index of three angles had the norm `gillette-166-three-angles`; version 2 is the mean of the indices
#: of the cycles, as the paper's; version 3 took all of the angles' error as lasting and the same on both sides. The
#: correlation of the sides' lasting errors on the tuning persons of `research.corpus`: hip flexion 0.5 to 0.8, knee 0
#: to 0.4, adduction -0.9 to 0.2. `lengthening` is the one of 0, 0.05, 0.1 ... with which the index and its change
#: between two visits err least with 33 points on these persons (the sum of both mean squares); version 4 had 0.2.
#: Version 6 takes the measured model of the error where there is one; these constants serve where there is none.
#: Version 7: a direction of walking is one pass, at whatever angle it is seen; passes that disagree count less. Version
#: 8: the unshrunk index takes the errors as dependent on the true scores (before: 0.7 of their variance, independent).
GDI_METHODS: Stage[GdiParams] = Stage("gdi", "family", GDI_MODEL)
GDI_METHODS.register(
    GDI_MODEL,
    8,
    GdiParams(average="passes", lasting=0.5, both_sides=0.25, lengthening=0.05),
    "pbl_pipeline.gait:score_gdi",
)
GDI_METHODS.register(GILLETTE_MODEL, 1, GdiParams(norm="gillette-166-nine-angles"), "pbl_pipeline.gait:score_gdi")
GDI_METHODS.register(PAPER_INDEX, 1, GdiParams(average="cycles", pace=ANY_PACE))


#: Errors count as at most so many times the squared distance that was found: a larger correction would be a guess.
MOST_LONGER = 2.0
#: A trial whose mean curve of an angle is farther than this from the others' (deg, root mean square) is named: twice
#: the error above which gait analysis misleads (McGinley et al. 2009, Gait & Posture 29:360-369).
APART_DEG = 10.0


def score_gdi(
    cycles: Sequence[GaitCycle],
    norm: NormativeSet | str | None = None,
    params: GdiParams | None = None,
    model: Method[GdiParams] | str | None = None,
    error_model: MeasurementModel | None = None,
) -> Gdi:
    """Gait Deviation Index over the used cycles of one or several trials.

    The curves of the norm's angles, of a cycle or the mean of a side's, make a vector; the Euclidean distance of its
    normative component scores to the normative mean, logarithm, standardised by the normative cycles, GDI = 100 - 10 z
    (Schwartz & Rozumalski 2008, Gait & Posture 28:351-357). 100 is normative, each 10 points one normative standard
    deviation.

    `gillette-2008` is the original: nine angles at 51 points, the 15 published features. `pbl-2025-three-angles` is the
    paper's: hip flexion, hip adduction and knee flexion at 0, 2, ..., 98 %, principal components. The two must not be
    compared with each other.

    The components come from the norm, so deviations in directions in which its people do not vary are not counted;
    `GdiCycle.explained` is the fraction that was. If the fit has standard deviations of its angles, the lengthening of
    the distance by their errors is taken back (`GdiParams.lengthening`; docs/measures.md).

    Raises `PblError` NORM_UNKNOWN; NORM_INVALID for a norm without the model's angles; SOLVER_UNKNOWN for another
    model; ANGLE_UNITS for curves that are not in degrees.

    Parameters
    ----------
    cycles
        Only cycles with `used` and with curves count.
    norm
        A set or its name; None for that of `params`.
    params
        None for those of `model`, or without one for those of the index with the norm's angles.
    model
        A method of `GDI_METHODS`, or its name, which decides the angles. Without it the norm's angles decide; a norm of
        other angles than the two indices have makes an index with another name.
    error_model
        Model of the curves' error instead of the one that the cycles name.
    """
    method = GDI_METHODS.find(model)
    basis = norm_of(norm, params or method.params)
    params = params or params_of(basis, model)
    family = _model_of(basis, method.family.name if model else None)
    known = method if model else GDI_METHODS.get(family)
    model = method.name if model else family
    version = known.version if known else 1
    paramset = Paramset.of("gdi", model, version, dataclasses.replace(params, norm=basis.name))
    if model != family:  # a custom method names its family, as its row does
        paramset = dataclasses.replace(paramset, params={GDI_METHODS.kind: family, **paramset.params})
    usable = [c for c in cycles if c.used and all(v in c.curves for v in basis.variables)]
    vectors = [_vector(c, basis) for c in usable]
    scored = tuple(_score(c, v, basis) for c, v in zip(usable, vectors, strict=True))
    n_left, n_right = (sum(c.side == side for c in usable) for side in (LEFT, RIGHT))
    enough = bool(usable) and min(n_left, n_right) >= params.min_cycles_per_side
    reason = "" if enough else _too_few(cycles, n_left, n_right, params)
    numbers, profile, passes = dict[str, float | None].fromkeys(NUMBERS), None, []
    if enough:
        error_model = error_model or _model_of_error(usable, basis, params)
        if error_model is not None:
            passes = with_doubts(error_model, passes_of(usable, basis))
            expected = expected_index(estimate(error_model, passes), basis, error_model.widening)
            both = n_left and n_right
            unshrunk = unshrunk_index(error_model, passes, basis) if both else (None, None)
            errors = expected.sd, minimal_change_of(expected.sd_anew)
            found = expected.mean, expected.left, expected.right, *errors, *unshrunk
        else:
            parts = _parts(usable, vectors, basis, params)
            left, right = (_weighted([p for p in parts if p.side == side]) for side in (LEFT, RIGHT))
            mean = _weighted(parts)
            errors = _errors(parts, params)
            found = mean, left, right, *errors, mean, errors[0]
        numbers = dict(zip(NUMBERS, found, strict=True))
        scores = variable_scores(np.array(vectors), basis)
        sides = np.array([c.side for c in usable])
        profile = movement_profile({s: scores[sides == s] for s in (LEFT, RIGHT)}, basis)
    return Gdi(
        status=PASS if enough else EMPTY,
        reason=reason,
        **numbers,
        n=len(scored),
        n_left=n_left,
        n_right=n_right,
        norm=basis.name,
        model=model,
        params_hash=paramset.hash,
        cycles=scored,
        qc=(
            *_checks(scored, {c.angle_model for c in usable}, basis, reason, params),
            *(_agreement(passes, basis) if error_model else _trials_agree(usable, vectors, basis)),
        ),
        profile=profile,
    )


def norm_of(norm: NormativeSet | str | None, params: GdiParams) -> NormativeSet:
    """A set or the one of that name; None: that of the parameters."""
    wanted = params.norm if norm is None else norm
    return load_norm(wanted) if isinstance(wanted, str) else wanted


def params_of(norm: NormativeSet, model: Method[GdiParams] | str | None) -> GdiParams:
    """Parameters of a model; without one, of the index with the norm's angles, if there is one."""
    method = GDI_METHODS.find(model)
    return method.params if model is not None else GDI_METHODS.get(_model_of(norm, None), method).params


def worth_of_one_more(cycles: Sequence[GaitCycle], index: Gdi) -> str:
    """Return a sentence on the view from which one more pass narrows the interval most; empty if it is not known."""
    after = intervals_with_one_more(cycles, index)
    if not after or index.sd is None:
        return ""
    best = min(after, key=lambda side: after[side])
    where = {LEFT: "from the left side", RIGHT: "from the right side"}.get(best, "from the front or back")
    return (
        f"another pass filmed {where} would narrow the index's 90 % interval from +-{Z90 * index.sd:.0f} to "
        f"+-{after[best]:.0f}"
    )


def intervals_with_one_more(cycles: Sequence[GaitCycle], index: Gdi) -> dict[str, float]:
    """Return half the 90 % interval that the index of `cycles` would have after one more pass, by the side from which
    it is filmed ("left", "right", or "" for front and back); empty where the model of the error is not known."""
    method = GDI_METHODS.get(index.model)
    basis = load_norm(index.norm) if index.norm in norm_names() else None
    usable = [c for c in cycles if c.used and c.curves]
    if index.mean is None or method is None or basis is None or len(usable) != index.n:  # other cycles than its own
        return {}
    model = _model_of_error(usable, basis, method.params)
    if model is None:
        return {}
    passes = with_doubts(model, passes_of(usable, basis))
    return {FILMED_FROM.get(k, k): Z90 * sd for k, sd in with_one_more(model, passes, basis).items()}


def _model_of_error(cycles: Sequence[GaitCycle], norm: NormativeSet, params: GdiParams) -> MeasurementModel | None:
    """Return the measured model that all cycles have, with this norm's components."""
    names = {c.error_model for c in cycles}
    if params.average != "passes" or len(names) != 1 or "" in names:
        return None
    model = load_model(names.pop())
    return model if model.norm == norm.name else None


def passes_of(cycles: Sequence[GaitCycle], norm: NormativeSet) -> list[Pass]:
    """Return the passes of the cycles' trials, as scores of the mean curves of each side.

    All cycles of a trial that are walked in one direction have one view, that of most of them (`far_leg_of`): the error
    of a pass is drawn once, at whatever angle its cycles are seen. Directions that are seen from one side are one pass.
    """
    views = _views(cycles)
    scores = norm.scores(np.array([gdi_vector(c, norm) for c in cycles]))
    unseen = np.full(len(norm.components), np.nan)
    out = []
    for trial, far_leg in dict.fromkeys(views):
        own = [
            np.array([v == (trial, far_leg) and c.side == side for v, c in zip(views, cycles, strict=True)])
            for side in (LEFT, RIGHT)
        ]
        left, right = (scores[o].mean(axis=0) if o.any() else unseen for o in own)
        out.append(Pass((left, right), (int(own[0].sum()), int(own[1].sum())), far_leg, trial))
    return out


def _views(cycles: Sequence[GaitCycle]) -> list[tuple[str, str]]:
    """Trial and view of each cycle's direction of walking, which ends where the other leg comes to be behind."""
    directions: dict[tuple[str, int], list[int]] = {}
    number: dict[str, int] = {}
    side: dict[str, str] = {}
    for i in sorted(range(len(cycles)), key=lambda i: cycles[i].number):
        trial, far_leg = cycles[i].trial, cycles[i].far_leg
        if far_leg:
            number[trial] = number.get(trial, -1) + (side.get(trial) != far_leg)
            side[trial] = far_leg
        directions.setdefault((trial, max(number.get(trial, 0), 0)), []).append(i)
    of_cycle = {i: (key[0], far_leg_of([cycles[i] for i in own])) for key, own in directions.items() for i in own}
    return [of_cycle[i] for i in range(len(cycles))]


def _agreement(passes: Sequence[Pass], norm: NormativeSet) -> tuple[Check, ...]:
    """Check `passes_agree` of two passes and more: the ones that were doubted, with what differs most."""
    if len(passes) < 2:
        return ()
    doubted = [p for p in passes if p.doubt is not None]
    doubts = ((p.trial, np.reshape(np.asarray(p.doubt), (2, -1)) @ norm.components) for p in doubted)
    which = "; ".join(_difference(trial, away, norm)[0] for trial, away in doubts)
    advice = ""
    if len(doubted) == len(passes):
        advice = (
            f"the passes differ by more than their error, and it is not known which is right: {which}. The interval of "
            "the index is wider. Look at each of them"
        )
    elif doubted:
        advice = f"differs from the other passes and counts little in the index: {which}. Look at it"
    return (warn_if(advice, "passes_agree", float(len(doubted)), 0.0, advice),)


def _trials_agree(cycles: Sequence[GaitCycle], vectors: Sequence[np.ndarray], norm: NormativeSet) -> tuple[Check, ...]:
    """Check `passes_agree` where no model of the error is known: the mean curves of each trial against those of all, of
    two trials against each other (`APART_DEG`)."""
    names = list(dict.fromkeys(c.trial for c in cycles))
    if len(names) < 2:
        return ()
    curves = [
        [
            [v for c, v in zip(cycles, vectors, strict=True) if (c.trial, c.side) == (trial, side)]
            for side in (LEFT, RIGHT)
        ]
        for trial in names
    ]
    unseen = np.full(norm.components.shape[1], np.nan)
    means = np.array([[np.mean(own, axis=0) if own else unseen for own in sides] for sides in curves])
    usual = means[::-1] if len(names) == 2 else np.nanmedian(means, axis=0)
    apart = [_difference(t, away, norm) for t, away in zip(names, means - usual, strict=True)]
    which = "; ".join(text for text, by in apart if by > APART_DEG)
    advice = f"the curves of trials differ by more than those of one walk to the next: {which}. Look at each of them"
    return (warn_if(which, "passes_agree", max(by for _, by in apart), APART_DEG, advice),)


def _difference(trial: str, away: np.ndarray, norm: NormativeSet) -> tuple[str, float]:
    """Name of a trial, and which angle of which leg is how far from what is expected (root mean square, deg); `away`:
    of both sides' vectors (2, D), NaN for a side without cycles."""
    size = np.sqrt(np.mean(np.square(away).reshape(2, len(norm.variables), -1), axis=-1))
    side, angle = np.unravel_index(np.nanargmax(size), size.shape) if np.isfinite(size).any() else (0, 0)
    by = float(np.nan_to_num(size[side, angle]))
    return f"{trial}, {(LEFT, RIGHT)[side]} {norm.variables[angle]} by {by:.0f} deg", by


class _Part(NamedTuple):
    """Term of the weighted mean that is an index: one cycle, or the mean curves of one side.

    `change`: its change by one standard deviation of each angle's curve, None if that is not known; `chance`: its
    variance by the spread of cycles.
    """

    side: str
    weight: float
    gdi: float
    change: np.ndarray | None
    chance: float


def _parts(
    cycles: Sequence[GaitCycle], vectors: Sequence[np.ndarray], norm: NormativeSet, params: GdiParams
) -> list[_Part]:
    x, sides = np.array(vectors), np.array([c.side for c in cycles])
    stated = [
        feature_vector(c.curves_sd, norm.variables, norm.percent)
        for c in cycles
        if all(v in c.curves_sd for v in norm.variables)
    ]
    known = len(stated) == len(cycles) and bool(np.isfinite(stated).all())
    spread = np.array(stated) if known else np.zeros_like(x)

    def part(own: np.ndarray, weight: float) -> _Part:
        # An angle at a time, 0 in the others.
        each = np.repeat(np.eye(len(norm.variables)), len(norm.percent), axis=1) * spread[own].mean(axis=0)
        middle = x[own].mean(axis=0)
        inside = norm.components @ (middle - norm.mean_deg)
        square = max(float(inside @ inside), 1e-12)
        longer = params.lengthening * float(np.sum((each @ norm.components.T) ** 2))
        longer = min(longer, MOST_LONGER * square)
        slope = -10.0 / norm.ln_sd * (inside @ norm.components) / square * (1.0 + longer / (square + longer))
        gdi = float(_shorter(middle, longer, norm)[0])
        change = _changes(gdi, middle, slope, each, longer, norm) if known else None
        return _Part(sides[own][0], weight, gdi, change, _of_mean((x[own] - middle) @ slope))

    if params.average != "cycles":
        seen = [side for side in (LEFT, RIGHT) if side in sides]
        return [part(sides == side, 1.0 / len(seen)) for side in seen]
    one, n = np.arange(len(x)), len(x)
    parts = [part(one == i, 1.0 / n) for i in one]
    # Each of n shares of the variance of their mean.
    chance = n * _of_mean(np.array([p.gdi for p in parts]))
    return [p._replace(chance=chance) for p in parts]


def _shorter(vectors: Float[np.ndarray, "*n D"], longer: float, norm: NormativeSet) -> Float[np.ndarray, " n"]:
    """The index of vectors whose squared distance d^2 from the norm is d^4 / (d^2 + longer): errors lengthen a distance
    on average, short ones most. That is d^2 - `longer` for long distances, and always positive (as in a Wiener
    filter)."""
    return norm.index(vectors) + 5.0 / norm.ln_sd * np.log1p(longer * np.exp(-2.0 * norm.log_distance(vectors)))


def _changes(
    gdi: float, vector: np.ndarray, slope: np.ndarray, each: np.ndarray, longer: float, norm: NormativeSet
) -> Float[np.ndarray, " V"]:
    """Change of an index by an error of one standard deviation of each angle's curve (`each`): the root mean square of
    both directions, because near the norm a derivative is unbounded; with the derivative's sign."""
    both = _shorter(np.concatenate([vector + each, vector - each]), longer, norm).reshape(2, -1) - gdi
    return np.sqrt(np.mean(both**2, axis=0)) * np.where(each @ slope < 0, -1.0, 1.0)


def _of_mean(values: np.ndarray) -> float:
    return float(np.var(values, ddof=min(1, len(values) - 1))) / len(values)


def _weighted(parts: Sequence[_Part]) -> float | None:
    return float(np.average([p.gdi for p in parts], weights=[p.weight for p in parts])) if parts else None


def _errors(parts: Sequence[_Part], params: GdiParams) -> tuple[float | None, float | None]:
    """Standard deviation of the error of the index, and the minimal detectable change (90 %) between two such visits.

    The lasting part of the fit's uncertainty (`curves_sd`: the detector's errors, the lean) is the same in all cycles
    of a side and partly on both sides; the part that differs from cycle to cycle is in the cycles' spread.
    """
    changes = np.array([p.weight * p.change for p in parts if p.change is not None])
    if len(changes) < len(parts):
        return None, None
    own = np.array([p.side for p in parts])
    sides = np.array([changes[own == side].sum(axis=0) for side in (LEFT, RIGHT)])
    alike, apart = np.sum(sides.sum(axis=0) ** 2), np.sum(sides**2)
    fit = params.lasting * (params.both_sides * alike + (1.0 - params.both_sides) * apart)
    walk = sum(p.weight**2 * p.chance for p in parts)
    anew = float(np.sqrt((1.0 - params.repeated) * fit + walk))
    return float(np.sqrt(fit + walk)), minimal_change_of(anew)


def gdi_vector(cycle: GaitCycle, norm: NormativeSet) -> np.ndarray:
    """The feature vector of a cycle: the norm's angles one after another, each at the norm's percents."""
    return feature_vector(cycle.curves, norm.variables, norm.percent)


def _vector(cycle: GaitCycle, norm: NormativeSet) -> np.ndarray:
    check_degrees(np.concatenate([cycle.curves[v] for v in norm.variables]), f"{cycle.trial}, cycle {cycle.number}")
    return gdi_vector(cycle, norm)


def _score(cycle: GaitCycle, vector: np.ndarray, norm: NormativeSet) -> GdiCycle:
    deviation = vector - norm.mean_deg
    inside = norm.components @ deviation
    total = float(deviation @ deviation)
    z = float((norm.log_distance(vector)[0] - norm.ln_mean) / norm.ln_sd)
    explained = float(inside @ inside) / total if total > 0 else 1.0
    return GdiCycle(cycle.trial, cycle.number, cycle.side, float(norm.index(vector)[0]), z, explained)


def _model_of(norm: NormativeSet, model: str | None) -> str:
    fitting = next((m for m, angles in MODEL_ANGLES.items() if angles == norm.variables), None)
    if model is None:
        return fitting or f"index of {len(norm.variables)} angles"
    if fitting != model:
        raise PblError(
            "NORM_INVALID",
            found=f"normative set {norm.name} of {len(norm.variables)} angles for {model}",
            expected=f"a set of {', '.join(MODEL_ANGLES[model])}, in this order",
            next_step=f"leave the set out ({GDI_METHODS[model].params.norm} is the model's own), or build one",
        )
    return model


def _too_few(cycles: Sequence[GaitCycle], n_left: int, n_right: int, params: GdiParams) -> str:
    if failed := next((c.excluded for c in cycles if c.check_failed), ""):
        return failed
    text = (
        f"the GDI needs {2 * params.min_cycles_per_side} complete gait cycles with curves, "
        f"{params.min_cycles_per_side} or more on each side; this recording has "
        f"{n_left} left and {n_right} right ones of {len(cycles)} cycles in all"
    )
    missing = sorted({c.curves_missing for c in cycles if c.used and c.curves_missing})
    return text + (f" ({'; '.join(missing)})" if missing else "")


def _checks(
    scored: Sequence[GdiCycle], angle_models: set[str], norm: NormativeSet, reason: str, params: GdiParams
) -> tuple[Check, ...]:
    if reason:
        return (Check("gdi_cycles", EMPTY, float(len(scored)), float(2 * params.min_cycles_per_side), reason),)
    n, advised, least = len(scored), params.advised_cycles, params.min_explained
    fraction = float(np.mean([c.explained for c in scored]))
    few = "few cycles: record more passes and give them as trials of one session"
    unlike = "most of the deviation is of a kind that healthy walking does not show: the index understates it"
    return (
        _convention(angle_models, norm),
        warn_if(n < advised, "gdi_cycles", float(n), float(advised), few),
        warn_if(not fraction >= least, "gdi_explained", round(fraction, 3), least, unlike),
    )


def _convention(angle_models: set[str], norm: NormativeSet) -> Check:
    """Check that the angles of cycles and norm have the same definition. The default norm, which is mapped, passes: the
    description of the index mentions it once."""
    advice = ""
    if len(angle_models) > 1:
        advice = "cycles of several ways of measuring are mixed: score those of the laboratory and of the video apart"
    elif angle_models != {norm.angle_model}:
        advice = (
            f"the angles of the norm are defined otherwise ({norm.angle_model}) than those of the cycles "
            f"({next(iter(angle_models))}): pelvis tilt and hip flexion differ by a constant. Compare sessions with "
            "each other, do not read a single value against 100, or take a norm of the same definition"
        )
    elif norm.mapped_from and norm.name != DEFAULT_NORM:
        advice = (
            "the norm was measured with a laboratory's marker model and mapped to the fitted body's angles by a "
            "constant; what else differs (hip joint centres, age, a person's own pelvis) is in the index. Changes "
            "between sessions hold better than a single value against 100"
        )
    return warn_if(advice, "norm_convention", None, None, advice)
