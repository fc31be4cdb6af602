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
#: The fixture `limits`: constants of a module for a test, by their names; ends with its `with`, else with the test.
Limits = Callable[..., contextlib.ExitStack]
#: The fixture `machine`: what the machine has; ends likewise.
Machine = Callable[..., contextlib.ExitStack]
#: The fixture `stand_in`: functions that stand in for stages of the chain, by their names.
StandIn = Callable[..., None]
#: The development data beside the project.
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


class Calls(list[tuple[Any, ...]]):
    """Arguments of the calls of a function that fails (fixture `faults`), which ends with its `with`, else with the
    test."""

    def __init__(self, end: contextlib.ExitStack) -> None:
        super().__init__()
        self._end = end

    def __enter__(self) -> "Calls":
        return self

    def __exit__(self, *_: object) -> None:
        self._end.close()


#: The fixture `faults`.
Faults = Callable[..., Calls]


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
