"""Depths at the keypoints on their way into a fit, and what it found of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from pbl_pipeline.body import capsules, ray_lengths, scale_multipliers
from pbl_pipeline.depth.points import PointDepths
from pbl_pipeline.depth.recording import depth_error
from pbl_pipeline.errors import said
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.results import DepthFit

from .problem import Depths, Problem, State, Surface
from .session import Session

#: Beginnings of the names of bodies -> standard deviation (m) of the surface before the joint: of clothes, of flesh and
#: of how a person's shape differs; others.
SKIN_SD_M, OTHER_SD_M = {"pelvis": 0.03, "humerus": 0.03, "torso": 0.03}, 0.02
#: Bodies whose markers are not used: hair; feet, which lie on the floor.
LEFT_OUT = ("head", "calcn", "toes")
#: Depth (m) of the surface less that of a marker that is not hidden by another part of the body.
SKIN_M = -0.14, 0.02
#: Differences (m) from the expected depth up to which a depth is used; least share and number of such depths, so that
#: the recording counts as one of this person.
MOST_OFF_M, LEAST_SHARE, LEAST_DEPTHS = 0.3, 0.5, 20
#: Share of a joint's least standard deviation that is left in trials of which at least this share of the joints had a
#: depth: such that 90 % intervals hold 90 % of the samples of synthetic persons.
FLOOR_SHARES = {"hip_flexion": 0.75, "knee_angle": 0.75}
FLOOR_LEAST_USED = 0.3

_AS_EXPORTED = (
    "leave the pictures of Stray Scanner as exported: they are turned by 180 deg, as odometry.csv states; or leave "
    "out the recording"
)


def check_depths(depths: Sequence[PointDepths | None], trials: Sequence[Any]) -> tuple[PointDepths | None, ...]:
    """The depths of some trials; empty where there are none. Raises `PblError` DEPTH_FILE: they are of other trials, of
    several cameras, or none is known."""
    if all(d is None for d in depths):
        return ()
    shapes = [None if d is None else np.shape(d.m) for d in depths]
    wanted = [(*np.shape(t.confidence), 2) if isinstance(t, Keypoints) else None for t in trials]
    if len(shapes) != len(wanted) or any(s not in (None, w) for s, w in zip(shapes, wanted, strict=True)):
        raise depth_error(f"depths of shapes {shapes}", f"those of keypoints of one camera: {wanted}")
    if not any(d is not None and np.isfinite(d.m).any() for d in depths):
        raise depth_error("no depth at any keypoint", "a person within reach of the depth camera")
    return tuple(depths)


def with_depths(
    session: Session, p: Problem, start: State, x: Float[Array, "F J 3"], dispersion: float
) -> tuple[Problem, State, Float[np.ndarray, " N"]]:
    """Add the depths to a problem, with their start by a solution without them, whose markers lie at `x`; and the
    share of each trial's that lie where the person is.

    Raises `PblError` DEPTH_FILE: hardly any, or less than half of those of a trial, do.
    """
    frames, markers = x.shape[:2]
    depths, seen = np.full((frames, markers, 2), np.nan), np.zeros((frames, markers), bool)
    skin, z = np.zeros((frames, markers)), np.ones((frames, markers))
    names, columns = session.markers.body_names, np.flatnonzero(_large(session))
    scale = np.asarray(scale_multipliers(start.s), float)
    for i, (arrays, own) in enumerate(zip(session.arrays, session.depths, strict=True)):
        if own is None:
            continue
        rows = np.arange(session.frames(i).start, session.frames(i).stop)[arrays.used]
        at = np.ix_(rows, columns)
        ray = np.asarray(x, float)[at] - arrays.p_nc[arrays.used, :1]
        z[at] = np.einsum("tji,ti->tj", ray, np.asarray(start.R_nc, float)[rows, 0, :, 2])
        body = capsules(session.body, np.asarray(start.qpos, float)[rows], scale)
        first = ray_lengths(body, arrays.p_nc[arrays.used, 0], ray).min(axis=-1)
        skin[at] = np.where(np.isfinite(first), first - 1, -1) * z[at]
        depths[at] = own.m[arrays.used][:, columns]
        seen[at] = (arrays.c_2d[arrays.used, 0][:, columns] > 0) & (skin[at] > SKIN_M[0]) & (skin[at] < SKIN_M[1])
    depths[~seen] = np.nan
    ratio = (z + skin)[..., None] / depths
    metre = float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else np.nan
    near = np.asarray(np.abs((z + skin)[..., None] - metre * depths) < MOST_OFF_M)
    depth = np.where(near[..., 0], depths[..., 0], depths[..., 1])
    known, good = np.isfinite(depths).max(axis=-1), near.max(axis=-1)
    counts = np.array([(good[f].sum(), known[f].sum()) for f in map(session.frames, range(len(session.arrays)))])
    wrong = (counts[:, 0] < LEAST_SHARE * counts[:, 1]) & (counts[:, 1] >= LEAST_DEPTHS)
    if wrong.any() or good.sum() < LEAST_DEPTHS:
        n, of = counts[wrong].sum(axis=0) if wrong.any() else counts.sum(axis=0)
        turned = any(
            d and d.turn_deg == 180 and (w or not wrong.any()) for d, w in zip(session.depths, wrong, strict=True)
        )
        raise depth_error(
            said("{n} of {all} depths at the person's joints within 0.3 m of them", n=n, all=of),
            "most of them: a depth recording of this video, upright and not mirrored, within 5 m",
            key=", ".join(np.array(session.names)[wrong]),
            **({"next_step": _AS_EXPORTED} if turned else {}),
        )
    share = np.array([n / of if of else np.nan for n, of in counts])
    sds = [next((sd for k, sd in SKIN_SD_M.items() if n.startswith(k)), OTHER_SD_M) for n in names]
    values: dict[str, Any] = {
        "depth_m": np.where(good, depth, 0),
        "count": good,
        "skin_m": np.where(good, skin, 0),
        "offset_sd_m": np.pad(sds, (0, markers - len(sds)), constant_values=OTHER_SD_M),
        "dispersion": dispersion,
    }
    packed: dict[str, Any] = {k: np.asarray(v, np.float32) for k, v in values.items()}
    own: Any = np.zeros(markers, np.float32), np.asarray(metre, np.float32)
    return dataclasses.replace(p, depths=Depths(**packed)), dataclasses.replace(start, surface=Surface(*own)), share


def _large(session: Session) -> np.ndarray:
    """(J,) bool: markers that are used."""
    named = [not n.startswith(LEFT_OUT) for n in session.markers.body_names]
    return np.array(named) & (np.asarray(session.markers.weight_3d) > 0)


def shares_of_floors(session: Session, p: Problem) -> Float[np.ndarray, "F Q"]:
    """Shares of the joints' least standard deviations that are left in each frame."""
    assert p.depths is not None
    count, names = np.asarray(p.depths.count), session.body.joint_names
    out = np.ones((len(count), len(names)))
    left = [next((share for k, share in FLOOR_SHARES.items() if n.startswith(k)), 1.0) for n in names]
    for i, arrays in enumerate(session.arrays):
        if count[session.frames(i)].sum() >= FLOOR_LEAST_USED * arrays.used.sum() * np.count_nonzero(_large(session)):
            out[session.frames(i)] = left
    return out


