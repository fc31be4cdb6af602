"""Tilt and list of the pelvis of a person who sits down or squats, from the marker augmenter.

Two hip points do not determine them. The network sees 15 points of the body of a first solution, whose legs and trunk
were observed; of its 35 markers the four iliac spines place the pelvis. It is not applied to walking: it predicts how
the pelvis turns in a squat, but not how far each walker tips the pelvis (slope 0.30 over eight persons;
`research/benchmarks/marker_augmenter.py`).
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, Body, marker_positions, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import MarkerAugmenter

from .joint_terms import arc
from .problem import Problem
from .session import Session

#: Markers of `opencap_35` on the pelvis.
SPINES = ("r_ASIS", "l_ASIS", "r_PSIS", "l_PSIS")
#: A trial with both thighs inclined by more than this (rad) at once, in more than this share of the frames, is one with
#: sitting or squatting. Recorded walks, in a crouch too, reach 28 deg, a sprint 48; sitting and squats pass 83.
FOLDED_RAD, FOLDED_SHARE = np.deg2rad(50.0), 0.05


def with_augmented_pelvis(
    session: Session, p: Problem, qpos: Float[np.ndarray, "F Q"], scale: Float[np.ndarray, " S"]
) -> Problem:
    """The problem with the augmenter's tilt and list of the pelvis, from the joint values (padded) and scale of a first
    solution. A trial without sitting or squatting has none, nor has one that the network does not support (too short,
    or a person outside its range of sizes); it is fitted without.

    Raises the errors of `assets.fetch` if the network is not available.
    """
    asked = [i for i, a in enumerate(session.arrays) if folds(session.body, qpos[session.frames(i)][a.used])]
    if not asked:
        return p
    points, augmenter = marker_set("halpe_26"), _augmenter()
    x = np.asarray(marker_positions(session.body, points, qpos, scale, np.zeros((len(points), 3))), float)
    x = x[:, [points.names.index(n) for n in augmenter.points]]
    pelvis, known = np.zeros(p.pelvis.shape, np.float32), np.zeros(p.c_pelvis.shape, np.float32)
    for i in asked:
        arrays, at = session.arrays[i], session.frames(i)
        seen = np.where(arrays.used[:, None, None], x[at], np.nan)
        try:
            spines = augmenter(arrays.time_s, seen).xyz_world_m
        except PblError as e:
            if e.code != "AUGMENTER_INPUT":
                raise
            continue
        found = inclination_of(pelvis_of(spines))
        known[at] = np.isfinite(found).all(axis=1)
        pelvis[at] = np.nan_to_num(found)
    return dataclasses.replace(p, pelvis=pelvis, c_pelvis=known)  # type: ignore[arg-type]


def folds(body: Body, qpos: Float[np.ndarray, "T Q"]) -> bool:
    """True if the person sits or squats for a part of the time: both thighs far from the vertical at once. The knees do
    not tell it: in a crouched walk they bend as far, over steep thighs."""

    def angles(*names: str) -> np.ndarray:
        return qpos[:, [body.joint_names.index(n) for n in names]]

    pelvis = Rotation.from_euler("ZXY", angles(*PELVIS_TURNS))
    hips = [angles(f"hip_flexion_{side}", f"hip_adduction_{side}") * [1, sign] for side, sign in (("r", 1), ("l", -1))]
    rise = [(pelvis * Rotation.from_euler("ZX", hip)).apply((0, 1, 0))[:, 1] for hip in hips]
    return bool(np.mean(np.max(rise, axis=0) < np.cos(FOLDED_RAD)) > FOLDED_SHARE)


def pelvis_of(markers: Float[np.ndarray, "T 35 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Orientation of the pelvis (columns: its axes forward, up, right; in the world) that best fits the iliac spines to
    those of `opencap_35` in least squares (Kabsch 1976, Acta Cryst A32:922); NaN where unknown."""
    table = marker_set("opencap_35")
    rows = [table.names.index(n) for n in SPINES]
    site = table.position_m[rows] - table.position_m[rows].mean(axis=0)
    seen = markers[:, rows] - markers[:, rows].mean(axis=1, keepdims=True)
    known = np.asarray(np.isfinite(seen).all(axis=(1, 2)))
    out = np.full((len(markers), 3, 3), np.nan)
    left, _, right = np.linalg.svd(np.einsum("tni,nj->tij", seen[known], site))
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    out[known] = left @ right
    return out


def inclination_of(pelvis: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 2"]:
    """Tilt (backwards positive) and list (rad) of a pelvis against the vertical, as `joint_terms.inclination`."""
    return arc(np.stack([pelvis[:, 2, 0], -pelvis[:, 2, 2]], axis=-1), np)


@functools.cache
def _augmenter() -> MarkerAugmenter:
    return MarkerAugmenter()
