"""The named methods of event detection: frozen parameters."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset

from ._foot_velocity import FootVelocityParams
from ._types import EventParams

EVENT_PARAMSETS: dict[str, Paramset] = {
    "zeni-2008": Paramset.of("gait", "zeni-2008", 1, EventParams()),
    "oconnor-2007": Paramset.of("gait", "oconnor-2007", 1, FootVelocityParams()),
}
DEFAULT_EVENT_PARAMSET = "zeni-2008"


def resolve_params(params: Any) -> Paramset:
    """The paramset that is meant. Raises `PblError` SOLVER_UNKNOWN for a name that does not exist."""
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
    if not isinstance(params, str) or params not in EVENT_PARAMSETS:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"event method {params!r}",
            expected=f"one of {', '.join(EVENT_PARAMSETS)}",
            next_step="name one of these",
        )
    return EVENT_PARAMSETS[params]
