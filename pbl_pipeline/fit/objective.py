"""The cost of a session: the list of its terms (docs/fit.md states them as equations)."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from .depth_term import LDEPTH, SURFACE
from .feet_terms import LFLOOR, LSLIDE
from .imu_term import LIMU, WEARING
from .joint_terms import LIMITS, LPELVIS, POSE_PRIOR, SMOOTHNESS
from .keypoint_terms import L2D, L3D, L_MARKERS
from .phone_term import LPHONE
from .shared_terms import CLOCK, DETECTOR, FLOOR, LOFFSET, SCALE, SIZE
from .term import At, SharedTerm, Term

AnyTerm = Term | SharedTerm
#: The paper's own terms; markers of a laboratory count as its L3D.
PAPER = (L3D, L_MARKERS, L2D, LPHONE, LOFFSET)
#: Those that need no neighbouring frames: what a random draw of frames can be fitted by.
OF_SINGLE_FRAMES: tuple[AnyTerm, ...] = (*PAPER, POSE_PRIOR, SCALE)
#: All of them.
TERMS: tuple[AnyTerm, ...] = (
    *(*PAPER, POSE_PRIOR, LIMITS, SMOOTHNESS, LFLOOR, LSLIDE, LPELVIS, LIMU, LDEPTH, DETECTOR),
    *(SCALE, SIZE, CLOCK, FLOOR, WEARING, SURFACE),
)


def total(at: At, terms: Sequence[AnyTerm] = TERMS) -> Float[Array, ""]:
    """Weighted sum of terms."""
    return functools.reduce(jnp.add, [term.value(at) for term in terms])
