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

    detector, model_sha256: the person detector and its model file. model, spec_sha256: name of the registered model
    folder and the hash of what its `model.json` says, both empty for an embedded one. min_score: detections below it
    are ignored.
    watch, association, uncross, join: see `WatchParams`, `AssociationParams`, `UncrossParams`, `JoinParams`. Gaps up to
    the association's `max_gap_s` are bridged (observed=False), after a longer one a new person begins, unless `join`
    finds that it is the same one; such a gap stays without boxes.
    cut_windows: a detector is shown windows cut from the planes of the decoded picture, square also at its edge (black
    beyond it); otherwise each is a part of the converted picture.
    exact_ends: a track begins and ends with the first and the last frame in which the person is found; otherwise with
    the first and last look of the schedule, up to a fifth of a second later and earlier.
    min_hits: a person must be seen surely (`sure_score` of the association) this often, and over `min_track_s`, or
    the track is dropped as false.
    """

    detector: str = "blazepose"
    model: str = ""
    model_sha256: str = MODEL_SHA256
    spec_sha256: str = ""
    min_score: float = 0.5
    min_hits: int = 3
    min_track_s: float = 0.25
    watch: WatchParams = dataclasses.field(default_factory=WatchParams)
    association: AssociationParams = dataclasses.field(default_factory=AssociationParams)
    uncross: UncrossParams = dataclasses.field(default_factory=UncrossParams)
    join: JoinParams = dataclasses.field(default_factory=JoinParams)
    cut_windows: bool = later(False)
    exact_ends: bool = later(False)
