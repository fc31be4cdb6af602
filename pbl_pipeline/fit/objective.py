"""The cost of a session: the paper's equations by their names, our priors in the same form, and the table of the total.

Equations: the paper, section Model Fitting. Every keypoint term is a robust cost of a residual, and a residual is a
small function of a marker's position; `normal_equations.py` differentiates the same residuals. Where nothing was seen
`c` is 0; values there must be finite but do not count.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, ArrayLike, Float

from .priors import Weights, bent, beyond_limit_deg, inclination, pose_cost, pose_z, posture
from .problem import Problem

#: Depth below which a point is treated as if it were this far away: keeps projections and gradients finite.
NEAR_M = 0.1
#: How gradually depth is bent there (m).
SOFT_M = 0.5 * NEAR_M


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """The unknowns of a session at F frames. `s`: the paper's scale parameters; `clock_s`: sensor time minus video time
    of each trial; `floor`: its height (m) and slopes along the world's x and y, of each trial.

    What a detector's 3D points are wrong by in all frames of a trial, where the paramset asks for it (D is N, else 0):
    `lean`, the rotation (rotation vector in rad, camera axes) that sets them upright, and `depth_m`, what must be added
    to each marker's depth.
    """

    qpos: Float[Array, "F Q"]
    R_nc: Float[Array, "F V 3 3"]
    s: Float[Array, " S"]
    site_offset_m: Float[Array, "J 3"]
    clock_s: Float[Array, " N"]
    floor: Float[Array, "N 3"]
    lean: Float[Array, "D 3"] = dataclasses.field(default_factory=lambda: jnp.zeros((0, 3)))
    depth_m: Float[Array, "D J"] = dataclasses.field(default_factory=lambda: jnp.zeros((0, 0)))


# --- robust cost


def huber(e2: Float[Array, ...], width: ArrayLike) -> Float[Array, ...]:
    """Huber cost of a distance given its square: `e2 / 2` up to `width`, then linear.

    Takes the square so that the gradient at distance zero is zero and not 0/0: the root is only taken of values that
    are at least `width` squared.
    """
    far = e2 > width**2
    distance = jnp.sqrt(jnp.where(far, e2, width**2))
    return jnp.where(far, width * (distance - 0.5 * width), 0.5 * e2)


def huber_weight(r: Float[Array, "*n D"], width: ArrayLike) -> Float[Array, "*n"]:
    """Weight w of the gradient `w r` of the Huber cost of a residual's length: iteratively reweighted least squares."""
    e2 = square(r)
    far = e2 > width**2
    return jnp.where(far, width / jnp.sqrt(jnp.where(far, e2, 1.0)), 1.0)


def square(r: Float[Array, "*n D"]) -> Float[Array, "*n"]:
    """Squared length of residuals."""
    return jnp.sum(r**2, axis=-1)


# --- residuals of a marker's position


def in_camera(
    x_world: Float[Array, "F J 3"], R_nc: Float[Array, "F V 3 3"], p_nc: Float[Array, "F V 3"]
) -> Float[Array, "F V J 3"]:
    """Points in the axes of each camera: x right, y down, z forward (m)."""
    away = x_world[:, None] - p_nc[:, :, None]
    return sum(away[..., k, None] * R_nc[:, :, None, k] for k in range(3))  # type: ignore[return-value]


def project_px(x_cam: Float[Array, "*n J 3"], camera_matrix: Float[Array, "*#n 3 3"]) -> Float[Array, "*n J 2"]:
    """Pinhole projection. Depth is bent smoothly to stay above `NEAR_M`, so nothing is huge behind the camera."""
    z = NEAR_M + SOFT_M * jax.nn.softplus((x_cam[..., 2:] - NEAR_M) / SOFT_M)
    focal = jnp.stack([camera_matrix[..., 0, 0], camera_matrix[..., 1, 1]], axis=-1)[..., None, :]
    return focal * x_cam[..., :2] / z + camera_matrix[..., None, :2, 2]


def residual_2d_px(
    x_cam: Float[Array, "*n J 3"], xy_px: Float[Array, "*n J 2"], camera_matrix: Float[Array, "*#n 3 3"]
) -> Float[Array, "*n J 2"]:
    """Projected model points minus detected, undistorted ones."""
    return project_px(x_cam, camera_matrix) - xy_px


