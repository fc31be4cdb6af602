"""Association of detections over time into tracks.

Each live track predicts the position of its body (constant velocity); detections are assigned to predictions at the
least total cost (Hungarian algorithm, Kuhn 1955, scipy's `linear_sum_assignment`). All distances are in body sizes, so
that near and far people are treated alike.

No tracker library is used, as of November 2026: they expect a box in every frame at one rate; here a person is detected
when needed (`Watch`), by the container's time stamps, and both directions of time are used afterwards (`undo_swaps`,
`join_trails`). Of those on the package index `trackers` 2.6 (Apache-2.0) is well maintained, but brings 25 packages,
among them `opencv-python`, which overwrites the files of the headless OpenCV; `norfair` 2.3 requires numpy below 2;
`motpy` is at 0.0.10. On 240 simulated crossings at 15 frames a second (tests/unit/crossings.py: eight pairs of speeds,
three degrees of occlusion, ten seeds) identities were exchanged in 7 (SORT, ByteTrack), 5 (OC-SORT) and 3 (C-BIoU) with
`trackers`, in none with this module and `undo_swaps`; all kept one person who was hidden for about a second.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from .types import Detection

#: Distance (body heights) below which two states are of one person.
SAME_BODY = 0.25


@dataclasses.dataclass(frozen=True)
class AssociationParams:
    """Parameters of `Associator`."""

    gate: float = 0.35  # largest accepted cost, in body heights
    gate_per_s: float = 1.0  # widening of the gate per second unseen
    size_weight: float = 0.5  # cost of a size ratio of e (times the natural logarithm of the ratio)
    # Cost of a body axis turned by 90 degrees, twice that for one upside down: of two people who are close, the network
    # at times puts the head of one on the legs of the other.
    turn_weight: float = 0.25
    # Detections below it continue a track only within the unwidened gate and after the sure ones were assigned, and
    # never begin one.
    sure_score: float = 0.8
    max_gap_s: float = 1.0  # a person unseen for longer is lost, and starts a new track when seen again
    min_hits: int = 3  # a person seen fewer times is lost after `doubt_gap_s`
    doubt_gap_s: float = 0.35
    memory_s: float = 0.5  # the velocity is the slope of a straight line through this much of the past


@dataclasses.dataclass(eq=False)
class Trail:
    """A growing track: the frames in which a detector saw the person."""

    frames: list[int]
    times: list[float]
    detections: list[Detection]
    velocity: np.ndarray  # of (x, y) in body heights per s and of log size per s
    surprise: float = 0.0  # distance of the last sighting from its prediction, in body heights
    due_s: float = 0.0  # time of the next detection of the person

    @classmethod
    def of(cls, frame: int, time_s: float, detection: Detection) -> Trail:
        """Begin a trail, at rest."""
        return cls([frame], [time_s], [detection], np.zeros(3))

    @classmethod
    def of_parts(cls, *parts: Trail) -> Trail:
        """Concatenate trails that follow each other; the velocity is that of the last."""
        return cls(
            [f for p in parts for f in p.frames],
            [t for p in parts for t in p.times],
            [d for p in parts for d in p.detections],
            parts[-1].velocity,
        )

    def part(self, rows: slice) -> Trail:
        """The trail with some of its sightings."""
        return Trail(self.frames[rows], self.times[rows], self.detections[rows], self.velocity)

    @property
    def last_time(self) -> float:
        return self.times[-1]

    def state(self) -> np.ndarray:
        """Centre x, centre y in px and the natural logarithm of the height in px, when last seen."""
        return measure(self.detections[-1])

    def states(self, time_s: np.ndarray) -> np.ndarray:
        """(T, 3) states at times (T,) from the first sighting to the last, interpolated linearly in between."""
        first = int(np.searchsorted(self.times, time_s[0], "right")) - 1 if len(time_s) else 0
        last = int(np.searchsorted(self.times, time_s[-1])) + 1 if len(time_s) else 1
        seen = np.array([measure(d) for d in self.detections[max(first, 0) : last]])
        return interpolate(time_s, self.times[max(first, 0) : last], seen)

    def predict(self, time_s: float) -> np.ndarray:
        """The state at `time_s`. The velocity is trusted for a quarter of a second, then fades out."""
        dt = time_s - self.last_time
        reach = 0.25 * (1.0 - np.exp(-dt / 0.25))
        state = self.state()
        size = np.exp(state[2])
        return state + self.velocity * [size, size, 1.0] * reach

    def add(self, frame: int, time_s: float, detection: Detection, memory_s: float) -> None:
        new, old, expected = measure(detection), self.state(), self.predict(time_s)
        size = np.exp((new[2] + old[2]) / 2)
        self.surprise = float(np.hypot(*(new[:2] - expected[:2]))) / size
        self.frames.append(frame)
        self.times.append(time_s)
        self.detections.append(detection)
        self.velocity = self._velocity(memory_s)

    def _velocity(self, memory_s: float) -> np.ndarray:
        """Slope of a straight line through the last `memory_s` (at least the last two sightings).

        Sizes jitter by a tenth from frame to frame: their rate is noise, so only the position is extrapolated.
        """
        first = min(int(np.searchsorted(self.times, self.last_time - memory_s)), len(self.times) - 2)
        seen = np.array([measure(d) for d in self.detections[first:]])
        tau = np.array(self.times[first:]) - np.mean(self.times[first:])
        slope = tau @ seen[:, :2] / max(float(tau @ tau), 1e-9) / np.exp(seen[:, 2].mean())
        return np.array([*np.clip(slope, -5.0, 5.0), 0.0])


def interpolate(at_s: np.ndarray, time_s: Sequence[float], values: np.ndarray) -> np.ndarray:
    """(T, K) values at times (T,), linear between those (N, K) at times (N,)."""
    return np.stack([np.interp(at_s, time_s, v) for v in values.T], axis=-1)


def measure(detection: Detection) -> np.ndarray:
    """Centre x, centre y (px) and log height of a detection: of its region of interest if known, else of its box."""
    x, y, side, _ = detection.roi_px
    if np.isfinite(side) and side > 0:
        return np.array([x, y, np.log(side)])
    x0, y0, x1, y1 = detection.box_px
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, np.log(max(y1 - y0, 1.0))])


def heights_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two states (`measure`) in body heights."""
    return float(np.hypot(*(a[:2] - b[:2])) / np.exp((a[2] + b[2]) / 2))


