"""The named methods of event detection: frozen parameters."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset

from ._foot_velocity import FootVelocityParams
from ._phase import PhaseParams
from ._types import EventParams

#: The weights that ship with the package, and their checksum (docs/events.md says how they were made).
MODEL, MODEL_SHA256 = "phase-transformer-v1", "5df821c76563b25e459a6b5ed22bdba0c3f5a84432e74874dd8062119619ed50"

EVENT_PARAMSETS: dict[str, Paramset] = {
    "phase-transformer": Paramset.of("gait", "phase-transformer", 1, PhaseParams(MODEL, MODEL_SHA256)),
    "zeni-2008": Paramset.of("gait", "zeni-2008", 1, EventParams()),
    "oconnor-2007": Paramset.of("gait", "oconnor-2007", 2, FootVelocityParams()),
}
DEFAULT_EVENT_PARAMSET = "phase-transformer"


def resolve_params(params: Any) -> Paramset:
    """The paramset that is meant: a name, also with its version (`zeni-2008-v1`), a paramset, a method's own
    parameters, None for the default. Raises `PblError` SOLVER_UNKNOWN for a name that does not exist."""
    if params is None:
        return EVENT_PARAMSETS[DEFAULT_EVENT_PARAMSET]
    if isinstance(params, Paramset):
        return params
    if dataclasses.is_dataclass(params) and not isinstance(params, type):
        plain = dataclasses.asdict(params)
        base = ""
        for name, known in EVENT_PARAMSETS.items():
            if dict(known.params) == plain:
                return known
            base = base or (name if set(known.params) == set(plain) else "")
        return Paramset("gait", f"{base or type(params).__name__}-custom", 1, plain)
    by_name = EVENT_PARAMSETS | {f"{p.name}-v{p.version}": p for p in EVENT_PARAMSETS.values()}
    if not isinstance(params, str) or params not in by_name:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"event method {params!r}",
            expected=f"one of {', '.join(EVENT_PARAMSETS)}",
            next_step="name one of these",
        )
    return by_name[params]
