"""`pbl db backup` and `pbl db restore`: database and object store, together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pbl_schemas.operations.backup import Backup


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--database-only", is_flag=True, help="Leave the store's files out (where it is saved by other means).")
@click.option("--recordings", "with_recordings", is_flag=True, help="Also save the registered videos.")
def backup(folder: Path, database_only: bool, with_recordings: bool) -> None:
    """Save all tables and the files they name into the new folder FOLDER, as of one moment. Workers may keep running.

    It holds data of people: keep it as closed as the database itself. `pbl forget` does not reach into backups.

    \b
    Example: pbl db backup /backup/2026-03-01
    Example: pbl db backup --recordings /backup/2026-03-01
    """
    from pbl_schemas.operations.backup import backup as save

    say(save(folder, not database_only, click.echo, with_recordings))


def say(saved: Backup) -> None:
    """Print what was saved, and on stderr the recordings that were not."""
    click.echo(f"{sum(saved.rows.values())} rows of {len(saved.rows)} tables, {saved.n_files} files, ", nl=False)
    click.echo(f"{saved.n_recordings} recordings ({saved.n_bytes / 2**20:.1f} MB) of {saved.created} ", nl=False)
    click.echo(f"are in {saved.folder}")
    _say_left(saved)


def _say_left(saved: Backup) -> None:
    for path, why in saved.left.items():
        click.echo(f"left out: {path}: {why}", err=True)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--check", "only_check", is_flag=True, help="Compare the backup with its checksums; change nothing.")
@click.option("--again", is_flag=True, help="After an interrupted restore: remove what it left and start again.")
@click.option(
    "--recordings-below",
    "below",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Folder in which recordings may be written, at their registered paths. Can be repeated. "
    "[default: PBL_ARCHIVE]",
)
def restore(folder: Path, only_check: bool, again: bool, below: tuple[Path, ...]) -> None:
    """Bring a backup back into an empty database and its store. An embedded database that is not running, or not there
    yet, is started.

    Never over another: where tables exist it refuses. Checksums are compared before anything is written, row counts
    after.

    \b
    Example: pbl db restore --check /backup/2026-03-01
    Example: PBL_HOME=/srv/pbl-new pbl db restore /backup/2026-03-01
    Example: pbl db restore --recordings-below /data/videos /backup/2026-03-01
    """
    from pbl_schemas.operations import backup

    if only_check:
        manifest = backup.check(folder, click.echo)
        click.echo(f"The backup of {manifest['created']} is whole: {sum(manifest['rows'].values())} rows, ", nl=False)
        click.echo(f"{manifest['n_files']} files, {manifest['n_recordings']} recordings")
        return
    done = backup.restore(folder, again, click.echo, below)
    click.echo(f"{sum(done.rows.values())} rows, {done.n_files} files and ", nl=False)
    click.echo(f"{done.n_recordings} recordings of {done.created} are back")
    _say_left(done)
    click.echo("Next: pbl db migrate --dry-run, where this version of the code is another than the backup's")