def depth_fit(
    session: Session, p: Problem, start: State, end: State, x: Float[Array, "F J 3"], share: np.ndarray, sd_m: float
) -> tuple[DepthFit | None, ...]:
    """The depths of each trial as a solution with markers at `x` finds them."""
    seen, surface = p.depths, end.surface
    assert seen is not None
    assert surface is not None
    assert start.surface is not None
    count, depth = np.asarray(seen.count) > 0, np.asarray(seen.depth_m, float)
    R, metre = np.asarray(end.R_nc, float)[:, 0, :, 2], float(surface.metre)
    z = np.einsum("fji,fi->fj", np.asarray(x, float) - np.asarray(p.p_nc, float), R)
    skin = np.asarray(seen.skin_m, float) + np.asarray(surface.offset_m, float)
    error = (z + skin - metre * depth) / sd_m
    found, joints = list[DepthFit | None](), np.count_nonzero(_large(session))
    distance = float(start.surface.metre) / session.metre
    for i, (arrays, own) in enumerate(zip(session.arrays, session.depths, strict=True)):
        e = error[session.frames(i)][count[session.frames(i)]]
        used, rms = len(e) / (arrays.used.sum() * joints), float(np.sqrt(np.mean(e**2))) if len(e) else np.nan
        found.append(own and DepthFit(own.name, own.sha256, float(used), float(share[i]), rms, distance, metre))
    return tuple(found)
