"""Heads over a video: where, and how surely; how they are searched, how large and how long."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.keypoints import KeypointParams
from pbl_pipeline.runs import runs
from pbl_pipeline.tracking import AssociationParams, TrackingParams, WatchParams


@dataclasses.dataclass(frozen=True)
class HeadParams:
    """Parameters of `find_heads`. Margins are tuned on the clips that docs/privacy.md names, and reported on others.

    tracking: finds smaller and less sure people than measuring asks for; a false one costs a blurred patch of wall.
    keypoints: those of all people, however briefly in view.
    head_radius_m: of the circle around the middle of the ears, in metres of the detector's own body; the vertex and the
    chin lie 0.13 m from there, hair and error come on top.
    head_face: the same as a multiple of the largest distance between two points of the face; the larger one counts.
    up, body_radius: where the body's upper end is taken to be, and its circle, in radii of the region of interest.
    agree: a head farther than this from `up`, in the same unit, disagrees.
    jump: so does one farther than this many head radii from where the frames around say.
    face_score, face_sure, face_gap_s: a face counts from this score, if its scores add up to `face_sure` with no longer
    gap between them (two sure sightings, three less sure ones).
    face_on_body: what the scores must add up to where the face lies on the body of a person whose head is known: knees
    and folds of cloth are taken for faces, and a blurred knee is not measured.
    face_interval_s, face_tiles, face_overlap: searched so often, on tiles of these fractions of the shorter side by
    turns.
    face_radius: of the circle, in sides of the face's box.
    hold_s, leave_s, bridge_s: a head is held so long before it is first and after it is last found; the same where it
    touches the edge of the picture, and a face without a body; and over gaps up to this.
    hold_growth: the circle grows meanwhile, by this many of its radii per second, to at most `hold_most` radii.
    """

    tracking: TrackingParams = dataclasses.field(
        default_factory=lambda: TrackingParams(
            min_score=0.4,
            min_hits=2,
            watch=WatchParams(tile_fraction=0.45, search_windows=3),
            association=AssociationParams(sure_score=0.5),
        )
    )
    keypoints: KeypointParams = dataclasses.field(default_factory=lambda: KeypointParams(min_time_s=0.0, sides=None))
    head_radius_m: float = 0.2
    head_face: float = 1.1
    up: float = 0.76
    body_radius: float = 0.42
    agree: float = 0.3
    jump: float = 0.5
    face_score: float = 0.6
    face_sure: float = 1.2
    face_on_body: float = 5.0
    face_gap_s: float = 0.5
    face_interval_s: float = 0.1
    face_tiles: tuple[float, ...] = (0.5, 0.25)
    face_overlap: float = 0.3
    face_radius: float = 1.1
    hold_s: float = 2.0
    leave_s: float = 0.5
    bridge_s: float = 2.0
    hold_growth: float = 1.0
    hold_most: float = 2.0


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
