"""The keypoint methods."""

from __future__ import annotations

from pbl_pipeline import models
from pbl_pipeline.methods import Stage

from ._blazepose import HEAVY_SHA256, blazepose
from ._onnx_keypoints import ModelKeypointParams, model_keypoint_params, onnx
from ._params import KeypointParams


class RegisteredModels:
    """`Provider` of the keypoint methods: each registered keypoint model is one, under its own name."""

    def names(self) -> list[str]:
        return [m.name for m in models.registered()]

    def params(self, name: str) -> KeypointParams | None:
        return model_keypoint_params(name) if models.is_registered(name) else None


#: A family is a detector: a function from its parameters to a `KeypointDetector`.
METHODS: Stage[KeypointParams] = Stage("keypoints", "detector", "blazepose-33", RegisteredModels())
METHODS.register("blazepose-33", 2, KeypointParams(), blazepose)
METHODS.register("blazepose-heavy", 1, KeypointParams(model_sha256=HEAVY_SHA256, confidence_curve="blazepose-heavy-v1"))
METHODS.register_family("onnx", ModelKeypointParams, onnx)
