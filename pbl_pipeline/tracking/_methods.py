"""Tracking methods by name: the embedded one, and the registered person detectors of this machine."""

from __future__ import annotations

from pbl_pipeline import models
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset

from ._associate import AssociationParams
from ._track import DEFAULT, PARAMSETS, TrackingParams


def find_method(name: str | None = None) -> Paramset:
    """The method of that name: one of `PARAMSETS` (None: the default), or the registered detector as it is now.

    Raises `PblError` SOLVER_UNKNOWN, and MODEL_INVALID for a registered model that is no person detector.
    """
    if name is None or name in PARAMSETS:
        return PARAMSETS[name or DEFAULT]
    if models.is_registered(name):
        return method_of_detector(name)
    there = [m.name for m in models.registered() if m.spec is not None and m.spec.kind == "person_detector"]
    raise PblError(
        "SOLVER_UNKNOWN",
        found=f"no tracking method {name!r}",
        expected=f"one of {', '.join([*PARAMSETS, *there])}",
        next_step="choose one of the names above, or add a person detector with `pbl models add`",
    )


def method_of_detector(name: str, version: int = 1) -> Paramset:
    """The tracking method of a registered person detector (YOLOX), under its own name.

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
    params = TrackingParams(
        detector="yolox",
        model=name,
        model_sha256=spec.sha256,
        spec_sha256=spec.spec_sha256,
        # Its scores are lower than BlazePose's: 0.7 to 0.85 in the median over people in seven recordings.
        min_score=0.3,
        association=AssociationParams(sure_score=0.5),
    )
    return Paramset.of("tracking", name, version, params)
