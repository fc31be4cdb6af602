"""From a plan and the angles it aims at to a motion whose feet stand still: least squares over the whole trajectory.

Unknown are the pelvis and both legs on the plan's grid. The sum of squares of these is minimised by Gauss-Newton with a
banded normal matrix:
- the distance of the sole's points from where the plan puts them while they are on the floor;
- how deep any point of the sole is below the floor, or below its clearance in swing;
- the difference r from the reference, and its second derivative in time. The latter makes r a smooth curve, with a
  continuous second derivative also where a contact begins or ends;
- how far a joint is beyond its range.
"""

from __future__ import annotations

import dataclasses

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import SCALE_NAMES, load_body, scaled_model

from .physique import SOLE_M
from .plan import GRID_STEP_S, Plan, Step, fade, pelvis_joints

#: Points of the sole in the frames of their bodies (right side; m, unscaled): those that the contact holds.
SOLE_POINTS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "heel": ("calcn", (-0.01617, -0.00123, 0.0)),
    "ball": ("toes", (0.0, 0.0, 0.0)),
    "first": ("calcn", (0.18063, 0.0, -0.03426)),
    "fifth": ("calcn", (0.16314, 0.0, 0.03487)),
    "toe": ("toes", (0.05577, 0.00815, -0.0284)),
}
#: Standard deviations: of a point that is held (m; the toe gives way sideways because its hinge is oblique), of depth.
HELD_M, ROLL_M, TOE_M, DEPTH_M = 0.001, 0.003, 0.004, 0.002
#: How far the solution may be from the reference (deg; pelvis m).
SD_DEG = {
    "pelvis_tilt": 2.5,
    "pelvis_list": 2.0,
    "pelvis_rotation": 2.5,
    "hip_flexion": 4.0,
    "hip_adduction": 3.0,
    "hip_rotation": 5.0,
    "knee_angle": 4.0,
    "ankle_angle": 4.0,
    "subtalar_angle": 6.0,
    "mtp_angle": 6.0,
}
PATH_SD_M, HEIGHT_SD_M = 0.025, 0.05
#: The difference from the reference is smooth over about this time (s).
SMOOTH_S = 0.07
#: Clearance of the sole in the middle of a swing (m); knees may not bend back by more (deg); soft edge of ranges.
CLEARANCE_M, KNEE_BACK_DEG, EDGE_DEG = 0.012, 3.0, 0.7
#: A contact takes hold and lets go within this time (s), inside its own time.
RAMP_S = 0.03
#: First the held points are weak, then they are held in full.
_LOOSE = (16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
_HALVINGS = 6
_LEG = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle", "subtalar_angle", "mtp_angle")


@dataclasses.dataclass(frozen=True, eq=False)
class Contacts:
    """Targets of the sole's points: P points, N times. `weight` 1/m per axis of the world; `target` m;
    `floor` (N, P): the least height (m)."""

    target_m: Float[np.ndarray, "N P 3"]
    weight: Float[np.ndarray, "N P 3"]
    floor_m: Float[np.ndarray, "N P"]


def solve(
    plan: Plan, aim: Float[np.ndarray, "N 40"], sway_m: Float[np.ndarray, " N"], scale: Float[np.ndarray, " 8"]
) -> Float[np.ndarray, "N 40"]:
    """Joint values (N, 40) on the plan's grid, in a world whose floor is z = 0."""
    body = load_body()
    column = {n: i for i, n in enumerate(body.joint_names)}
    soles = _Soles(scale)
    contacts = soles.contacts(plan)
    q = aim.copy()
    turned = [column[f"pelvis_{n}"] for n in ("tilt", "list", "rotation")]
    q[:, turned] = pelvis_joints(aim[:, turned], plan.heading_rad)
    # From the standing feet: height always, the place where the plan has no way for the pelvis.
    place = soles.carried(q, contacts)
    left = np.column_stack([-np.sin(plan.heading_rad), np.cos(plan.heading_rad)])
    way = plan.xy_m + sway_m[:, None] * left
    rest = body.mj_model.body("pelvis").pos
    floor_xy = plan.on_path[:, None] * way + (1 - plan.on_path)[:, None] * place[:, :2]
    q[:, column["pelvis_tx"]] = floor_xy[:, 0] - rest[0]
    q[:, column["pelvis_tz"]] = -(floor_xy[:, 1] - rest[1])
    q[:, column["pelvis_ty"]] = place[:, 2] - rest[2]

    names = [f"pelvis_{n}" for n in ("tx", "tz", "ty", "tilt", "list", "rotation")]
    names += [f"{n}_{side}" for side in "rl" for n in _LEG]
    free = np.array([column[n] for n in names])
    sd = np.array([_sd(n) for n in names])
    low, high = _ranges(names)
    target = q.copy()
    problem = _Problem(soles, contacts, target[:, free], free, sd, low, high)
    for loose in _LOOSE:
        move = _step(problem, q, loose)
        before = problem.cost(q, loose)
        for _ in range(_HALVINGS):
            tried = q.copy()
            tried[:, free] += move
            if problem.cost(tried, loose) <= before:
                break
            move = 0.5 * move
        else:
            tried = q
        q = tried
    return q


def sole_points(
    qpos: Float[np.ndarray, "T 40"], scale: Float[np.ndarray, " 8"] | None = None
) -> dict[str, Float[np.ndarray, "T P 3"]]:
    """The five points of the right ("r") and left ("l") sole in the world (m), in the order of `SOLE_POINTS`."""
    points = _Soles(np.ones(len(SCALE_NAMES)) if scale is None else scale).points(np.asarray(qpos, np.float64))
    return {"r": points[:, : len(SOLE_POINTS)], "l": points[:, len(SOLE_POINTS) :]}


@dataclasses.dataclass(frozen=True, eq=False)
class _Problem:
    soles: _Soles
    contacts: Contacts
    target: np.ndarray
    free: np.ndarray
    sd: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def cost(self, q: np.ndarray, loose: float) -> float:
        x = self.soles.points(q)
        off = (self.contacts.weight / loose) * (self.contacts.target_m - x)
        deep = np.clip(self.contacts.floor_m - x[..., 2], 0, None) / (DEPTH_M * loose)
        now = q[:, self.free]
        beyond = (np.clip(self.low - now, 0, None) + np.clip(now - self.high, 0, None)) / np.radians(EDGE_DEG)
        r = (now - self.target) / self.sd
        bend = np.diff(r, 2, axis=0) * (SMOOTH_S / GRID_STEP_S) ** 2
        return 0.5 * float(sum(np.sum(part**2) for part in (off, deep, beyond, r, bend)))


def _step(problem: _Problem, q: np.ndarray, loose: float) -> np.ndarray:
    contacts, target, free, sd = problem.contacts, problem.target, problem.free, problem.sd
    low, high = problem.low, problem.high
    n_t, n = len(q), len(free)
    x, jac = problem.soles.with_jacobian(q, free)
    weight = contacts.weight / loose
    off = contacts.target_m - x
    deep = np.clip(contacts.floor_m - x[..., 2], 0, None) / (DEPTH_M * loose)
    up = jac[:, :, 2] * ((deep > 0) / (DEPTH_M * loose))[..., None]
    rows = np.concatenate([(jac * weight[..., None]).reshape(n_t, -1, n), up], axis=1)
    across = rows.swapaxes(1, 2)
    left = np.concatenate([(weight * off).reshape(n_t, -1), deep], axis=1)
    grad, hess = (across @ left[..., None])[..., 0], across @ rows
    now = q[:, free]
    edge = np.radians(EDGE_DEG)
    beyond = np.clip(low - now, 0, None) - np.clip(now - high, 0, None)
    grad += beyond / edge**2
    diagonal = (beyond != 0) / edge**2 + 1 / sd**2
    r = now - target
    grad -= r / sd**2
    tau = (SMOOTH_S / GRID_STEP_S) ** 2
    bend = np.diff(r, 2, axis=0) * (tau / sd) ** 2
    pad = np.zeros((2, n))
    b = np.concatenate([pad, bend, pad])
    grad -= b[2:] - 2 * b[1:-1] + b[:-2]
    hess[:, np.arange(n), np.arange(n)] += diagonal

    ab = np.zeros((2 * n + 1, n_t * n))
    for d in range(n):
        block = ab[d].reshape(n_t, n)
        block[:, : n - d] += hess[:, np.arange(d, n), np.arange(n - d)]
    # Second differences: 1 5 6 ... 6 5 1 on the diagonal, and the two beside it.
    one = np.ones(n_t - 2)
    centre = np.zeros(n_t)
    centre[:-2] += one
    centre[1:-1] += 4 * one
    centre[2:] += one
    next_, second = np.zeros(n_t), np.zeros(n_t)
    next_[:-2] -= 2 * one
    next_[1:-1] -= 2 * one
    second[:-2] += one
    stiff = (tau / sd) ** 2
    ab[0] += np.outer(centre, stiff).ravel()
    ab[n] += np.outer(next_, stiff).ravel()
    ab[2 * n] += np.outer(second, stiff).ravel()
    move = solveh_banded(ab, grad.ravel(), lower=True).reshape(n_t, n)
    return np.clip(move, -0.5, 0.5)


def _sd(name: str) -> float:
    if name in ("pelvis_tx", "pelvis_tz"):
        return PATH_SD_M
    if name == "pelvis_ty":
        return HEIGHT_SD_M
    return float(np.radians(SD_DEG[name.removesuffix("_r").removesuffix("_l")]))


def _ranges(names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    body = load_body()
    low, high = body.joint_range_rad[[body.joint_names.index(n) for n in names]].T.copy()
    inside = np.radians(2.0)
    low, high = low + inside, high - inside
    for i, name in enumerate(names):
        if name.startswith("knee_angle"):
            high[i] = np.radians(KNEE_BACK_DEG)
    return low, high


class _Soles:
    """Kinematics of the sole's points of one person."""

    def __init__(self, scale: Float[np.ndarray, " 8"]) -> None:
        body = load_body()
        self._model = scaled_model(body, scale)
        self._data = mujoco.MjData(self._model)
        self.names, ids, local, size = [], [], [], []
        for side, sign in (("r", 1.0), ("l", -1.0)):
            for name, (part, place) in SOLE_POINTS.items():
                index = body.body_names.index(f"{part}_{side}")
                self.names.append(f"{name}_{side}")
                ids.append(index + 1)
                size.append(float(scale[body.scale_index[index]]))
                local.append(size[-1] * np.array(place) * [1, 1, sign])
        self._ids, self._local = np.array(ids), np.array(local)
        self._carried_by = body.moves[self._ids - 1]
        # The foot flat at the origin, pointing along x: forward, left, height above the floor.
        self._flat = np.empty((len(ids), 3))
        for i, (name, place) in enumerate(zip(self.names, self._local, strict=True)):
            part = SOLE_POINTS[name[:-2]][0]
            toes = self._model.body(f"toes_{name[-1]}").pos if part == "toes" else np.zeros(3)
            at = toes + place
            self._flat[i] = [at[0], -at[2], at[1] + SOLE_M * size[i]]

    def points(self, q: np.ndarray) -> np.ndarray:
        return self._points(*self._placed(q, "xpos", "xmat"))

    def with_jacobian(self, q: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, P, 3) and their derivatives (N, P, 3, n) by the free joints: a hinge moves what it carries by
        axis x arm, a slide along its axis."""
        xpos, xmat, axis, anchor = self._placed(q, "xpos", "xmat", "xaxis", "xanchor")
        x, axis = self._points(xpos, xmat), axis[:, None, free]
        turned = np.cross(axis, x[:, :, None] - anchor[:, None, free])
        by_joint = np.where(self._model.jnt_type[free, None] == mujoco.mjtJoint.mjJNT_SLIDE, axis, turned)
        return x, np.moveaxis(by_joint * self._carried_by[:, free, None], -1, -2)

    def carried(self, q: np.ndarray, contacts: Contacts) -> np.ndarray:
        """Positions of the pelvis (N, 3) at which the mean of the held points is on target, smoothed."""
        xpos, xmat = self._placed(q, "xpos", "xmat")
        weight = contacts.weight[:, :, 2, None] + 1e-9
        off = np.sum(weight * (contacts.target_m - self._points(xpos, xmat)), axis=1) / np.sum(weight, axis=1)
        return gaussian_filter1d(xpos[:, 1] + off, 0.1 / GRID_STEP_S, axis=0, mode="nearest")

    def contacts(self, plan: Plan) -> Contacts:
        t, n_p = plan.grid_s, len(self.names)
        target, weight = np.zeros((len(t), n_p, 3)), np.zeros((len(t), n_p, 3))
        floor = np.tile(self._flat[:, 2], (len(t), 1))
        for i, name in enumerate(self.names):
            point, side = name[:-2], name[-1]
            own = [s for s in plan.steps if s.side == side]
            target[:, i] = self._spot(i, own[0])
            for k, step in enumerate(own):
                # Also before it stands: what is not held has weight 0.
                target[t >= (own[k - 1].up_s if k else -np.inf), i] = self._spot(i, step)
                for axis_sd, (start, stop) in _holds(point, step):
                    held = fade(np.minimum(t - start, stop - t) / RAMP_S)
                    weight[:, i] = np.maximum(weight[:, i], held[:, None] / np.array(axis_sd))
                if k:
                    fraction = np.clip((t - own[k - 1].up_s) / (step.down_s - own[k - 1].up_s), 0, 1)
                    floor[:, i] += CLEARANCE_M * np.sin(np.pi * fraction) ** 2
        return Contacts(target, weight, floor)

    def _spot(self, i: int, step: Step) -> np.ndarray:
        c, s = np.cos(step.heading_rad), np.sin(step.heading_rad)
        x, y, z = self._flat[i]
        return np.array([step.xy_m[0] + c * x - s * y, step.xy_m[1] + s * x + c * y, z])

    def _placed(self, q: np.ndarray, *names: str) -> list[np.ndarray]:
        """Kinematics of each pose by MuJoCo, by name: (N, ...)."""
        out = [np.empty((len(q), *getattr(self._data, name).shape)) for name in names]
        for t, values in enumerate(q):
            self._data.qpos[:] = values
            mujoco.mj_kinematics(self._model, self._data)
            for array, name in zip(out, names, strict=True):
                array[t] = getattr(self._data, name)
        return out

    def _points(self, xpos: np.ndarray, xmat: np.ndarray) -> np.ndarray:
        turn = xmat[:, self._ids].reshape(len(xmat), len(self._ids), 3, 3)
        return xpos[:, self._ids] + np.einsum("npij,pj->npi", turn, self._local)


def _holds(point: str, step: Step) -> list[tuple[tuple[float, float, float], tuple[float, float]]]:
    """Standard deviations by axis (m) and times of what holds a point."""
    never = np.inf
    if point == "heel":
        return [((HELD_M, HELD_M, HELD_M), step.heel_s)]
    if point == "ball":
        return [((HELD_M, HELD_M, HELD_M), step.ball_s)]
    if point == "toe":
        last = (step.ball_s[1] - RAMP_S, step.up_s)
        return [((TOE_M, TOE_M, HELD_M), step.toe_s), ((HELD_M, HELD_M, HELD_M), last)]
    return [((never, never, ROLL_M), step.ball_s)]
