"""The `pbl` command. Each command is a module found through the entry-point group `pbl.commands`."""

from .command_line import TASKS, main
