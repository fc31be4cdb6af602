"""The `pbl` command. Each command is a module found through the entry-point group `pbl.commands`."""

from ._main import TASKS, main

__all__ = ["TASKS", "main"]
