"""Files made in separate processes: complete or absent, and ended with their queue."""

import contextlib
import os
import time
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_workers.process_queue import ProcessQueue, Task


def write(path: Path, text: str) -> None:
    path.write_text(text)


def die(path: Path) -> None:
    path.write_text("half")
    os._exit(9)


def refuse(path: Path) -> None:
    raise PblError("VIDEO_DAMAGED", found="x", expected="y", next_step="z", key=1)


def sleep(path: Path, begun: Path) -> None:
    path.write_text("half")
    begun.touch()
    time.sleep(600)


def broken(found: str) -> PblError:
    return PblError("WEB_NOT_MADE", found=found, expected="y", next_step="z")


class Opened:
    """Counts what is closed."""

    def __init__(self) -> None:
        self.closed = 0

    def task(self, function: Any, *args: Any) -> Task:
        stack = contextlib.ExitStack()
        stack.callback(lambda: setattr(self, "closed", self.closed + 1))
        return Task(function, args, broken, "file.txt", stack)


def ended(work: Any) -> Any:
    end = time.monotonic() + 60
    while not work.ended and time.monotonic() < end:
        time.sleep(0.05)
    return work


def test_a_half_written_file_is_never_there():
    making, opened = ProcessQueue(most=2, kept=2), Opened()
    try:
        died = ended(making.begin("a", opened.task(die)))
        assert died.path is None
        assert died.error.code == "WEB_NOT_MADE"
        assert "code 9" in died.error.found
        refused = ended(making.begin("b", opened.task(refuse)))
        assert refused.error.code == "VIDEO_DAMAGED"
        making.drop("a")
        again = ended(making.begin("a", opened.task(write, "whole")))
        assert again.path.read_text() == "whole"
        assert making.begin("a", opened.task(write, "twice")) is again
        making.drop("a")
        assert making.find("a") is again  # only what failed is dropped
    finally:
        making.close()
    assert opened.closed == 4
    assert not again.path.exists()


def test_the_page_ends_while_something_is_made(tmp_path: Path):
    making, opened = ProcessQueue(most=2, kept=2), Opened()
    work = making.begin("a", opened.task(sleep, tmp_path / "begun"))
    waits = making.begin("b", opened.task(write, "x"))
    until = time.monotonic() + 60
    while not (tmp_path / "begun").exists():
        assert time.monotonic() < until
        time.sleep(0.05)
    begun = time.monotonic()
    making.close()
    assert time.monotonic() - begun < 60.0  # it sleeps for ten minutes
    assert work.path is None
    assert waits.path is None
    assert opened.closed == 2
