"""Command line: finds commands by name, loads only the one called, and turns errors into exit codes and texts."""

from __future__ import annotations

import errno
import functools
import io
import sys
import traceback
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path

import click

from pbl_pipeline import progress, temporary
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import CODERS, INTERRUPTS, PblError
from pbl_pipeline.extras import absent
from pbl_pipeline.resources import fewer_collections

#: Exit codes: 0 done, 1 a coded error, 2 wrong usage (click's own), 130 interrupted.
EXIT_ERROR, EXIT_INTERRUPTED = 1, 130


@functools.cache
def _installed(group: str) -> EntryPoints:
    """Return the entry points of a group; each question reads the list of all installed packages, and a help asks once
    for each command."""
    return entry_points(group=group)


class Commands(click.Group):
    """A group of its own commands and of those that other packages register under an entry-point group."""

    entries = "pbl.commands"

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*self.commands, *(e.name for e in _installed(self.entries))})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in self.commands:
            return self.commands[cmd_name]
        for entry in _installed(self.entries):
            if entry.name == cmd_name:
                return entry.load()
        return None


#: Tasks and their commands, in the order of use.
TASKS = {
    "From files to files": ("run", "detect", "fit", "events", "gait", "study", "deidentify"),
    "Begin with the tables": ("demo", "db", "capture", "ingest", "list", "populate", "status", "report", "export"),
    "Correct and decide": ("web", "why", "choose", "move", "retry", "reprocess", "forget"),
    "Cameras, models, methods, norms": ("calibrate", "camera", "models", "method", "norm"),
    "Run it for many": ("worker", "cron", "doctor"),
    "Check and measure": ("validate", "bench", "synth"),
}


class ByTask(Commands):
    """Commands whose help lists them by task."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        names = self.list_commands(ctx)
        listed = {name for task in TASKS.values() for name in task}
        more = {"Further commands": tuple(name for name in names if name not in listed)}
        width = max(map(len, names), default=0)
        for task, wanted in (TASKS | more).items():
            found = [(n, self.get_command(ctx, n)) for n in wanted if n in names]
            limit = formatter.width - 6 - width
            rows = [(n.ljust(width), command.get_short_help_str(limit)) for n, command in found if command is not None]
            if rows:
                with formatter.section(task):
                    formatter.write_dl(rows)


def _print_version(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    """Print version and commit; git is run only here."""
    if asked and not ctx.resilient_parsing:
        click.echo(f"pbl, version {code_version()}")
        ctx.exit()


@click.group(cls=ByTask, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version,
    help="Show the version and exit.",
)  # fmt: skip
@click.option("--quiet", is_flag=True, help="No progress bars.")
@click.option("--debug", is_flag=True, help="Also print the traceback of an error.")
def cli(quiet: bool, debug: bool) -> None:
    """Gait analysis from phone video: joint angles, gait events and a Gait Deviation Index.

    Example: pbl run walk.mp4 --out results
    """
    progress.enable(not quiet)
    temporary.sweep()


def main() -> None:
    """Run the `pbl` script."""
    fewer_collections()
    for stream in (sys.stdout, sys.stderr):  # a character that the terminal's encoding lacks must not end the work
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        # Not standalone: click would turn Ctrl-C into "Aborted!" and code 1, as if there had been an error.
        sys.exit(cli.main(prog_name="pbl", standalone_mode=False) or 0)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        for end in INTERRUPTS:
            end()
        sys.exit(EXIT_INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - every error gets a next step instead of a traceback
        _explain(error)


def _explain(error: Exception) -> None:
    # The option is read from the arguments: the error may have been raised before the options were parsed.
    if "--debug" in sys.argv[1:]:
        traceback.print_exception(error)
    coded = error if isinstance(error, PblError) else _unforeseen(error)
    click.echo(coded.text(), err=True)
    sys.exit(EXIT_ERROR)


def _unforeseen(error: Exception) -> PblError:
    """Convert an error without a code: a full disk, a name too long, a package that cannot be imported and what
    `errors.CODERS` know have codes, all others are INTERNAL."""
    if known := next(filter(None, (coder(error) for coder in CODERS)), None):
        return known
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
        return PblError(
            "FILE_UNWRITABLE",
            found=error.strerror or str(error),
            expected="room for the results",
            next_step="free space on this disk, or write to another one",
            key=error.filename,
        )
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return PblError(
            "USAGE",
            found=error.strerror or str(error),
            expected="names of files and folders that this system can have",
            next_step="shorten the name",
            key=str(error.filename)[:200],
        )
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, ImportError):
        module = error.name or Path(frames[-1].filename).parent.name
        if not module.startswith("pbl_"):
            return absent(error, module)
    where = f", at {Path(frames[-1].filename).name}:{frames[-1].lineno} in {frames[-1].name}" if frames else ""
    return PblError(
        "INTERNAL",
        found=f"{type(error).__name__}: {error}{where}",
        expected="a result or a coded error",
        next_step="run the same with `pbl --debug ...` and report the whole text",
    )
