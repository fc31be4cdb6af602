"""Stand-ins for the processes of a worker: one that has ended as soon as it was started; and a run to its end."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import Pipe
from typing import Any

from pbl_workers.supervisor import Supervisor


class Ended:
    """Ends well; `start` is what a test replaces."""

    exitcode, pid = 0, 0

    def __init__(self, args: tuple[Any, ...], **_: object) -> None:
        self.options = args[2]
        self.sentinel, self._other_end = Pipe()

    def start(self) -> None: ...

    def join(self) -> None: ...

    def is_alive(self) -> bool:
        return False


def run_until(boss: Supervisor, done: Callable[[], None]) -> int:
    """Run a supervisor while a thread does this, which stops it then; the exit code."""

    def do() -> None:
        try:
            done()
        finally:
            boss.stop()

    with ThreadPoolExecutor(1) as beside:
        does = beside.submit(do)
        code = boss.run()
    does.result()
    return code
