"""The methods of tracking and of the choice of the subject."""

from __future__ import annotations

from pbl_pipeline import models
from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import Stage

from .associate import AssociationParams
from .blazepose import blazepose
from .detection_schedule import WatchParams
from .params import TrackingParams
from .walker_score import SubjectParams, choose_walker
from .yolox import yolox


class RegisteredDetectors:
    """`Provider` of the tracking methods: each registered person detector is a method with its name."""

    def names(self) -> list[str]:
        return [m.name for m in models.registered() if m.spec is not None and m.spec.kind == "person_detector"]

    def params(self, name: str) -> TrackingParams | None:
        return detector_params(name) if models.is_registered(name) else None


def detector_params(name: str) -> TrackingParams:
    """Return the parameters of tracking with a registered person detector (YOLOX) as it is now.

    Raises `PblError` MODEL_MISSING, and MODEL_INVALID for a model of another kind.
    """
    spec = models.load_spec(models.find(name))
    if spec.kind != "person_detector":
        raise PblError(
            "MODEL_INVALID",
            found=f"a model of the kind {spec.kind}",
            expected="kind person_detector",
            next_step="name a person detector (`pbl models list`)",
            key=name,
        )
    return TrackingParams(
        detector="yolox",
        model=name,
        model_sha256=spec.sha256,
        spec_sha256=spec.spec_sha256,
        # Its scores are lower than BlazePose's: 0.7 to 0.85 in the median over people in seven recordings.
        min_score=0.3,
        association=AssociationParams(sure_score=0.5),
    )


#: A family is a person detector: a function from `TrackingParams` to a `PersonDetector`.
METHODS: Stage[TrackingParams] = Stage("tracking", "detector", "blazepose-tiles", RegisteredDetectors())
METHODS.register(
    "blazepose-tiles",
    5,
    TrackingParams(cut_windows=True, exact_ends=True, watch=WatchParams(window_grid=1 / 16)),
    blazepose,
)
METHODS.register_family("yolox", TrackingParams, yolox)

#: A family is a way to choose: a function as `choose_walker`.
SUBJECT_METHODS: Stage[SubjectParams] = Stage("subject", "family", "walker")
SUBJECT_METHODS.register("walker", 2, SubjectParams(), choose_walker)