def residual_3d_cm(
    x: Float[Array, "*n J 3"], detected: Float[Array, "*n J 3"], depth_ratio: ArrayLike = 1.0
) -> Float[Array, "*n J 3"]:
    """Model points minus detected ones. `depth_ratio`: what a distance along the last axis, a camera's, counts against
    one across it (1: the paper's)."""
    per_m = 100.0 * jnp.concatenate([jnp.ones(2), jnp.reshape(jnp.asarray(depth_ratio, x.dtype), 1)])
    return (x - detected) * per_m


def corrected(
    x_cam: Float[Array, "*n J 3"], lean: Float[Array, "*n 3"], depth_m: Float[Array, "*n J"]
) -> Float[Array, "*n J 3"]:
    """A detector's points without what it gets wrong in every frame: turned by `lean` about their origin, each moved by
    its `depth_m`."""
    turned = jaxlie.SO3.exp(lean[..., None, :]) @ x_cam
    return turned + depth_m[..., None] * jnp.array([0.0, 0.0, 1.0], x_cam.dtype)


def mean_weights(c: Float[Array, "*n J"], marker_weight: Float[Array, " J"]) -> Float[Array, "*n J"]:
    """Weights, of sum 1, of the markers in the mean that L3D removes: those that were seen."""
    seen = jnp.where(c > 0, marker_weight, 0.0)
    return seen / jnp.maximum(jnp.sum(seen, axis=-1, keepdims=True), 1e-6)


def offset_m(
    x: Float[Array, "*n J 3"], detected: Float[Array, "*n J 3"], weights: Float[Array, "*n J"]
) -> Float[Array, "*n 1 3"]:
    """Weighted mean over the markers of model minus detected points: what centring both removes from each difference.

    As one mean of differences: XLA 0.10.2 for CPUs computes the difference of two means wrongly in some programs.
    """
    return jnp.sum((x - detected) * weights[..., None], axis=-2, keepdims=True)


def residual_phone_deg(R_nc: jaxlie.SO3, measured: jaxlie.SO3) -> Float[Array, "*n 3"]:
    """Rotation vector, in world axes, from the measured to the fitted orientation of the phone."""
    return jnp.rad2deg((R_nc @ measured.inverse()).log())


def residual_floor_cm(x: Float[Array, "*n 3"], floor: Float[Array, "*n 3"]) -> Float[Array, "*n 1"]:
    """Height over a floor of some height (m) and slopes."""
    height, slope_x, slope_y = (floor[..., i] for i in range(3))
    return 100.0 * (x[..., 2] - height - slope_x * x[..., 0] - slope_y * x[..., 1])[..., None]


def residual_slide_cm(
    x: Float[Array, "*n 3"], following: Float[Array, "*n 3"], rate: Float[Array, "*n"]
) -> Float[Array, "*n 3"]:
    """Displacement of a point until the next frame, as if that came after 1/30 s (`rate`: 1/30 s over the time)."""
    return 100.0 * rate[..., None] * (following - x)


def later(a: Array) -> Array:
    """Each frame's successor; the last one is its own."""
    return jnp.concatenate([a[1:], a[-1:]])


# --- the paper's terms: c sums to a mean over markers and views (`Problem`)


def L3D(
    x: Float[Array, "*n J 3"], detected: Float[Array, "*n J 3"], c: Float[Array, "*n J"], weights: Float[Array, "*n J"],
    depth_ratio: ArrayLike, width_cm: ArrayLike,
) -> Float[Array, "*n"]:  # fmt: skip
    """Mean of c huber(|x_hat - R_nc x_cam|; d), both sides with their own mean over the markers removed (`weights`;
    0: as they are, for markers in the world)."""
    r = residual_3d_cm(x - offset_m(x, detected, weights), detected, depth_ratio)
    return jnp.sum(c * huber(square(r), width_cm), axis=-1)


def L2D(
    x_cam: Float[Array, "*n J 3"], xy_px: Float[Array, "*n J 2"], c: Float[Array, "*n J"],
    camera_matrix: Float[Array, "*#n 3 3"], width_px: ArrayLike,
) -> Float[Array, "*n"]:  # fmt: skip
    """Mean of c huber(|Pi(R_nc^-1 x_hat) - u|; d)."""
    return jnp.sum(c * huber(square(residual_2d_px(x_cam, xy_px, camera_matrix)), width_px), axis=-1)


