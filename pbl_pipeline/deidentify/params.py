"""What is looked for, how large a head is taken to be, and how long it is held."""

from __future__ import annotations

import dataclasses

from pbl_pipeline.keypoints import KeypointParams
from pbl_pipeline.tracking import AssociationParams, TrackingParams, WatchParams


@dataclasses.dataclass(frozen=True)
class HeadParams:
    """Parameters of `find_heads`. Margins are tuned on the clips that docs/privacy.md names, and reported on others.

    tracking: finds smaller and less sure people than measuring asks for; a false one costs a blurred patch of wall.
    keypoints: those of everybody, however briefly in view.
    head_radius_m: of the circle around the middle of the ears, in metres of the detector's own body; the vertex and the
    chin lie 0.13 m from there, hair and error come on top.
    head_face: the same as a multiple of the largest distance between two points of the face; the larger one counts.
    up, body_radius: where the body's upper end is taken to be, and its circle, in radii of the region of interest.
    agree: a head farther than this from `up`, in the same unit, disagrees.
    jump: so does one farther than this many head radii from where the frames around say.
    face_score, face_sure, face_gap_s: a face counts from this score, if its scores add up to `face_sure` with no longer
    gap between them (two sure sightings, three less sure ones).
    face_on_body: what the scores must add up to where the face lies on the body of somebody whose head is known: knees
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
