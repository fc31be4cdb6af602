"""Poses of the fitted bodies over a trial, computed in chunks of one size so that JAX compiles once."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.errors import PblError

if TYPE_CHECKING:
    from pbl_pipeline.body import Body
    from pbl_pipeline.fit import TrialFit

_CHUNK = 128


@dataclasses.dataclass(frozen=True)
class BodyPoses:
    """`position_m` (T, B, 3) and `rotation` (T, B, 3, 3), body to world (z up), NaN in frames without qpos."""

    body: Body
    position_m: np.ndarray
    rotation: np.ndarray

    def index(self, name: str) -> int:
        """Where a body stands in the second axis."""
        return self.body.body_names.index(name)

    def scale_of(self, name: str, scale: np.ndarray) -> float:
        """The multiplier of a body's own points."""
        return float(np.asarray(scale)[self.body.scale_index[self.index(name)]])


def trial_poses(fit: TrialFit) -> BodyPoses:
    """Forward kinematics of a fit.

    Raises `PblError` GAIT_INPUT where no frame is finite, joints are missing or in degrees.
    """
    from pbl_pipeline.body import SLIDES, load_body  # JAX loads only where a fit is read

    body = load_body()
    if tuple(fit.joint_names) != body.joint_names:
        raise _input_error("joints of another body", f"the {len(body.joint_names)} joints of {body.name}")
    qpos = np.asarray(fit.qpos, float)
    seen = np.flatnonzero(np.all(np.isfinite(qpos), axis=1))
    if len(seen) == 0:
        raise _input_error("a fit without one finite frame", "joint angles in at least some frames")
    turns = np.array([n not in SLIDES and not n.startswith("pelvis") for n in body.joint_names])
    widest = float(np.abs(qpos[np.ix_(seen, np.flatnonzero(turns))]).max())
    # A joint turns by less than half a turn; the pelvis may go round and round.
    if widest > 2 * np.pi:
        raise PblError(
            "GAIT_INPUT",
            found=f"a joint at {widest:.3g} rad",
            expected="qpos in radians, no joint beyond a full turn",
            next_step="write qpos in radians, as `pbl fit` does; the angles.csv beside it is in degrees",
            key=fit.name,
        )
    padded = np.zeros((-(-len(seen) // _CHUNK) * _CHUNK, qpos.shape[1]), np.float32)
    padded[: len(seen)] = qpos[seen]
    scale = np.asarray(fit.scale, np.float32)
    parts = [_compiled()(padded[i : i + _CHUNK], scale) for i in range(0, len(padded), _CHUNK)]
    position = np.full((len(qpos), len(body.body_names), 3), np.nan)
    rotation = np.full((*position.shape, 3), np.nan)
    position[seen] = np.concatenate([np.asarray(p[0]) for p in parts])[: len(seen)]
    rotation[seen] = np.concatenate([np.asarray(p[1]) for p in parts])[: len(seen)]
    return BodyPoses(body, position, rotation)


@functools.cache
def _compiled() -> Any:
    import jax

    from pbl_pipeline.body import body_poses, load_body

    body = load_body()
    return jax.jit(lambda qpos, scale: body_poses(body, qpos, scale))


def _input_error(found: str, expected: str) -> PblError:
    return PblError(
        "GAIT_INPUT", found=found, expected=expected, next_step="pass a fit.npz that `pbl fit` of this version wrote"
    )
