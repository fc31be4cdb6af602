"""Heads over a video: where, and how surely."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.runs import runs

#: How the circle of a head in a frame was obtained, by its number in `Head.source`: keypoints and faces are certain
#: enough to need no look of a person.
SOURCES = ("none", "keypoints", "face", "disagree", "body", "held")
NONE, KEYPOINTS, FACE, DISAGREE, BODY, HELD = range(len(SOURCES))
#: Why a frame is not certain -> what a person is told.
REASONS: dict[str, str] = {
    "no_head": "no head was found in the frame",
    "held": "a head was not found; its place is carried over from frames before and after",
    "body": "the points of a head were not found; its place is that of the body's upper end",
    "disagree": "the points of a head do not lie where the body, or the frames around, say",
    "overlap": "one person is in front of another",
}


@dataclasses.dataclass(frozen=True)
class Head:
    """One head over the T frames of a video.

    circle_px (T, 3): centre x, y and radius in px of the upright frame, around all of the head with hair and margin;
    NaN where there is none. also_px (T, 3): a second one, in frames in which the first is in doubt. source (T,) uint8:
    numbers of `SOURCES`. body_px (T, J, 2) and body_names: the person's
    keypoints, for drawing; None for a face without a body. box_px (T, 4): x0, y0, x1, y1 of the person, or NaN.
    """

    circle_px: np.ndarray
    source: np.ndarray
    box_px: np.ndarray
    body_px: np.ndarray | None = None
    body_names: tuple[str, ...] = ()
    also_px: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class Heads:
    """All heads of a video with T frames: time_s (T,), size (width, height) in px, one `Head` per person or face."""

    time_s: np.ndarray
    image_size_px: tuple[int, int]
    heads: tuple[Head, ...]

    def circles(self, index: int, spread_s: float = 0.0) -> list[np.ndarray]:
        """For each head that is there: its circles (N, 3) in the frames within `spread_s` of frame `index`, so that
        one frame's error uncovers nothing. A head that is only in other frames counts."""
        first, last = np.searchsorted(self.time_s, self.time_s[index] + np.array([-1.0, 1.0]) * (spread_s + 1e-9))
        first, last = int(first), max(int(last), index + 1)
        found = []
        for head in self.heads:
            rows = head.circle_px[first:last]
            if head.also_px is not None:
                rows = np.concatenate([rows, head.also_px[first:last]])
            rows = rows[np.isfinite(rows).all(axis=1)]
            if len(rows):
                found.append(rows)
        return found

    def reasons(self) -> list[tuple[str, ...]]:
        """For each frame why it is not certain, names of `REASONS`; empty where it is."""
        names: list[set[str]] = [set() for _ in self.time_s]
        seen = np.zeros(len(self.time_s), bool)
        width, height = self.image_size_px
        for head in self.heads:
            seen |= head.source != NONE
            inside = np.zeros(len(seen), bool)
            for circle in (head.circle_px, head.also_px):
                if circle is not None:
                    x, y, r = circle.T
                    inside |= (x + r > 0) & (x - r < width) & (y + r > 0) & (y - r < height)
            for number, name in ((DISAGREE, "disagree"), (BODY, "body"), (HELD, "held")):
                for t in np.flatnonzero((head.source == number) & inside):
                    names[t].add(name)
        for t in np.flatnonzero(overlapping(self.heads)) if len(self.heads) > 1 else ():
            names[t].add("overlap")
        for t in np.flatnonzero(~seen):
            names[t].add("no_head")
        return [tuple(r for r in REASONS if r in found) for found in names]


def overlapping(heads: Sequence[Head]) -> np.ndarray:
    """(T,) bool: frames in which the centre of one person's head lies within the box of another person."""
    found = np.zeros(len(heads[0].source), bool)
    for head in heads:
        x, y, _ = head.circle_px.T
        for other in heads:
            if other is not head and head.body_px is not None and other.body_px is not None:
                x0, y0, x1, y1 = other.box_px.T
                found |= (x > x0) & (x < x1) & (y > y0) & (y < y1)
    return found


def ranges(flags: Sequence[bool] | np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True."""
    return [(run.start, run.stop - 1) for run in runs(flags)]
