"""Finds commands by name, loads only the one called, and turns a `PblError` into exit code and stderr text."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

import click

from pbl_pipeline import __version__, progress
from pbl_pipeline.errors import PblError

#: Exit codes: 0 done, 1 a coded error, 2 wrong usage (click's own), 130 interrupted.
EXIT_ERROR = 1


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(e.name for e in entry_points(group="pbl.commands"))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        for entry in entry_points(group="pbl.commands"):
            if entry.name == cmd_name:
                return entry.load()
        return None


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="pbl")
@click.option("--quiet", is_flag=True, help="No progress bars.")
def cli(quiet: bool) -> None:
    """Gait analysis from phone video: joint angles, gait events and a Gait Deviation Index.

    Example: pbl run walk.mp4 --out results
    """
    progress.enable(not quiet)


def main() -> None:
    """Entry point of the `pbl` script."""
    try:
        cli(prog_name="pbl")
    except PblError as error:
        click.echo(error.text(), err=True)
        sys.exit(EXIT_ERROR)
