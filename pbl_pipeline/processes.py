"""Processes beside this one, which begin with what they need already imported.

They are not forked from this process: threads of the numerical libraries do not survive that. On Linux they are copies
of a process that has only imported (`preload`), as `multiprocessing` offers it ("forkserver"); elsewhere each imports
for itself, which takes seconds of processor time.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from typing import Any

_preloaded: list[str] = []


def preload(*modules: str) -> None:
    """Let copies begin with these modules, which may not set the environment; without effect once there was a copy."""
    _preloaded.extend(modules)
    multiprocessing.set_forkserver_preload(list(_preloaded))


def context() -> Any:
    """Return the context of `multiprocessing` that makes processes."""
    return multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")


class InThisEnvironment:
    """A function for a process, called with the environment of now: a copy has that of the first one."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._environment = function, dict(os.environ)

    def __call__(self, *args: Any) -> Any:
        os.environ.clear()
        os.environ.update(self._environment)
        return self._function(*args)
