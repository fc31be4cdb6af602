"""`pbl forget`: remove a person."""

from __future__ import annotations

import os

import click


@click.command()
@click.argument("subject")
@click.option("--yes", is_flag=True, help="Do it. Without it only the list of the removals is printed.")
@click.option(
    "--videos",
    is_flag=True,
    help="Delete the recordings: registered video files (where they still are what was registered), and the person's "
    "folders of the archive and the drop folder.",
)
def forget(subject: str, yes: bool, videos: bool) -> None:
    """Remove every row and every stored file of the person SUBJECT, and prove it with a list.

    A dry run is the default. The list is written to PBL_HOME/forgotten/SUBJECT.json before the first row is deleted;
    interrupted, run it again until it reports that nothing is left (exit code 0). Backups, and reports or exports that
    were made, are not reached. Needs an account that may delete, and a key that may delete from the store.

    \b
    Example: pbl forget P017
    Example: pbl forget P017 --yes --videos
    """
    import pbl_schemas
    from pbl_pipeline.names import normalised_label
    from pbl_schemas.operations import archive
    from pbl_schemas.operations import forget as lib

    subject = normalised_label(subject)
    pbl_schemas.activate(methods=False)
    if not yes:
        _, found = lib.find(subject)
        for table, n in found.rows.items():
            click.echo(f"{n:>8} rows of {table}")
        for path in found.files:
            click.echo(f"    file {path}")
        for item in found.videos:
            click.echo(f"   video {item['path']}{'' if videos else ' (stays, without --videos)'}")
        for path in found.recordings:
            stays = not videos and archive.COPIES not in path.split("/")
            click.echo(f"recorded {path}{' (stays, without --videos)' if stays else ''}")
        for job in found.running:
            click.echo(f" running {job}")
        click.echo(
            f"{sum(found.rows.values())} rows and {len(found.files)} stored files. Nothing was changed:", nl=False
        )
        click.echo(" this is a dry run, --yes does it.")
        return
    done = lib.forget(subject, videos, click.echo)
    click.echo(f"{sum(done.rows.values())} rows and {len(done.files)} stored files of {subject} were removed")
    for path in done.videos:
        click.echo(f"  video deleted: {path}")
    for path, why in done.kept.items():
        click.echo(f"  video stays: {path} ({why})")
    for line in done.left:
        click.echo(f"  left: {line}", err=True)
    click.echo(f"The list is in {done.manifest}. Older backups still hold this person, and a normative set", nl=False)
    click.echo(" built from their walks holds their share of its means.")
    if done.left:
        raise click.exceptions.Exit(1)
    click.echo("Looked up again: no row, no queued job and no stored file is left", nl=False)
    click.echo(f"; {len(done.kept)} recordings stay, as listed." if done.kept else ", and no recording.")
    drop = os.environ.get("PBL_INCOMING") or "none (PBL_INCOMING is not set here)"
    click.echo(f"Searched for recordings: the archive {archive.archive_dir()}, the drop folder: {drop}")
