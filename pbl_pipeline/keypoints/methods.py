"""The keypoint methods."""

from __future__ import annotations

import dataclasses

from pbl_pipeline import models
from pbl_pipeline.methods import Stage

from .blazepose import HEAVY_SHA256, blazepose
from .onnx_keypoints import ModelKeypointParams, model_keypoint_params, onnx
from .protocol import KeypointParams


class RegisteredModels:
    """`Provider` of the keypoint methods: each registered keypoint model is a method with its name."""

    def names(self) -> list[str]:
        return [m.name for m in models.registered()]

    def params(self, name: str) -> KeypointParams | None:
        return model_keypoint_params(name) if models.is_registered(name) else None


#: A family is a detector: a function from its parameters to a `KeypointDetector`.
METHODS: Stage[KeypointParams] = Stage("keypoints", "detector", "blazepose-heavy", RegisteredModels())
#: Both refine the points by the networks' heat maps.
METHODS.register(
    "blazepose-33", 4, KeypointParams(confidence_curve="blazepose-v2", crop_step_px=0.25, window_cells=1.5), blazepose
)
#: Shares inferences at 24 frames/s and more: each is slow, and those of two neighbouring frames differ little.
_HEAVY = KeypointParams(
    model_sha256=HEAVY_SHA256,
    share_looks_s=0.042,
    confidence_curve="blazepose-heavy-v4",
    lighter_first=True,
    crop_step_px=0.25,
    window_cells=1.5,
)
METHODS.register("blazepose-heavy", 5, _HEAVY)
#: A recording at 60 frames/s as if it was filmed at 30.
METHODS.register("blazepose-heavy-30hz", 1, dataclasses.replace(_HEAVY, interval_s=1 / 30))
METHODS.register_family("onnx", ModelKeypointParams, onnx)
