"""Checks that every event method requires: enough in view, legs as those of a standing person, walking forwards."""

from __future__ import annotations

import functools
import math

import numpy as np
from jaxtyping import Bool

from pbl_pipeline.bounded import MAX_SECONDS, span_s
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.gait.motion import FootTrajectories
from pbl_pipeline.results.events import SIDES
from pbl_pipeline.sampling import interval_of

from .network.predict import GRID_HZ, MAX_GAP_S, Grid, on_grid

#: Minimum hip height above the feet (leg lengths); below it the person is lying. Seated people have half a leg or more.
MIN_HIP_HEIGHT = 0.3
#: Height of the hips above the lower foot, as a share of thigh and shank together, below which a person is seated.
#: Walking, also crouched to 60 deg at the knee: 0.92 and more; on a chair 0.67 to 0.72 (5th percentiles of recorded and
#: synthetic motions).
SEATED_HEIGHT = 0.8
#: Skip detection if the person is seated in more than this fraction of frames.
SEATED_SHARE = 0.95
#: Cosine between the heading of the pelvis and its displacement, below which the person walks backwards.
BACKWARDS = -0.5
#: GAIT_INPUT for points that cannot be searched.
input_error = functools.partial(
    PblError, "GAIT_INPUT", next_step="correct the points or the axes; the overlay shows which leg is which"
)


def check_preconditions(feet: FootTrajectories, least_s: float) -> tuple[Grid | None, str, str]:
    """The legs on an even grid, and the reason and advice if they are not searched, else both empty.

    The grid is None if the legs' joints are not known (`legs_m` None; then only the direction of travel is checked) or
    are in view for less than `least_s`. Raises `PblError` GAIT_INPUT: joints upside down, mirrored or all at one place,
    or more than `MAX_SECONDS`.
    """
    grid, reason, advice = _grid(feet, least_s)
    if not reason and feet.heading_agreement < BACKWARDS:
        reason = "the person walks backwards: the events of walking forwards do not apply"
        advice = "if the person walked forwards, left and right are exchanged: look at the overlay"
    return grid, reason, advice


def _grid(feet: FootTrajectories, least_s: float) -> tuple[Grid | None, str, str]:
    if feet.legs_m is None:
        return None, "", ""
    time = np.asarray(feet.time_s, float)
    if len(time) < 4 or time[-1] - time[0] < least_s:
        return None, f"the person is in view for less than {least_s:g} s", "film at least three steps"
    step_s = interval_of(time)
    if span_s(time) > MAX_SECONDS:
        lasts = said("{s:.3g} s from the first to the last time stamp", s=span_s(time))
        raise input_error(lasts, f"at most {MAX_SECONDS:g} s of one recording: are the time stamps in seconds?")
    if step_s > MAX_GAP_S:
        why = f"frames {step_s:.3g} s apart: gait events cannot be seen in these"
        return None, why, "check that the time stamps are in seconds"
    grid = on_grid(time, feet.legs_m, feet.up)
    hips = grid.known[:, 0].all(axis=1)
    if np.count_nonzero(hips) < least_s * GRID_HZ or not math.isfinite(grid.leg_m):
        return None, f"hips and feet are seen for less than {least_s:g} s", "film the whole person"
    if not grid.leg_m > 0:
        raise input_error("hips, knees and feet at one place", "the joints of a person, in metres")
    for s, side in enumerate(SIDES):
        if not np.any(grid.known[hips, 2:, s]):
            return grid, f"the {side} foot is never seen", "film from where both legs are in view"
    height = check_upright(grid)
    if height < MIN_HIP_HEIGHT:
        why = f"the hips are {height:.2f} leg lengths above the feet: no one is standing"
        return grid, why, "nothing to do where the person lies or sits; else the vertical axis (z up) is another one"
    if np.mean(seated(grid)[hips]) > SEATED_SHARE:
        why = "the person sits: the hips are hardly ever as high above the lower foot as a standing person's"
        return grid, why, "feet that push a wheelchair or a stool along have no gait events"
    return grid, "", ""


def seated(grid: Grid) -> Bool[np.ndarray, " N"]:
    """Frames in which the person is seated, by `SEATED_HEIGHT`; none if hips, knees and ankles are never seen
    together."""
    x = np.where(grid.known[..., None], grid.joints_m, np.nan)
    leg = np.linalg.norm(np.diff(x[:, :3], axis=1), axis=-1).sum(axis=1)
    if not np.isfinite(leg).any():
        return np.zeros(len(x), bool)
    below = ((x[:, 0].mean(axis=1)[:, None, None] - x[:, 2:]) @ grid.up).reshape(len(x), -1)
    height = np.where(np.isfinite(below), below, -np.inf).max(axis=1)
    return np.isfinite(height) & (height < SEATED_HEIGHT * np.nanmedian(leg))


def check_upright(grid: Grid) -> float:
    """Height of the hips above the feet (leg lengths, median over frames and joints below the knee).

    Refuses legs that point up, and legs whose sides are exchanged or mirrored: then the feet, or the knees, point
    backwards against the heading of the hips. Raises `PblError` GAIT_INPUT.
    """
    known, x = grid.known, grid.joints_m
    hips = np.asarray(known[:, 0].all(axis=1))
    pelvis = x[:, 0].mean(axis=1)
    down = []
    for j in (2, 3, 4):
        use = hips[:, None] & known[:, j]
        down.append(((pelvis[:, None] - x[:, j]) @ grid.up)[use])
    height = float(np.median(np.concatenate(down))) / grid.leg_m
    if height < -0.1:
        raise input_error("feet above the hips", "points with the head up: is the vertical axis the right one?")
    if height < MIN_HIP_HEIGHT:
        return height
    toes = hips[:, None] & known[:, 3] & known[:, 4]
    if np.count_nonzero(toes) > 10:
        points = np.einsum("tsi,ti->ts", x[:, 4] - x[:, 3], grid.ahead)[toes] / grid.leg_m
        backwards = np.median(points) < -0.05
    else:
        legs = hips[:, None] & known[:, 1] & known[:, 2]
        line = 0.5 * (x[:, 0] + x[:, 2])
        bend = np.einsum("tsi,ti->ts", x[:, 1] - line, grid.ahead)[legs] / grid.leg_m
        backwards = len(bend) > 10 and np.mean(bend) < -0.02
    if backwards:
        raise input_error(
            "feet or knees that point backwards of where the hips face",
            "left and right as they are: points are mirrored, or the sides are exchanged",
        )
    return height
