"""Heads over a video with their certainty, and the parameters of finding them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pbl_pipeline.keypoints import KeypointParams
from pbl_pipeline.tracking import AssociationParams, TrackingParams, WatchParams


@dataclasses.dataclass(frozen=True)
class HeadParams:
    """Parameters of `find_heads`. Margins were tuned on some clips and tested on others (`research/heads`)."""

    # Finds smaller and less certain people than measuring needs; a false one only blurs a patch of wall.
    tracking: TrackingParams = dataclasses.field(
        default_factory=lambda: TrackingParams(
            min_score=0.4,
            min_hits=2,
            watch=WatchParams(tile_fraction=0.45, search_windows=3),
            association=AssociationParams(sure_score=0.5),
        )
    )
    # Of all people, however briefly in view.
    keypoints: KeypointParams = dataclasses.field(default_factory=lambda: KeypointParams(min_time_s=0.0, sides=None))
    # Radius of the circle around the middle of the ears, in metres of the detector's body; the vertex and the chin are
    # 0.13 m from there, and hair and error are added.
    head_radius_m: float = 0.2
    head_face: float = 1.1  # the same over the largest distance between two points of the face; the larger one is used
    up: float = 0.76  # distance of the body's upper end from its middle, in radii of the region of interest,
    body_radius: float = 0.42  # and the radius of its circle
    agree: float = 0.3  # a head farther than this from the upper end, in the same unit, disagrees,
    jump: float = 0.5  # and so does one farther than this many head radii from the heads in the frames around
    face_score: float = 0.6  # least score of a sighting
    face_sure: float = 1.2  # least sum of the scores of a face (two certain sightings, three less certain ones)
    # The same for a face on the body of a person whose head is known: knees and folds of cloth are taken for faces, and
    # a blurred knee is not measured.
    face_on_body: float = 5.0
    face_gap_s: float = 0.5  # longest gap between sightings of one face
    face_interval_s: float = 0.1  # interval of the frames that are searched
    face_tiles: tuple[float, ...] = (0.5, 0.25)  # sides of the tiles over the shorter side of the picture, in turn
    face_overlap: float = 0.3
    face_radius: float = 1.1  # radius of the circle, in sides of the face's box
    hold_s: float = 2.0  # time for which a head is held before it is first and after it is last found
    leave_s: float = 0.5  # the same if it touches the edge of the picture, and for a face without a body
    bridge_s: float = 2.0  # longest gap over which a head is interpolated
    hold_growth: float = 1.0  # growth of a held circle per second, in its radii,
    hold_most: float = 2.0  # and its largest size


#: Origins of the circle of a head in a frame, as numbers in `Head.source`. Keypoints and faces are certain enough not
#: to be reviewed.
NONE, KEYPOINTS, FACE, DISAGREE, BODY, HELD = range(6)
#: Reason why a frame is not certain -> its text.
REASONS: dict[str, str] = {
    "no_head": "no head was found in the frame",
    "held": "a head was not found; its place is carried over from frames before and after",
    "body": "the points of a head were not found; its place is that of the body's upper end",
    "disagree": "the points of a head do not lie where the body, or the frames around, say",
    "overlap": "one person is in front of another",
}


@dataclasses.dataclass(frozen=True)
class Head:
    """One head over the T frames of a video."""

    #: (T, 3) centre x, y and radius in px of the upright frame, around the whole head with hair and margin, or NaN
    circle_px: np.ndarray
    source: np.ndarray  # (T,) uint8: `NONE`, `KEYPOINTS`, ...
    box_px: np.ndarray  # (T, 4) x0, y0, x1, y1 of the person, or NaN
    body_px: np.ndarray | None = None  # (T, J, 2) the person's keypoints, for drawing; None for a face without a body
    body_names: tuple[str, ...] = ()  # J
    also_px: np.ndarray | None = None  # (T, 3) a second circle, in frames in which the first is in doubt


@dataclasses.dataclass(frozen=True)
class Heads:
    """All heads of a video with T frames: time_s (T,), size (width, height) in px, one `Head` per person or face."""

    time_s: np.ndarray
    image_size_px: tuple[int, int]
    heads: tuple[Head, ...]

    def circles(self, index: int, spread_s: float = 0.0) -> list[np.ndarray]:
        """Circles (N, 3) of each head in the frames within `spread_s` of frame `index`, so that an error in one frame
        uncovers nothing."""
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
        """Reasons why each frame is not certain, names of `REASONS`; empty if it is."""
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
