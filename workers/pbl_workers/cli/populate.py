"""`pbl populate`: compute missing results."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from pbl_pipeline.cli.command_line import EXIT_INTERRUPTED

if TYPE_CHECKING:
    from pbl_workers.populate import Run


@click.command()
@click.option("--table", "tables", multiple=True, metavar="NAME", help="Only this table; may be given several times.")
@click.option("--limit", type=click.IntRange(min=1), help="At most this many computations per table.")
@click.option("--retry-errors", is_flag=True, help="Clear error rows first and try their videos again.")
@click.option("--visit", type=click.IntRange(min=1), metavar="NUMBER", help="Only this visit (`pbl list visits`).")
def populate(tables: tuple[str, ...], limit: int | None, retry_errors: bool, visit: int | None) -> None:
    """Compute missing results, table after table. Safe to repeat and to run in several processes at once.

    A video that fails leaves an error row with a code and a next step (`pbl status` shows it) while all others finish;
    it is not tried again until --retry-errors. Ctrl-C puts the running computation back into the queue.

    \b
    Example: pbl populate
    Example: pbl populate --table Tracking --limit 10
    """
    import pbl_schemas
    from pbl_workers.populate import populate as run_once

    pbl_schemas.activate()
    run = run_once(tables, limit, retry_errors, visit)
    for line in summary(run):
        click.echo(line)
    if run.interrupted:
        raise click.exceptions.Exit(EXIT_INTERRUPTED)


def summary(run: Run) -> list[str]:
    """The lines printed at the end of a run."""
    lines = []
    if run.freed:
        lines.append(f"{run.freed} interrupted computations were put back into the queue")
    if run.retried:
        lines.append(f"{run.retried} error rows were cleared and tried again")
    if run.dropped:
        rows = ", ".join(f"{n} of {name}" for name, n in run.dropped.items())
        lines.append(f"deleted because another person was chosen: {rows}")
    if run.planned:
        lines.append(f"{run.planned} sets of videos planned for a fit")
    busy = [t for t in run.tables if t.done or t.empty or t.waiting or t.errors]
    if busy:
        lines.append(f"{'table':<16}{'done':>7}{'empty':>7}{'waiting':>9}{'errors':>8}")
    for t in busy:
        codes = ", ".join(f"{n} {code}" for code, n in sorted(t.errors.items()))
        n_errors = sum(t.errors.values())
        lines.append(f"{t.table:<16}{t.done:>7}{t.empty:>7}{t.waiting:>9}{n_errors:>8}  {codes}".rstrip())
    if run.interrupted:
        lines.append("interrupted: the computation that was running is back in the queue")
    elif not run.did_something:
        lines.append("nothing to do: everything that can be computed is there")
    if any(t.waiting for t in run.tables):
        lines.append("videos wait for a choice: see `pbl status`, then `pbl choose VIDEO_ID PERSON`")
    if any(t.errors for t in run.tables):
        lines.append("errors and their next steps: `pbl status`")
    return lines
