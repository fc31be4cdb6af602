"""Weights of a detector's points that follow their errors, as a first solution shows them."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Float

from .keypoint_terms import L2D, L3D
from .lanes import Found
from .problem import Problem
from .term import At
from .weights import Weights

#: A point counts at most so many times what its confidence says, however well it fits.
MOST = 30.0


def with_measured_weights(p: Problem, w: Weights, found: Found) -> Problem:
    """Return the problem with `c_2d` and `c_3d` of each point times ``s^2 / (e^2 + s^2 / MOST)``.

    e is the median length of the point's residuals in a trial and view of a solution, in px of the cost and in cm; s is
    `points_px` or `points_cm`, at which the weights count about as stated (0: they are not changed). A median, so that
    frames in which a point was confused do not count; of a whole trial, because a point that lies off in one frame may
    be right and the body wrong.
    """
    lengths, trial, changed = _lengths(p, w, found.end.state, found.x), np.asarray(p.trial), {}
    for field, e, s in zip(("c_2d", "c_3d"), lengths, (w["points_px"], w["points_cm"]), strict=True):
        c, s2 = np.array(getattr(p, field)), float(s) ** 2
        for i in np.unique(trial) if s2 else ():
            at = trial == i
            middle = np.ma.median(np.ma.masked_where(c[at] <= 0, np.asarray(e)[at]), axis=0).filled(np.inf)
            c[at] *= s2 / (middle**2 + s2 / MOST)
        changed[field] = c
    return dataclasses.replace(p, **changed)


@jax.jit
def _lengths(p: Problem, w: Weights, state: object, x: Array) -> tuple[Float[Array, "F V J"], Float[Array, "F V J"]]:
    """Lengths of the residuals of both terms at fitted points."""
    markers, soles, _ = p.split(x)
    at = At(p, w, state, markers, soles)  # type: ignore[arg-type]
    px, cm = (term.residual(at, markers) for term in (L2D, L3D))
    return jax.numpy.linalg.norm(px, axis=-1), jax.numpy.linalg.norm(cm, axis=-1)
