"""`pbl why`: state of a video, and the next step."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pbl_schemas.reading.why import Step


@click.command()
@click.argument("video_id", type=int)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def why(video_id: int, as_json: bool) -> None:
    """Show every stage of one video: its row, job or error with advice, and the next step.

    \b
    Example: pbl why 17
    """
    import pbl_schemas
    from pbl_schemas.reading.why import why as look

    pbl_schemas.activate(methods=False)
    found = look(video_id)
    if as_json:
        click.echo(json.dumps(dataclasses.asdict(found), indent=2, default=str))
        return
    click.echo(f"video {found.video_id}  {found.name}  session {found.session_id}\n{found.path}\n")
    for step in found.steps:
        click.echo(f"{step.table:<16}{step.what:<20}{_about(step):<33} {step.note}".rstrip())
        if step.next_step:
            click.echo(f"{'':<16}next: {step.next_step}")
    click.echo(f"\n{found.verdict}")


def _about(step: Step) -> str:
    return ", ".join(filter(None, (step.method, f"video_id {step.camera}" if step.camera is not None else "")))
