"""The methods of event detection. Each is one file beside this one and one line here."""

from __future__ import annotations

from typing import Any

from pbl_pipeline.methods import Stage

from ._foot_velocity import FootVelocityParams, detect_by_foot_velocity
from .coordinates import detect_by_coordinates
from .phase import PhaseParams, detect_by_phase
from .types import EventParams
from .walking import WalkingParams

#: The weights that ship with the package, and their checksum (docs/events.md says how they were made).
MODEL, MODEL_SHA256 = "phase-transformer-v1", "5df821c76563b25e459a6b5ed22bdba0c3f5a84432e74874dd8062119619ed50"

#: The function of a family takes `FootTrajectories` and the `Method`, and returns `GaitEvents`.
METHODS: Stage[Any] = Stage("gait", "family", "phase-transformer")
WALKING = WalkingParams(max_turn_deg_per_stride=30.0)
METHODS.register("phase-transformer", 3, PhaseParams(MODEL, MODEL_SHA256, WALKING, mirrored=True), detect_by_phase)
METHODS.register("zeni-2008", 1, EventParams(), detect_by_coordinates)
METHODS.register("oconnor-2007", 2, FootVelocityParams(), detect_by_foot_velocity)
