"""Keypoint methods by name: those of the project, and the registered models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pbl_pipeline import models
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset

from ._detect import DEFAULT, PARAMSETS, KeypointParams
from ._onnx_keypoints import ModelKeypointParams, method_of_model


def find_method(name: str | None = None) -> Paramset:
    """The method of that name: one of `PARAMSETS` (None: the default), or the registered model as it is now.

    Raises
    ------
    PblError
        SOLVER_UNKNOWN; for a registered model MODEL_INVALID, MARKER_SET_UNKNOWN.
    """
    if name is None or name in PARAMSETS:
        return PARAMSETS[name or DEFAULT]
    if models.is_registered(name):
        return method_of_model(name)
    known = [*PARAMSETS, *(m.name for m in models.registered())]
    raise PblError(
        "SOLVER_UNKNOWN",
        found=f"no keypoint method {name!r}",
        expected=f"one of {', '.join(known)}",
        next_step="choose one of the names above, or add a model with `pbl models add`",
    )


def params_class(params: Mapping[str, Any]) -> type[KeypointParams]:
    """The class of stored parameters: those of a registered model have more fields."""
    return ModelKeypointParams if "model" in params else KeypointParams


def params_of(paramset: Paramset) -> KeypointParams:
    """The parameters of a keypoint method."""
    return paramset.to(params_class(paramset.params))
