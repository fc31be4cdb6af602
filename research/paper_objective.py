"""The paper's total cost of a session, which compares solvers whatever they minimise themselves."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import Body, MarkerSet, marker_positions, scale_multipliers
from pbl_pipeline.fit import CostParams, SessionFit, Trial
from pbl_pipeline.fit.objective import PAPER, total
from pbl_pipeline.fit.params import PAPER_2025
from pbl_pipeline.fit.problem import Problem, State
from pbl_pipeline.fit.session import Session, make_session
from pbl_pipeline.fit.term import At, Phone
from pbl_pipeline.fit.weights import Weights
from pbl_pipeline.keypoints import Keypoints

#: The paper's own (section Total loss and optimization), whatever the defaults of `CostParams` become.
PAPER_COST = CostParams(
    weight_3d=1.0, weight_2d=0.1, weight_phone=1.0, weight_offset_per_m2=100.0, huber_3d_cm=10.0, huber_2d_px=5.0
)


def paper_objective(fit: SessionFit, trials: Sequence[Trial], markers: MarkerSet | None = None) -> float:
    """Return the paper's own total (section Model Fitting) of a session fit, whatever the fit itself minimised."""
    motions = [t.camera_motion for t in fit.trials]
    session = make_session(trials, [t.name for t in fit.trials], PAPER_2025, motions, markers)
    qpos = np.zeros((session.problem.weight.shape[0], len(session.body.joint_names)))
    R_nc = np.array(session.problem.R_nc, np.float64)
    for i, trial in enumerate(fit.trials):
        qpos[session.frames(i)] = trial.qpos
        if isinstance(trials[i], Keypoints):
            R_nc[session.frames(i), 0] = Rotation.from_quat(trial.phone_quat_wxyz, scalar_first=True).as_matrix()
    overall = fit.scale[0] - 1
    s = np.concatenate([[overall], fit.scale[1:] - 1 - overall])
    return objective_of(session, qpos, R_nc, s, fit.site_offset_m)


def objective_of(
    session: Session,
    qpos: Float[ArrayLike, "F Q"],
    R_nc: Float[ArrayLike, "F V 3 3"],
    s: Float[ArrayLike, " S"],
    site_offset_m: Float[ArrayLike, "J 3"],
) -> float:
    """Return 1.0 L3D + 0.1 L2D + 1.0 Lphone + 100 sum offset^2 of a solution.

    Each term is the mean over trials of its mean over the frames that count and the markers; a phone is compared at
    the frames' times, with the video's clock. `qpos` and `R_nc` are on the packed frames, where those that do not
    count may be NaN; `s`: the paper's scale parameters; `site_offset_m` without padding.
    """
    p, n = session.problem, len(session.trials)
    weight, trial = np.asarray(p.weight, np.float64), np.asarray(p.trial)
    counts = weight > 0
    per_trial = np.bincount(trial, weights=weight, minlength=n)
    of_frame: Any = np.asarray(weight / np.maximum(per_trial, 1.0)[trial] / n, np.float32)
    offset = np.asarray(site_offset_m, np.float32)
    n_trials = p.has_phone.shape[0]
    state = State(
        qpos=jnp.asarray(np.where(counts[:, None], qpos, 0.0), jnp.float32),
        R_nc=jnp.asarray(np.where(counts[:, None, None, None], R_nc, np.eye(3)), jnp.float32),
        s=jnp.asarray(s, jnp.float32),
        site_offset_m=jnp.asarray(np.pad(offset, [(0, p.weight_3d.shape[0] - len(offset)), (0, 0)])),
        clock_s=jnp.zeros(n_trials),
        floor=jnp.zeros((n_trials, 3)),
    )
    weights = Weights.of(session.body, dataclasses.replace(PAPER_2025, cost=PAPER_COST))
    return float(_total(session.body, dataclasses.replace(p, weight=of_frame), weights, state))


@functools.partial(jax.jit, static_argnums=0)
def _total(body: Body, p: Problem, w: Weights, state: State) -> Array:
    with jax.default_matmul_precision("highest"):
        offsets = p.point_offsets(state.site_offset_m)
        x, soles, _ = p.split(marker_positions(body, p.points, state.qpos, scale_multipliers(state.s), offsets))
        phone = None
        if p.moving:
            fitted, measured = (jaxlie.SO3.from_matrix(jnp.asarray(R)[:, 0]) for R in (state.R_nc, p.R_nc))
            phone = Phone(fitted, lambda _: measured, p.weight * jnp.asarray(p.has_phone)[p.trial])
        return total(At(p, w, state, x, soles, phone), PAPER)