def Lphone(R_nc: jaxlie.SO3, measured: jaxlie.SO3, width_deg: ArrayLike) -> Float[Array, "*n"]:
    """Angle (deg) between fitted and measured orientation, smoothed below `width_deg` (the paper's: 0)."""
    return huber(square(residual_phone_deg(R_nc, measured)), width_deg) / width_deg


def Loffset(site_offset_m: Float[Array, "J 3"]) -> Float[Array, ""]:
    """Sum of squared marker offsets (m^2), as in the published code."""
    return jnp.sum(site_offset_m**2)


# --- feet on the floor: two rules of a sole that stands


def Lfloor(x: Array, floor: Array, contact: Array, width_cm: ArrayLike) -> Float[Array, "*n"]:
    """Sum over the points of the soles of contact times huber(height; d)."""
    return jnp.sum(contact * huber(square(residual_floor_cm(x, floor[..., None, :])), width_cm), axis=-1)


def Lslide(x: Array, following: Array, rate: Array, contact: Array, width_cm: ArrayLike) -> Float[Array, "*n"]:
    """Sum over the points of the soles of contact times huber(displacement; d)."""
    return jnp.sum(contact * huber(square(residual_slide_cm(x, following, rate[:, None])), width_cm), axis=-1)


# --- the total


class At(NamedTuple):
    """What the terms are evaluated at: the frames of a problem, the unknowns there and the points they put into the
    world. `phone`: fitted and measured orientations and their weights, of sum 1 over all trials with a phone at most.
    """

    problem: Problem
    weights: Weights
    state: State
    x: Float[Array, "F J 3"]
    soles: Float[Array, "F P 3"]
    phone: tuple[jaxlie.SO3, jaxlie.SO3, Float[Array, " M"]]

    def mean(self, per_frame: Float[Array, " F"]) -> Float[Array, ""]:
        """Mean over the frames that count."""
        return jnp.sum(self.problem.weight * per_frame) / frame_count(self.problem)


def no_phone() -> tuple[jaxlie.SO3, jaxlie.SO3, Array]:
    """`At.phone` where no camera turns."""
    none = jaxlie.SO3(jnp.zeros((0, 4)))
    return none, none, jnp.zeros(0)


def frame_count(problem: Problem) -> Float[Array, ""]:
    """Sum of the frames' weights."""
    return jnp.maximum(jnp.sum(problem.weight), 1.0)


def _l3d(at: At) -> Array:
    p, w = at.problem, at.weights
    x_cam = in_camera(at.x, at.state.R_nc, p.p_nc)
    centred = mean_weights(p.c_3d, p.weight_3d)
    detected = corrected_points(p, at.state)
    per_view = L3D(x_cam, detected, p.c_3d * p.weight_3d, centred, w.depth_ratio, w.huber_3d_cm)
    n = p.c_world.shape[1]
    in_world = L3D(at.x[:, :n], p.x_world, p.c_world * p.weight_3d[:n], jnp.zeros_like(p.c_world), 1.0, w.huber_3d_cm)
    return at.mean(jnp.sum(per_view, axis=-1) + in_world)


def corrected_points(p: Problem, state: State) -> Float[Array, "F V J 3"]:
    """The detector's points of all views without the errors that a state says they have in every frame."""
    if not state.lean.shape[0]:
        return p.x_cam
    return corrected(p.x_cam, state.lean[p.trial][:, None], state.depth_m[p.trial][:, None])


def _l2d(at: At) -> Array:
    p = at.problem
    x_cam = in_camera(at.x, at.state.R_nc, p.p_nc)
    return at.mean(jnp.sum(L2D(x_cam, p.xy_px, p.c_2d, p.camera_matrix, at.weights.huber_2d_px), axis=-1))


def _lphone(at: At) -> Array:
    fitted, measured, weights = at.phone
    return jnp.sum(weights * Lphone(fitted, measured, at.weights.huber_phone_deg))


def pose_prior_cost(qpos: Float[Array, "F Q"], w: Weights) -> Float[Array, " F"]:
    """Negative logarithm of the pose prior's density at each frame."""
    return pose_cost(pose_z(posture(qpos, w.pelvis), w.neutral, w.whitener), w.pose_log_weight)


def _lfloor(at: At) -> Array:
    p, w = at.problem, at.weights
    return at.mean(Lfloor(at.soles, at.state.floor[p.trial], p.contact, w.huber_floor_cm))


