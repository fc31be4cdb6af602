"""`pbl status`: how far the tables are, what failed and what waits."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from schemas.status import Status


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, with the full error stacks.")
def status(as_json: bool) -> None:
    """Show per table what is done, pending, being computed, in error or waiting; errors with their next step.

    \b
    Example: pbl status
    Example: pbl status --json > status.json
    """
    import schemas
    from schemas.status import pipeline_status

    schemas.activate(methods=False)
    state = pipeline_status()
    if as_json:
        click.echo(json.dumps(state.to_dict(), indent=2))
        return
    for line in lines(state):
        click.echo(line)


def lines(state: Status) -> list[str]:
    """The printed form."""
    out = [f"{state.videos} videos", ""]
    out.append(f"{'table':<16}{'done':>7}{'empty':>7}{'pending':>9}{'reserved':>10}{'error':>7}{'waiting':>9}")
    for t in state.tables:
        out.append(f"{t.table:<16}{t.done:>7}{t.empty:>7}{t.pending:>9}{t.reserved:>10}{t.error:>7}{t.waiting:>9}")
    if state.errors:
        out += ["", "errors (tried again with: pbl populate --retry-errors)"]
    for e in state.errors:
        key = ", ".join(f"{k}={v}" for k, v in e.key.items())
        out += [
            f"  {e.code}  {e.table}  {key}  {e.about}".rstrip(),
            f"    found: {e.found}",
            f"    next:  {e.next_step}",
        ]
    if state.empty:
        out += ["", "ran well, nothing to produce"]
    out += [f"  video_id={e.video_id}  {e.about}  {e.table}: {e.reason}" for e in state.empty]
    if state.waiting:
        out += ["", "waiting for a choice"]
    for w in state.waiting:
        out += [f"  video_id={w.video_id}  {w.about}", f"    {w.reason}", f"    next:  {w.next_step}"]
    return out
