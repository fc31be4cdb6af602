"""A stand-in for a process of `multiprocessing` that has ended as soon as it was started."""

from multiprocessing import Pipe
from typing import Any


class Ended:
    """Ends well; `start` is what a test replaces."""

    exitcode, pid = 0, 0

    def __init__(self, args: tuple[Any, ...], **_: object) -> None:
        *_, self.options, _ = args
        self.sentinel, self._other_end = Pipe()

    def start(self) -> None: ...

    def join(self) -> None: ...

    def is_alive(self) -> bool:
        return False
