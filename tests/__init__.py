"""Tests of the product."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pytest

from pbl_pipeline.errors import PblError

T = TypeVar("T")

#: The fixture `environment`: sets variables for a test; None removes one.
Environment = Callable[..., None]
#: The development data beside the project.
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def not_none(value: T | None) -> T:
    """Return what has to be there."""
    assert value is not None
    return value


def refused(code: str, call: Callable[..., object], *arguments: Any, **named: Any) -> PblError:
    """Call a function and return its error, which has this code."""
    with pytest.raises(PblError) as error:
        call(*arguments, **named)
    assert error.value.code == code, error.value.text()
    return error.value


def until(condition: Callable[[], bool], seconds: float = 300.0) -> None:
    """Wait until something holds; fails after so many seconds. Also of a page: Playwright's own wait evaluates texts in
    it, which its policy forbids."""
    end = time.monotonic() + seconds
    while True:
        with contextlib.suppress(AssertionError):  # a command that a starting server does not answer yet
            if condition():
                return
        assert time.monotonic() < end, f"not within {seconds:g} s"
        time.sleep(0.05)
