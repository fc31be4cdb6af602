"""The body as capsules in the world, for drawing, without JAX; and its height."""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from typing import Any

import mujoco
import numpy as np

from pbl_pipeline.body.model import Body


@dataclasses.dataclass(frozen=True)
class Capsules:
    """G capsules over T poses: rounded bars from `start` to `end`."""

    #: G names (the shape, numbered where it takes several capsules) and the body each belongs to.
    names: tuple[str, ...]
    body_names: tuple[str, ...]
    #: (T, G, 3) world, metres; NaN where qpos is NaN.
    start: np.ndarray
    end: np.ndarray
    radius_m: np.ndarray  # (G,) metres


@dataclasses.dataclass(frozen=True)
class CapsuleShapes:
    """G capsules in the frames of their bodies."""

    names: tuple[str, ...]
    body: np.ndarray  # (G,) index of the body that a capsule moves with, in `Body.body_names`
    #: (G, 3) in that body's frame, metres.
    start: np.ndarray
    end: np.ndarray
    radius_m: np.ndarray  # (G,)


@dataclasses.dataclass(frozen=True)
class BodyFrames:
    """`position_m` (T, B, 3) and `rotation` (T, B, 3, 3), body to world (z up); NaN where qpos is NaN."""

    position_m: np.ndarray
    rotation: np.ndarray


def capsules(body: Body, qpos: np.ndarray, scale: np.ndarray) -> Capsules:
    """The body's shapes at the poses `qpos` (T, 40) with scale multipliers (8,), lengths and radii scaled alike.

    Ellipsoids are drawn as capsules side by side (see `_strands`). Kinematics by C MuJoCo, in double precision.
    """
    shapes, at = capsule_shapes(body, scale), body_frames(body, qpos, scale)

    def world(points: np.ndarray) -> np.ndarray:
        return at.position_m[:, shapes.body] + np.einsum("tgij,gj->tgi", at.rotation[:, shapes.body], points)

    return Capsules(
        names=shapes.names,
        body_names=tuple(body.body_names[i] for i in shapes.body),
        start=world(shapes.start),
        end=world(shapes.end),
        radius_m=shapes.radius_m,
    )


def ray_lengths(shapes: Capsules, origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Lengths (T, R, G), in units of the rays (T, R, 3), from origins (T, 3) to the first point of each capsule on
    them; infinite where a ray passes it."""
    axis, away = shapes.end - shapes.start, origin[:, None] - shapes.start
    dot = lambda a, b: np.einsum("...i,...i->...", a, b)  # noqa: E731
    rays, r2 = ray[:, :, None], shapes.radius_m**2
    n2, d2 = dot(axis, axis)[:, None], dot(ray, ray)[..., None]
    along, from_axis = dot(rays, axis[:, None]), dot(away, axis)[:, None]
    ahead, out2 = dot(rays, away[:, None]), dot(away, away)[:, None]

    def nearest(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """First root of a x^2 + 2 b x + c."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return (-b - np.sqrt(b**2 - a * c)) / a

    wall = nearest(n2 * d2 - along**2, n2 * ahead - along * from_axis, n2 * (out2 - r2) - from_axis**2)
    between = from_axis + wall * along
    top = out2 - 2 * from_axis + n2
    caps = [nearest(d2, ahead, out2 - r2), nearest(d2, ahead - along, top - r2)]
    found = np.fmin(np.where((between >= 0) & (between <= n2), wall, np.nan), np.fmin(*caps))
    # Where a ray enters one part within another, it entered that other part before.
    return np.where(np.isfinite(found) & (found > 0), found, np.inf)


def stature_m(body: Body, scale: np.ndarray) -> float:
    """Height (m) of the body with scale multipliers (8,), standing at `qpos = 0`: from its soles to the top of its
    head, as its shapes have them (1.80 m unscaled)."""
    return _stature_m(body, tuple(np.asarray(scale, np.float64).tolist()))


@functools.lru_cache(maxsize=64)
def _stature_m(body: Body, scale: tuple[float, ...]) -> float:
    shapes = capsules(body, np.zeros((1, len(body.joint_names))), np.array(scale))
    z, r = np.concatenate([shapes.start, shapes.end])[..., 2], shapes.radius_m
    return float((z + r).max() - (z - r).min())


def capsule_shapes(body: Body, scale: np.ndarray) -> CapsuleShapes:
    """The body's shapes with scale multipliers (8,), which move with their bodies."""
    shapes = _unscaled(body)
    own = np.asarray(scale, np.float64)[body.scale_index[shapes.body]]
    start, end = own[:, None] * shapes.start, own[:, None] * shapes.end
    return dataclasses.replace(shapes, start=start, end=end, radius_m=own * shapes.radius_m)


def body_frames(body: Body, qpos: np.ndarray, scale: np.ndarray) -> BodyFrames:
    """Return the bodies at the poses `qpos` (T, 40) with scale multipliers (8,), by C MuJoCo in double precision."""
    model = scaled_model(body, scale)
    data = mujoco.MjData(model)
    qpos = np.asarray(qpos, np.float64)
    xpos = np.full((len(qpos), len(body.body_names), 3), np.nan)
    xmat = np.full((len(qpos), len(body.body_names), 3, 3), np.nan)
    for t, pose in enumerate(qpos):
        if np.all(np.isfinite(pose)):
            data.qpos[:] = pose
            mujoco.mj_kinematics(model, data)
            xpos[t], xmat[t] = data.xpos[1:], data.xmat[1:].reshape(-1, 3, 3)
    return BodyFrames(xpos, xmat)


def scaled_model(body: Body, scale: np.ndarray) -> Any:
    """Copy the model for C MuJoCo with the origins of the bodies scaled by multipliers (8,); masses are unscaled."""
    model = copy.copy(body.mj_model)
    model.body_pos[2:] *= np.asarray(scale, np.float64)[body.scale_index[body.parent_index[1:]], None]
    return model


@functools.cache
def _unscaled(body: Body) -> CapsuleShapes:
    model, found = body.mj_model, []
    for i in range(model.ngeom):
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[i])
        centre, axes, size = model.geom_pos[i].copy(), rotation.reshape(3, 3).T, model.geom_size[i].copy()
        if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            # MuJoCo turns `fromto` into a z axis that points from "to" to "from".
            strands = [(size[1] * axes[2], -size[1] * axes[2], float(size[0]))]
        else:
            strands = _strands(axes, size)
        name, owner = model.geom(i).name, int(model.geom_bodyid[i]) - 1
        for k, (start, end, radius) in enumerate(strands):
            label = name if len(strands) == 1 else f"{name}_{k + 1}"
            found.append((label, owner, centre + start, centre + end, radius))
    names, *arrays = zip(*found, strict=True)
    return CapsuleShapes(names, *map(np.array, arrays))


def _strands(axes: np.ndarray, half: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Approximate an ellipsoid with half axes a >= b >= c by parallel capsules along a, side by side along b, of radius
    c, without gaps; the ends follow the ellipse, so that the outline has its three half axes.
    """
    order = np.argsort(half)[::-1]
    (a, b, c), (along, across, _) = half[order], axes[order]
    reach = b - c
    count = 1 if reach < 0.05 * c else math.ceil(2 * reach / (1.5 * c)) + 1
    strands = []
    for offset in np.linspace(-reach, reach, count) if count > 1 else [0.0]:
        length = max(a * math.sqrt(1 - (offset / b) ** 2) - c, 0.0)
        strands.append((offset * across - length * along, offset * across + length * along, float(c)))
    return strands
