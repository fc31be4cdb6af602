"""A page for each task of `pbl --help`, with the help of each of its commands and of theirs."""

from __future__ import annotations

import re
from collections.abc import Iterator

import click

from pbl_pipeline.cli import TASKS
from pbl_pipeline.cli.command_line import cli

FOLDER = "reference/commands"


def tree(
    command: click.Command = cli, name: str = "pbl", parent: click.Context | None = None
) -> Iterator[tuple[str, click.Context]]:
    """Full name (`pbl db init`) and context of every command, parents before children."""
    own = name.rsplit(" ", 1)[-1]
    ctx = click.Context(command, info_name=own, parent=parent, terminal_width=88, max_content_width=88)
    yield name, ctx
    if isinstance(command, click.Group):
        for sub in command.list_commands(ctx):
            child = command.get_command(ctx, sub)
            assert child is not None, sub
            yield from tree(child, f"{name} {sub}", ctx)


def pages() -> dict[str, str]:
    """Path in the site -> Markdown."""
    helps = {name: f"```text\n{ctx.get_help()}\n```" for name, ctx in tree()}
    start = ["# Commands", helps["pbl"]]
    found = {}
    for task, names in TASKS.items():
        start.append(f"**{task}**: " + ", ".join(f"[`pbl {n}`]({slug(task)}.md#pbl-{n})" for n in names))
        parts = [f"# {task}\n"]
        for name in names:
            below = [full for full in helps if full == f"pbl {name}" or full.startswith(f"pbl {name} ")]
            parts += [f"{'#' * full.count(' ')}# {full}\n\n{helps[full]}\n" for full in below]
        found[f"{FOLDER}/{slug(task)}.md"] = "\n".join(parts)
    return found | {f"{FOLDER}/index.md": "\n\n".join(start) + "\n"}


def slug(task: str) -> str:
    return re.sub(r"\W+", "-", task.lower()).strip("-")