def _lslide(at: At) -> Array:
    p, w = at.problem, at.weights
    return at.mean(Lslide(at.soles, later(at.soles), p.rate, slide_contact(p), w.huber_slide_cm))


def Lpelvis(qpos: Float[Array, "F Q"], p: Problem, w: Weights) -> Float[Array, " F"]:
    """Half squares of the pelvis' tilt and list less the augmenter's, in standard deviations."""
    if not w.pelvis.shape[0]:
        return jnp.zeros_like(p.c_pelvis)
    return 0.5 * p.c_pelvis * square((inclination(qpos[:, w.pelvis]) - p.pelvis) / w.pelvis_sd)


def slide_contact(p: Problem) -> Float[Array, "F P"]:
    """How surely a point of the soles stands in a frame and the next one of its trial."""
    return p.contact * later(p.contact) * ((p.rate > 0) * later(p.weight))[:, None]


def detector_prior(problem: Problem, w: Weights, lean: Array, depth_m: Array) -> Float[Array, ""]:
    """Half squares of what a detector gets wrong in all frames of a trial, in standard deviations; each trial counts as
    much as its frames do."""
    z2 = jnp.sum((lean / w.lean_sd) ** 2, axis=-1) + jnp.sum((depth_m / w.depth_sd_m) ** 2, axis=-1)
    return 0.5 * jnp.sum(problem.weight * z2[problem.trial]) / frame_count(problem) if lean.shape[0] else jnp.zeros(())


def shared_prior(problem: Problem, w: Weights, s: Array, clock_s: Array, floor: Array) -> Float[Array, ""]:
    """Half squares of what all frames share: scale parameters, clocks and floors, in standard deviations."""
    clock = 0.5 * jnp.sum((clock_s / w.clock_sd_s) ** 2)
    level = 0.5 * jnp.sum(w.floor_precision * floor**2)
    return 0.5 * s @ w.scale_precision @ s + (clock + level) / frame_count(problem)


#: The terms of the total: the weight in a paramset and the cost, a mean over frames.
TERMS: dict[str, tuple[Callable[[Weights], ArrayLike], Callable[[At], Array]]] = {
    "L3D": (lambda w: w.weight_3d, _l3d),
    "L2D": (lambda w: w.weight_2d, _l2d),
    "Lphone": (lambda w: w.weight_phone, _lphone),
    "Loffset": (lambda w: w.weight_offset_per_m2, lambda at: Loffset(at.state.site_offset_m)),
    "pose prior": (
        lambda w: w.weight_pose,
        lambda at: at.mean(pose_prior_cost(at.state.qpos, at.weights)),
    ),
    "joint limits": (
        lambda w: w.weight_limit,
        lambda at: at.mean(0.5 * square(beyond_limit_deg(at.state.qpos, at.weights.low, at.weights.high))),
    ),
    "smoothness": (
        lambda w: 1.0,
        lambda at: (
            0.5 * jnp.sum(at.weights.smooth * bent(at.state.qpos, at.problem.bend) ** 2) / frame_count(at.problem)
        ),
    ),
    "Lfloor": (lambda w: w.weight_floor, _lfloor),
    "Lslide": (lambda w: w.weight_slide, _lslide),
    "Lpelvis": (lambda w: w.weight_pelvis, lambda at: at.mean(Lpelvis(at.state.qpos, at.problem, at.weights))),
    "detector prior": (
        lambda w: w.weight_detector,
        lambda at: detector_prior(at.problem, at.weights, at.state.lean, at.state.depth_m),
    ),
    "shared prior": (
        lambda w: 1.0,
        lambda at: shared_prior(at.problem, at.weights, at.state.s, at.state.clock_s, at.state.floor),
    ),
}
#: The paper's own.
PAPER = ("L3D", "L2D", "Lphone", "Loffset")
#: Those that need no neighbouring frames: what a random draw of frames can be fitted by.
OF_SINGLE_FRAMES = (*PAPER, "pose prior", "shared prior")


def weighted(at: At, terms: Collection[str] = tuple(TERMS)) -> dict[str, Float[Array, ""]]:
    """The named terms times their weights: what adds up to the total."""
    return {name: jnp.asarray(weight(at.weights)) * cost(at) for name, (weight, cost) in TERMS.items() if name in terms}


def total(at: At, terms: Collection[str] = tuple(TERMS)) -> Float[Array, ""]:
    """Weighted sum of the named terms."""
    return functools.reduce(jnp.add, weighted(at, terms).values())
