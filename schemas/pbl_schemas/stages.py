"""The modules of tables by name; they are imported on request only."""

from __future__ import annotations

import importlib
from types import ModuleType

#: Modules of tables, each its own schema on the server, in the order of dependency.
STAGES = (
    "lab",
    "session",
    "video",
    "capture",
    "tracking",
    "keypoints",
    "fit",
    "gait",
    "gdi",
    "qc",
    "kinetics",
    "validation",
    "privacy",
    "study",
    "review",
    "worker",
)


def modules() -> list[ModuleType]:
    """The table modules, imported."""
    return [importlib.import_module(f"pbl_schemas.{stage}") for stage in STAGES]
