"""`pbl retry`: try failed jobs again."""

from __future__ import annotations

import click


@click.command()
@click.argument("video_id", type=int, required=False)
@click.option("--code", metavar="CODE", help="Only errors of this code, such as VIDEO_MISSING.")
@click.option("--table", metavar="NAME", help="Only errors of this table.")
def retry(video_id: int | None, code: str | None, table: str | None) -> None:
    """Put error rows back into the queue: all, or those of one video, code or table. Workers then try them again.

    \b
    Example: pbl retry --code VIDEO_MISSING
    Example: pbl retry 17
    """
    import pbl_schemas
    from pbl_workers.requeue import retry as again

    pbl_schemas.activate(methods=False)
    done = again(code, table, video_id)
    for name, n in done.items():
        click.echo(f"{name}: {n} put back into the queue")
    if not done:
        click.echo("no such error rows")
