"""An iterator that works ahead in a separate thread, for sources that release Python's lock (decoding does)."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator, Iterable
from typing import TypeVar

T = TypeVar("T")
_END = object()
_POLL_S = 0.1


def prefetched(source: Iterable[T], n: int) -> Generator[T, None, None]:
    """The items of `source`, of which up to `n` are ready before they are asked for.

    Errors of `source` are raised here, after the items before them. When the caller stops early, the thread ends before
    this iterator does.
    """
    ready: queue.Queue[object] = queue.Queue(n)
    stop = threading.Event()
    raised: list[BaseException] = []

    def put(item: object) -> bool:
        while not stop.is_set():
            try:
                ready.put(item, timeout=_POLL_S)
                return True
            except queue.Full:
                continue
        return False

    def work() -> None:
        try:
            for item in source:
                if not put(item):
                    return
        except BaseException as error:  # noqa: BLE001 - raised where the items are asked for
            raised.append(error)
        finally:
            put(_END)

    thread = threading.Thread(target=work, name="prefetch", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not _END:
            yield item  # type: ignore[misc]
        if raised:
            raise raised[0]
    finally:
        stop.set()
        thread.join()
