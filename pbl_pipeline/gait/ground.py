"""Positions of the feet on the floor: stride length, step length and step width of a cycle."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pbl_pipeline.results.cycles import GaitCycle, Lengths
from pbl_pipeline.results.events import LEFT

from .motion import FootTrajectories

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: The part of a stride after its initial contact in which the foot lies flat (fraction of the stride).
FLAT_FROM, FLAT_TO = 0.08, 0.32
#: If the standing feet of a trial move over the floor at more than this fraction of their speed against the pelvis
#: (median), they do not stand: a treadmill's belt carries them, or the camera moves (1 and more for both; 0.2 at most
#: in fits of synthetic walkers). One foot alone may appear to: while the other leg passes, a detector can confuse the
#: two for a tenth of a second, which does not change a median place.
MAX_SLIDE = 0.6
#: Fewest frames of a standing foot.
_MIN_FRAMES = 3
FOLLOWS = "the phone moves while filming: where the feet are on the floor is not known"
SLIDES = "the standing foot slides over the floor: a treadmill, or a camera that moves"
UNSEEN = "too few frames of the standing foot"


def is_metric(fit: TrialFit) -> bool:
    """True if the metres of a fit were measured: by several calibrated cameras or a laboratory's markers."""
    return fit.orientation_source == "measured: calibration"


def why_no_lengths(fit: TrialFit) -> str:
    """Reason why a fit has no lengths on the floor; empty if it has (a camera that stands still, or no camera)."""
    return "" if fit.camera_motion == "static" else FOLLOWS


def cycle_lengths(
    feet: FootTrajectories, side: str, start_s: float, other_down_s: float, end_s: float, *, metric: bool, width: bool
) -> tuple[Lengths, float | None]:
    """Return the lengths of the cycle of `side` from `start_s` to `end_s`, and how its standing feet slide.

    The other foot comes down at `other_down_s`. The slide is the speed of the standing feet over the floor against that
    relative to the pelvis (median of the three), None without lengths.

    The place of a foot is the median of its heel over the frames in which it lies flat. With A and C the places of this
    foot at the start and the end and B the other's in between, all on the floor: stride length |C - A|, step length the
    part of C - B along A to C, step width the distance of B from that line (Huxham et al. 2006, Gait & Posture
    23:159-163), which also holds on a curved path. Positions must be in a fixed world. `metric`: of the result; without
    `width` the step width is left out: with one camera its error is too large a part of it.
    """
    stride_s = end_s - start_s
    own, other = (0, 1) if side == LEFT else (1, 0)
    places, slides = [], []
    for foot, down in ((own, start_s), (other, other_down_s), (own, end_s)):
        place, slide = _place(feet, foot, down, stride_s)
        if place is None:
            return Lengths(missing=UNSEEN), None
        places.append(place)
        slides.append(slide)
    a, b, c = places
    stride = float(np.linalg.norm(c - a))
    if not stride > 1e-6:
        return Lengths(missing=SLIDES), None
    along = (c - a) / stride
    step = float((c - b) @ along)
    across = float(np.linalg.norm((b - a) - ((b - a) @ along) * along))
    return Lengths(stride, step, across if width else None, metric=metric), float(np.median(slides))


def where_feet_stand(cycles: Sequence[GaitCycle], slides: Sequence[float | None]) -> list[GaitCycle]:
    """Return the cycles of a trial, without lengths where its standing feet slide (`MAX_SLIDE`).

    `slides`: of each cycle what `cycle_lengths` returned, None if it has no lengths.
    """
    known = [s for s in slides if s is not None]
    if not known or np.median(known) <= MAX_SLIDE:
        return list(cycles)
    sliding = Lengths(missing=SLIDES)
    return [c if s is None else dataclasses.replace(c, lengths=sliding) for c, s in zip(cycles, slides, strict=True)]


def _place(feet: FootTrajectories, foot: int, down_s: float, stride_s: float) -> tuple[np.ndarray | None, float]:
    """Place of a standing foot on the floor (3,), and its speed there against that relative to the pelvis."""
    time = np.asarray(feet.time_s, float)
    heel, pelvis = feet.heel_m[:, foot], feet.pelvis_m
    use = (time >= down_s + FLAT_FROM * stride_s) & (time <= down_s + FLAT_TO * stride_s)
    use &= np.isfinite(heel).all(axis=1) & np.isfinite(pelvis).all(axis=1)
    if np.count_nonzero(use) < _MIN_FRAMES:
        return None, 0.0
    floor = np.eye(3) - np.outer(feet.up, feet.up)
    at, here = heel[use] @ floor, (heel - pelvis)[use] @ floor
    moves, passes = (float(np.linalg.norm(np.polyfit(time[use], x, 1)[0])) for x in (at, here))
    return np.median(at, axis=0), moves / max(passes, 1e-6)
