"""A term of the cost: a residual, its weight, its robust width and the unknowns it depends on, stated once.

`objective.py` lists the terms and adds up their values; `normal_equations.py` adds up their derivatives, which follow
from the same definition. A term is added as one object in one file and a line of the list; its parameters are fields of
the paramset (`params.py`), which a term reads by name (`Weights`).
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, ArrayLike, Float

from .linearised import linearised
from .problem import Problem, State
from .weights import Weights


class Unknowns(enum.Enum):
    """Unknowns that the variables of a term depend on: they decide which blocks of the normal equations it enters."""

    MARKER = "joints, camera, scale, marker offsets"
    CENTRED_MARKER = "joints, camera, scale, marker offsets, detector's lean and depths"
    MARKER_AND_SURFACE = "joints, camera, scale, marker offsets, surface"
    PHONE = "camera, clock"
    JOINT = "a joint"
    JOINTS = "joints of a frame"
    JOINT_IN_THREE_FRAMES = "a joint in three frames"
    SOLE_AND_FLOOR = "joints, scale, floor"
    SOLE_IN_TWO_FRAMES = "joints of two frames, scale"
    SEGMENT_IN_TWO_FRAMES = "joints of two frames, sensors' alignment, bias, clock"
    SHARED = "common unknowns"


class Phone(NamedTuple):
    """Orientations of a phone (M,): `fitted`; `measured`, as a function of a change (M,) of the clock's offset (s);
    `weight` (M,) as of frames."""

    fitted: jaxlie.SO3
    measured: Callable[[Array], jaxlie.SO3]
    weight: Float[Array, " M"]


class Segments(NamedTuple):
    """Segments with sensors: their rotations to the world, and the rotation vectors (world axes, from the left) by
    which they turn with the joints."""

    rotation: Float[Array, "F m 3 3"]
    by_q: Float[Array, "F m 3 Q"]


class At(NamedTuple):
    """Arguments of the terms: the frames of a problem, the parameters, the unknowns, and the markers and
    soles where the unknowns put them in the world (m). `phone`: None if no camera turns; `segments`: None without
    wearable sensors."""

    problem: Problem
    weights: Weights
    state: State
    x: Float[Array, "F J 3"]
    soles: Float[Array, "F P 3"]
    phone: Phone | None = None
    segments: Segments | None = None


class Rows(NamedTuple):
    """A linearised term: the weights c (F, ...) of the squares of its residuals r (F, ..., E), their derivatives D (F,
    ..., E, V) by the variables, and the cost of each frame (F,) without its weights. Gradient and curvature, times the
    number of frames, are D' c r and D' c D.
    """

    c: Array
    r: Array
    D: Array
    cost: Array


def huber(e2: Float[Array, ...], width: ArrayLike) -> Float[Array, ...]:
    """Huber cost of a distance given its square: `e2 / 2` up to `width`, then linear.

    Takes the square so that the gradient at distance zero is zero and not 0/0: the root is only taken of values that
    are at least `width` squared.
    """
    far = e2 > width**2
    distance = jnp.sqrt(jnp.where(far, e2, width**2))
    return jnp.where(far, width * (distance - 0.5 * width), 0.5 * e2)


def square(r: Float[Array, "*n D"]) -> Float[Array, "*n"]:
    """Squared length of residuals."""
    return jnp.sum(r**2, axis=-1)


def frame_count(problem: Problem) -> Float[Array, ""]:
    """Sum of the frames' weights."""
    return jnp.maximum(jnp.sum(problem.weight), 1.0)


@dataclasses.dataclass(frozen=True)
class Term:
    """A mean over frames of robust costs of residuals.

    Its value is ``sum over frames of frames(at) sum(count(at) robust(|residual|^2)) / number of frames``. If `count`
    is empty, the problem has no data for the term, and it is left out.
    """

    name: str
    #: Parameter of the weight; "": 1.
    weight: str
    unknowns: Unknowns
    #: Variables (F, ..., V) of the residuals. Each residual depends on its own variables alone.
    variables: Callable[[At], Array]
    #: Residuals (F, ..., E) of the variables.
    residual: Callable[[At, Array], Array]
    #: Weights of the residuals in a frame, such as the confidence of each marker.
    count: Callable[[At], Array | float]
    #: Parameter of the width of the Huber cost; "": half the square.
    width: str = ""
    #: Weights of the frames.
    frames: Callable[[At], Array] = lambda at: at.problem.weight
    #: A cost of squared residuals (F, ...) that is not Huber's.
    robust: Callable[[At, Array], Array] | None = None
    #: Force (F, Q) and curvature (F, Q, Q) by hand, of a term of the joints of a frame: faster than `rows`.
    by_hand: Callable[[At], tuple[Array, Array]] | None = None

    def value(self, at: At) -> Float[Array, ""]:
        if self.empty(at):
            return jnp.zeros(())
        cost = self._robust(at, square(self.residual(at, self.variables(at))))
        return self.mean(at, self._of_frames(at, cost))

    def mean(self, at: At, cost: Float[Array, " F"]) -> Float[Array, ""]:
        """Return the weighted cost from that of each frame."""
        each = self.frames(at) * cost
        # In groups, whose sums round less than one long sum: the solver compares costs to a few parts in 10^7.
        groups = next(n for n in (16, 4, 1) if len(each) % n == 0)
        return jnp.sum(weight_of(self, at) / frame_count(at.problem) * jnp.sum(each.reshape(groups, -1), axis=1))

    def rows(self, at: At) -> Rows:
        """Return the term as weighted squares (iteratively reweighted least squares)."""
        r, D = linearised(lambda z: self.residual(at, z), self.variables(at))
        cost, pull = jax.vjp(lambda e2: self._robust(at, e2), square(r))
        each = self.frame_weights(at).reshape(-1, *[1] * (cost.ndim - 1)) * self.count(at)
        return Rows(2 * pull(jnp.broadcast_to(each, cost.shape))[0], r, D, self._of_frames(at, cost))

    def frame_weights(self, at: At) -> Float[Array, " F"]:
        """Return the weights of the frames times that of the term."""
        return weight_of(self, at) * self.frames(at)

    def empty(self, at: At) -> bool:
        """True if the problem has no data for the term."""
        return jnp.size(self.count(at)) == 0

    def _of_frames(self, at: At, cost: Float[Array, "F ..."]) -> Float[Array, " F"]:
        each = self.count(at) * cost
        return jnp.sum(each, axis=tuple(range(1, each.ndim)))

    def _robust(self, at: At, e2: Array) -> Array:
        if self.robust is not None:
            return self.robust(at, e2)
        return huber(e2, at.weights[self.width]) if self.width else 0.5 * e2


@dataclasses.dataclass(frozen=True)
class SharedTerm:
    """A quadratic cost of what all frames share: of the fields of `State` without frames."""

    name: str
    #: Parameter of the weight; "": 1.
    weight: str
    cost: Callable[[At], Array]
    unknowns: Unknowns = Unknowns.SHARED
    #: True if a problem has no such unknowns, so that the term is left out.
    empty: Callable[[At], bool] = lambda at: False

    def value(self, at: At) -> Float[Array, ""]:
        return jnp.zeros(()) if self.empty(at) else weight_of(self, at) * self.cost(at)


def weight_of(term: Term | SharedTerm, at: At) -> Array | float:
    return at.weights[term.weight] if term.weight else 1.0
