"""Progress of long steps. The library stays silent until a command switches it on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")
_enabled = False
_told: Callable[[int, int | None], None] | None = None


def tell(function: Callable[[int, int | None], None] | None) -> None:
    """Register a function to be called after each item of `track` with the number done and the total; None: none."""
    global _told
    _told = function


def enable(on: bool = True) -> None:
    """Switch progress bars on (commands do; libraries, workers and tests do not)."""
    global _enabled
    _enabled = on


def enabled() -> bool:
    """True if bars are drawn."""
    return _enabled


def note(text: str) -> None:
    """Print a line on stderr when enabled, for what takes time before the first bar."""
    if _enabled:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


def track(items: Iterable[T], label: str, total: int | None = None, unit: str = "frame") -> Iterator[T]:
    """Iterate over `items`, drawing a bar on stderr when enabled. `total` may be unknown."""
    bar = tqdm(items, desc=label, total=total, unit=unit, disable=not _enabled, **_style())
    return iter(bar) if _told is None else _telling(bar, total, _told)


def _telling(items: Iterable[T], total: int | None, told: Callable[[int, int | None], None]) -> Iterator[T]:
    for done, item in enumerate(items):
        told(done, total)
        yield item


@contextmanager
def bar(label: str, total: int | None = None, unit: str = "step") -> Iterator[Callable[..., None]]:
    """A bar for work that is not an iteration; yields `update(n=1, note="", total=None)`; `total` changes the total."""
    with tqdm(desc=label, total=total, unit=unit, disable=not _enabled, **_style()) as b:

        def update(n: int = 1, note: str = "", total: int | None = None) -> None:
            b.total = b.total if total is None else total
            if note:
                b.set_postfix_str(note, refresh=False)
            b.update(n)

        yield update


def _style() -> dict:
    # A terminal is redrawn twice a second; a log file gets a line every ten.
    return {"mininterval": 0.5 if sys.stderr.isatty() else 10.0, "dynamic_ncols": True, "smoothing": 0.1}
