"""Permutation inference over curves of the gait cycle."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
from scipy import stats

from pbl_pipeline.runs import runs

from .types import count, differ, fraction, labels, numbers, one_of, refuse

CURVE_METHODS = ("max-t", "cluster")


@dataclasses.dataclass(frozen=True)
class Phase:
    """A part of the cycle in which the curves differ."""

    first: float  # first point, in percent of the cycle
    last: float
    sign: int  # 1 if a is larger than b, else -1
    p: float  # corrected for the whole cycle: of the cluster, or ("max-t") the smallest of its points


@dataclasses.dataclass(frozen=True)
class CurveTest:
    """A test of two sets of curves."""

    method: str  # these three: as passed
    paired: bool
    alpha: float
    percent: np.ndarray  # (P,) points of the cycle
    difference: np.ndarray  # (P,) mean of a - b over persons, in the unit of the curves
    t: np.ndarray  # (P,)
    p: np.ndarray  # (P,) corrected for the whole cycle ("cluster": of the cluster of a point, 1 outside)
    threshold: float  # "max-t": |t| above it is significant. "cluster": |t| above it belongs to a cluster.
    p_value: float  # of the hypothesis that the curves differ nowhere: the smallest of `p`
    phases: tuple[Phase, ...]  # where they differ, p <= alpha
    n_a: int  # persons (not curves)
    n_b: int
    permutations: int  # their number, including the data's own order
    exact: bool  # all possible permutations
    smallest_p: float  # smallest possible p with these persons and permutations


def curve_test(
    a: Any,
    b: Any,
    *,
    paired: bool,
    persons_a: Any = None,
    persons_b: Any = None,
    method: str = "max-t",
    alpha: float = 0.05,
    cluster_p: float = 0.01,
    n_permutations: int = 10_000,
    seed: int = 0,
) -> CurveTest:
    """Test where curves of two conditions, or of two groups of persons, differ over the gait cycle. Two-sided.

    Nonparametric mapping (Nichols & Holmes 2002, Hum Brain Mapp 15:1-25; for gait curves Pataky et al. 2015, J Biomech
    48:1277-1285). A person's curves are averaged first and persons are permuted, never repeats, so that persons may
    have any number of curves. Paired: the signs of the persons' differences are flipped; t is that of paired values.
    Unpaired: the persons' group labels are permuted; t is Welch's, which holds the error rate also where the groups
    differ in variance and size (Janssen 1997, Stat Probab Lett 36:9-21).
    "max-t" compares each |t| with the largest over the cycle, and judges each point. "cluster" compares the sum of |t|
    over neighbouring points of one sign with |t| above its quantile at `cluster_p` (Maris & Oostenveld 2007, J Neurosci
    Methods 164:177-190): it finds long weak phases, but does not test single points.

    Raises `PblError` STATS_INPUT: NaN, other shapes, a point at which no curve differs, persons with one condition only
    (paired) or in both groups (unpaired), too few persons or permutations for a p of `alpha`.

    Parameters
    ----------
    a, b : (N, P), (M, P)
        Curves at the same P points from 0 to 100 % of the cycle, in one unit.
    persons_a, persons_b : (N,), (M,)
        Person of each curve. Without them each row is another person ("paired": the same in both, in order).
    n_permutations
        Largest number; all possible ones if they are fewer.
    """
    one_of(method, CURVE_METHODS, "method")
    for value, name in ((alpha, "alpha"), (cluster_p, "cluster_p")):
        fraction(value, name)
    x, names_a = _per_person(a, persons_a, "a")
    y, names_b = _per_person(b, persons_b, "b")
    if x.shape[1] != y.shape[1]:
        raise refuse(f"curves of {x.shape[1]} and {y.shape[1]} points", "one length", "resample to the same points")
    count(n_permutations, "n_permutations")
    generator = np.random.default_rng(seed)
    if paired:
        _same_persons(names_a, names_b)
        y = y[[names_b.index(name) for name in names_a]]
        t, exact = _flipped(_scaled(x - y), n_permutations, generator)
        df, mirrored = len(x) - 1, True
    else:
        if persons_a is not None and persons_b is not None:
            _other_persons(names_a, names_b)
        t, exact = _relabelled(_scaled(np.vstack([x, y])), len(x), n_permutations, generator)
        df, mirrored = len(x) + len(y) - 2, len(x) == len(y)
    # The data's own order is the first; in a complete list its mirror image has the same |t|.
    smallest = (2 if exact and mirrored else 1) / len(t)
    if smallest > alpha:
        raise refuse(
            f"{len(x)} and {len(y)} persons, {len(t)} permutations: no p is smaller than {smallest:.2g}",
            f"enough for p = {alpha:g} (paired 6 persons, unpaired 4 and 4 at 0.05)",
            "record more persons, or raise n_permutations",
        )
    if method == "max-t":
        threshold, p = _by_maximum(np.abs(t), alpha)
    else:
        threshold = float(stats.t.isf(cluster_p / 2, df))
        p = _by_cluster(t, threshold)
    percent = np.linspace(0, 100, len(p))
    return CurveTest(
        method=method,
        paired=paired,
        alpha=alpha,
        percent=percent,
        difference=x.mean(axis=0) - y.mean(axis=0),
        t=t[0],
        p=p,
        threshold=threshold,
        p_value=float(p.min()),
        phases=tuple(
            Phase(float(percent[run][0]), float(percent[run][-1]), int(np.sign(t[0, run.start])), float(p[run].min()))
            for run in runs(np.where(p <= alpha, np.sign(t[0]), 0))
        ),
        n_a=len(x),
        n_b=len(y),
        permutations=len(t),
        exact=exact,
        smallest_p=smallest,
    )


def _per_person(curves: Any, persons: Any, name: str) -> tuple[np.ndarray, list[Any]]:
    """(persons, P) mean curves and the persons' labels."""
    values = numbers(curves, name, ndim=2)
    if values.shape[1] < 2:
        raise refuse(f"{name}: curves of {values.shape[1]} point(s)", "several", "pass curves (N, points)")
    if persons is None:
        return values, list(range(len(values)))
    index, names = labels(persons, f"persons_{name}", len(values))
    counts = np.bincount(index)
    sums = np.add.reduceat(values[np.argsort(index, kind="stable")], np.cumsum(counts) - counts)
    return sums / counts[:, None], names


