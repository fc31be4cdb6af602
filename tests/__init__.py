"""Tests of the product."""

from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

#: The development data beside the project.
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def not_none(value: T | None) -> T:
    """Return what has to be there."""
    assert value is not None
    return value
