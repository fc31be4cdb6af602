"""The `pbl` command. Each command is a module found through the entry-point group `pbl.commands`."""

from pbl_pipeline import interpreter as _interpreter

_interpreter.require()  # before the imports below: another Python lacks their packages

from .command_line import TASKS, main  # noqa: E402
