"""A decision in a process of its own, begun at the same moment as another one."""

from multiprocessing.synchronize import Barrier
from typing import Any

import pbl_schemas
from pbl_pipeline.errors import PblError


def decide(function: str, arguments: tuple[Any, ...], together: Barrier, answers: Any) -> None:
    """Call a function of `pbl_schemas.decisions` when all have come; its error's code or "done" into the queue."""
    import importlib

    pbl_schemas.activate(methods=False)
    module, _, name = function.rpartition(".")
    together.wait(60)
    try:
        getattr(importlib.import_module(module), name)(*arguments)
    except PblError as error:
        answers.put((error.code, error.found))
    else:
        answers.put(("done", ""))


def at_once(function: str, *calls: tuple[Any, ...]) -> list[tuple[str, str]]:
    """The answers of the same function called by as many processes at one moment, sorted."""
    import multiprocessing

    context = multiprocessing.get_context("spawn")
    together, answers = context.Barrier(len(calls)), context.Queue()
    processes = [context.Process(target=decide, args=(function, c, together, answers)) for c in calls]
    for process in processes:
        process.start()
    found = sorted(answers.get(timeout=300) for _ in processes)
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    return found
