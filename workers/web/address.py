"""Numbers in addresses, and an interval as pages show it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starlette.requests import Request

if TYPE_CHECKING:
    from schemas.reading.visit_list import Result

#: Largest number of a row: DataJoint's int32.
LARGEST = 2**31 - 1


def number_of(request: Request) -> int:
    """The number in the address; one that no row can have becomes 0, which none has."""
    number = int(request.path_params["number"])
    return number if number <= LARGEST else 0


def shown_of(request: Request) -> int:
    """Which result of a visit is asked for; one that none can be becomes `LARGEST`, which none has."""
    asked = request.query_params.get("result", "0")
    return int(asked) if asked.isdecimal() and len(asked) < 4 else LARGEST


def interval(result: Result) -> str:
    """ "78 to 87" as numbers; empty where the error of the index is not known."""
    from pbl_pipeline.gait import interval_90

    bounds = interval_90(result.index, result.sd)
    return "" if bounds is None else f"{bounds[0]:.0f}\N{EN DASH}{bounds[1]:.0f}"