def same_body(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two states (`measure`) of one frame are so close that both are of one person."""
    return heights_apart(a, b) < SAME_BODY


class Associator:
    """Assigns the detections of frames in order to tracks; `trails()` returns all, including the lost ones."""

    def __init__(self, params: AssociationParams) -> None:
        self._params = params
        self._live: list[Trail] = []
        self._lost: list[Trail] = []

    @property
    def live(self) -> list[Trail]:
        return self._live

    def forget(self, time_s: float) -> None:
        """End the tracks of people who have been unseen for too long at `time_s`."""
        p = self._params
        gone = [
            time_s - t.last_time > (p.max_gap_s if len(t.frames) >= p.min_hits else p.doubt_gap_s) for t in self._live
        ]
        self._lost += [t for t, g in zip(self._live, gone, strict=True) if g]
        self._live = [t for t, g in zip(self._live, gone, strict=True) if not g]

    def begin(self, trail: Trail) -> None:
        """Add a new trail."""
        self._live.append(trail)

    def step(
        self, frame: int, time_s: float, detections: list[Detection], among: Sequence[Trail] | None = None
    ) -> list[Detection]:
        """Assign the detections of one frame to the live tracks (of `among`); return the sure ones that fit none."""
        p = self._params
        self.forget(time_s)
        live = [t for t in self._live if among is None or t in among]
        sure = [d for d in detections if d.score >= p.sure_score]
        weak = [d for d in detections if d.score < p.sure_score]
        new = self._assign(live, sure, frame, time_s, p.gate_per_s)
        waiting = [t for t in live if t.frames[-1] != frame]
        self._assign(waiting, weak, frame, time_s, 0.0)
        return new

    def _assign(
        self, trails: list[Trail], detections: list[Detection], frame: int, time_s: float, gate_per_s: float
    ) -> list[Detection]:
        """Add detections to the trails at the least total cost; return those that fit none."""
        if not trails or not detections:
            return detections
        cost = np.array([[pair_cost(t, time_s, d, self._params) for d in detections] for t in trails])
        gate = np.array([self._params.gate + gate_per_s * (time_s - t.last_time) for t in trails])
        # An impossible pair costs more than any number of possible ones, so it is chosen only if no other is left.
        # A detection near another track's predicted position does not extend a missed track.
        expected = cost <= self._params.gate
        absent = [t for t in self._live if t not in trails]
        of_absent = [
            any(pair_cost(t, time_s, d, self._params) <= self._params.gate for t in absent) for d in detections
        ]
        of_other = (expected.sum(axis=0) + of_absent > expected) & ~expected
        blocked = np.where((cost > gate[:, None]) | of_other, 1e3, cost)
        taken = set()
        for i, j in zip(*linear_sum_assignment(blocked), strict=True):
            if blocked[i, j] < 1e3:
                trails[i].add(frame, time_s, detections[j], self._params.memory_s)
                taken.add(int(j))
        return [d for j, d in enumerate(detections) if j not in taken]

    def trails(self) -> list[Trail]:
        """All tracks in order of appearance."""
        return sorted([*self._lost, *self._live], key=lambda t: (t.frames[0], -t.detections[0].score))


def pair_cost(trail: Trail, time_s: float, detection: Detection, params: AssociationParams) -> float:
    """Cost of continuing a trail with a detection at `time_s`, in body heights."""
    predicted, seen = trail.predict(time_s), measure(detection)
    turn = detection.roi_px[3] - trail.detections[-1].roi_px[3]
    turned = 1.0 - float(np.cos(turn)) if np.isfinite(turn) else 0.0
    grown = abs(float(seen[2] - predicted[2]))
    return heights_apart(seen, predicted) + params.size_weight * grown + params.turn_weight * turned
