"""Detection of initial contact and toe-off from the vertical speed of the middle of the foot."""

from __future__ import annotations

import dataclasses

import numpy as np

from pbl_pipeline.gait.motion import FootTrajectories
from pbl_pipeline.methods import Method
from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, SIDES, GaitEvents

from ._preconditions import check_preconditions
from .coordinates import Extremum, detect_by_extrema, forward_signals, prominence
from .signal import Segment, refine_extremum
from .types import EventParams, no_events


@dataclasses.dataclass(frozen=True)
class FootVelocityParams(EventParams):
    """Parameters of the foot-velocity detector, in addition to those of the coordinate-based one.

    min_speed_leg_per_s
        Smallest extremum of the vertical speed that counts, in leg lengths per second. The foot sinks with only 0.15 to
        0.3 m/s where it meets the floor.
    max_heel_share
        At initial contact the heel is below this fraction of its range of heights.
    """

    cutoff_hz: float = 7.0
    min_speed_leg_per_s: float = 0.10
    max_heel_share: float = 0.35


def detect_by_foot_velocity(feet: FootTrajectories, method: Method[FootVelocityParams]) -> GaitEvents:
    """Initial contact and toe-off from the vertical speed of the middle between heel and toe.

    Method: O'Connor, Thorpe, O'Malley, Vaughan 2007, Gait & Posture 25:469-474. Toe-off is where the speed is
    greatest upwards; initial contact where it is greatest downwards while the heel is in the lowest 35 % of its range.
    The signals are low-passed at 7 Hz as there. Heights are against the pelvis, so that a camera that moves does not
    matter; the pelvis' own movement of a few cm is part of them. Order and cadence are then checked as for `zeni-2008`,
    and `probability` is as there.

    Raises `PblError` GAIT_INPUT as there.
    """
    p = method.params
    _, reason, advice = check_preconditions(feet, p.min_segment_s)
    if reason:
        return no_events(method.name, method.hash, feet.source, reason, advice)
    x, leg = forward_signals(feet, p)
    heel = (np.asarray(feet.heel_m, float) - feet.pelvis_m[:, None]) @ feet.up
    toe = (np.asarray(feet.toe_m, float) - feet.pelvis_m[:, None]) @ feet.up
    lowest, highest = np.nanpercentile(heel, [2, 98], axis=0)

    def extrema(segment: Segment) -> list[Extremum]:
        from scipy.signal import find_peaks  # takes longer to import than most commands run

        found = []
        step = segment.time_s[1] - segment.time_s[0]
        window = int(2 * 60 / p.min_cadence_per_min * p.grid_hz) | 1
        for s, side in enumerate(SIDES):
            height = segment.values[:, 4 + s]
            fraction = (height - lowest[s]) / max(highest[s] - lowest[s], 1e-9)
            speed = np.gradient(0.5 * (height + segment.values[:, 6 + s]), step)
            for event, signal in ((FOOT_UP, speed), (FOOT_DOWN, -speed)):
                at, about = find_peaks(signal, prominence=p.min_speed_leg_per_s * leg, wlen=window)
                for k, i in enumerate(at):
                    if event == FOOT_DOWN and fraction[i] > p.max_heel_share:
                        continue
                    size = prominence(signal, i, int(about["left_bases"][k]), int(about["right_bases"][k]))
                    found.append(Extremum(refine_extremum(segment.time_s, signal, i), side, event, size))
        return found

    return detect_by_extrema(
        feet, method, np.concatenate([x, heel, toe], axis=1), leg, extrema, p.min_speed_leg_per_s * leg
    )
