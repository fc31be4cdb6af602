"""The methods of tracking and of the choice of the subject."""

from __future__ import annotations

from pbl_pipeline.methods import Stage

from .blazepose import blazepose
from .params import TrackingParams
from .registered_detectors import RegisteredDetectors
from .walker_score import SubjectParams, choose_walker
from .yolox import yolox

#: A family is a person detector: a function from `TrackingParams` to a `PersonDetector`.
METHODS: Stage[TrackingParams] = Stage("tracking", "detector", "blazepose-tiles", RegisteredDetectors())
METHODS.register("blazepose-tiles", 2, TrackingParams(), blazepose)
METHODS.register_family("yolox", TrackingParams, yolox)

#: A family is a way to choose: a function as `choose_walker`.
SUBJECT_METHODS: Stage[SubjectParams] = Stage("subject", "family", "walker")
SUBJECT_METHODS.register("walker", 2, SubjectParams(), choose_walker)
