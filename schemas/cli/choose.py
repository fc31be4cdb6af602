"""`pbl choose`: decide who is measured."""

from __future__ import annotations

import click


@click.command()
@click.argument("video_id", type=int)
@click.argument("person", type=click.IntRange(min=1))
@click.option("--tracking-method", metavar="NAME", help="Only for this method's tracking (default: all of the video).")
def choose(video_id: int, person: int, tracking_method: str | None) -> None:
    """Measure PERSON of video VIDEO_ID. The choice wins over the automatic one.

    What was computed for another person is deleted, and said; `pbl populate` computes it anew. The numbers of the
    persons and the reason of the automatic choice are in `pbl status`.

    Example: pbl choose 3 2
    """
    import schemas
    from schemas.choose import choose_person

    schemas.activate(methods=False)
    result = choose_person(video_id, person, tracking_method)
    click.echo(f"video_id {video_id}: person {person} will be measured")
    for name, n in result.items():
        click.echo(f"  deleted {n} rows of {name}")
    click.echo("next: pbl populate")