def _same_persons(a: list[Any], b: list[Any]) -> None:
    if odd := sorted(str(v) for v in set(a) ^ set(b)):
        raise refuse(
            f"{len(odd)} person(s) with curves of one condition only: {', '.join(odd[:5])}",
            "both conditions of every person",
            "leave these persons out and report them",
        )


def _other_persons(a: list[Any], b: list[Any]) -> None:
    if both := sorted(str(v) for v in set(a) & set(b)):
        raise refuse(
            f"{len(both)} person(s) in both groups: {', '.join(both[:5])}",
            "two groups of different persons",
            "pass paired=True",
        )


def _scaled(curves: np.ndarray) -> np.ndarray:
    """Curves in units of their root mean square at each point, which does not change t."""
    flat = [i for i, values in enumerate(curves.T) if not len(values) or not differ(values)]
    if len(flat):
        raise refuse(
            f"no difference between persons at {len(flat)} point(s), the first {flat[0]} (counted from 0)",
            "several persons whose curves differ at every point",
            "leave points out that are the same by definition, or record more persons",
        )
    return curves / np.sqrt((curves**2).mean(axis=0))


def _flipped(d: np.ndarray, most: int, generator: np.random.Generator) -> tuple[np.ndarray, bool]:
    """(B, P) t of (n, P) differences under sign flips, without flips first; and True if these are all possible ones."""
    n = len(d)
    exact = 2**n <= most
    if exact:
        signs = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
    else:
        signs = 1.0 - 2.0 * generator.integers(2, size=(most, n))
        signs[0] = 1.0
    mean = signs @ d / n
    variance = ((d**2).sum(axis=0) / n - mean**2) / (n - 1)  # of the mean; signs do not change squares
    return mean / np.sqrt(np.maximum(variance, 1e-18)), exact


def _relabelled(x: np.ndarray, n_a: int, most: int, generator: np.random.Generator) -> tuple[np.ndarray, bool]:
    """(B, P) Welch's t of (n, P) curves, of which the first `n_a` are group a, under permuted labels; as `_flipped`."""
    n, n_b = len(x), len(x) - n_a
    if min(n_a, n_b) < 2:
        raise refuse(f"{n_a} and {n_b} persons", "two persons at least in each group", "record more persons")
    exact = math.comb(n, n_a) <= most
    if exact:
        chosen = np.array(list(itertools.combinations(range(n), n_a)))
    else:
        chosen = np.argsort(generator.random((most, n)), axis=1)[:, :n_a]
        chosen[0] = np.arange(n_a)
    in_a = np.zeros((len(chosen), n))
    np.put_along_axis(in_a, chosen, 1.0, axis=1)
    centred = x - x.mean(axis=0)
    mean_a = in_a @ centred / n_a
    mean_b = -mean_a * n_a / n_b
    squares_a = in_a @ centred**2
    squares_b = (centred**2).sum(axis=0) - squares_a
    variance = (squares_a / n_a - mean_a**2) / (n_a - 1) + (squares_b / n_b - mean_b**2) / (n_b - 1)
    return (mean_a - mean_b) / np.sqrt(np.maximum(variance, 1e-18)), exact


def _by_maximum(size: np.ndarray, alpha: float) -> tuple[float, np.ndarray]:
    """Critical |t|, and p of each point: the fraction of permutations whose largest |t| is at least as large."""
    largest = np.sort(size.max(axis=1))
    p = _share(largest, size[0])
    return float(largest[len(largest) - 1 - int(alpha * len(largest) + 1e-9)]), p


def _by_cluster(t: np.ndarray, threshold: float) -> np.ndarray:
    """p of each point: the fraction of permutations with a cluster of at least the mass of its own; 1 outside."""
    sign = np.sign(t) * (np.abs(t) > threshold)
    largest, mass = np.zeros(len(t)), np.zeros(len(t))
    for i in range(t.shape[1]):
        goes_on = i > 0 and sign[:, i] == sign[:, i - 1]
        mass = (np.where(goes_on, mass, 0.0) + np.abs(t[:, i])) * (sign[:, i] != 0)
        largest = np.maximum(largest, mass)
    largest.sort()
    p = np.ones(t.shape[1])
    for run in runs(sign[0]):
        p[run] = _share(largest, np.abs(t[0, run]).sum())
    return p


def _share(ordered: np.ndarray, values: Any) -> Any:
    """Fraction of `ordered` that is at least each value, up to the last digits."""
    return 1 - np.searchsorted(ordered, np.asarray(values) * (1 - 1e-9)) / len(ordered)
