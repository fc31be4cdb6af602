"""Parameters of tracking."""

from __future__ import annotations

import dataclasses

from pbl_pipeline.paramset import later

from .associate import AssociationParams
from .detection_schedule import WatchParams
from .identity_swaps import UncrossParams
from .reidentify import JoinParams

#: BlazePose's person detector.
MODEL_SHA256 = "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c"


@dataclasses.dataclass(frozen=True)
class TrackingParams:
    """Parameters of `track_people`.

    Gaps up to the association's `max_gap_s` are bridged (observed=False). After a longer gap a new person begins,
    unless `join` finds that it is the same one; such a gap stays without boxes.
    """

    detector: str = "blazepose"
    model: str = ""  # name of the registered model, "" for an embedded one
    model_sha256: str = MODEL_SHA256
    spec_sha256: str = ""  # hash of the content of the registered model's `model.json`
    min_score: float = 0.5  # detections below it are ignored
    # A track with fewer sure detections (`sure_score` of the association), or shorter than `min_track_s`, is dropped.
    min_hits: int = 3
    min_track_s: float = 0.25
    watch: WatchParams = dataclasses.field(default_factory=WatchParams)
    association: AssociationParams = dataclasses.field(default_factory=AssociationParams)
    uncross: UncrossParams = dataclasses.field(default_factory=UncrossParams)
    join: JoinParams = dataclasses.field(default_factory=JoinParams)
    # Windows are cut from the planes of the decoded picture, square also at its edge (black beyond it); otherwise they
    # are parts of the converted picture.
    cut_windows: bool = later(False)
    # A track begins and ends with the first and the last frame in which the person is found; otherwise with the first
    # and last detection of the schedule, up to a fifth of a second later and earlier.
    exact_ends: bool = later(False)
