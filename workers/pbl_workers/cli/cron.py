"""`pbl cron`: regular jobs, called by a crontab, systemd timers or a cluster's scheduler."""

from __future__ import annotations

import signal
from pathlib import Path

import click

from pbl_pipeline.errors import PblError, harmless

#: How long `pbl cron import` may take (s): a database or a file system that hangs holds it no longer.
AT_MOST_S = 1800
#: How many names of ignored files `pbl cron import` prints.
_MOST_IGNORED = 100
#: Exit status where another process does the work now: neither a success nor a failure. `refresh` then ends with 0: an
#: idle worker does the same, and often.
BUSY = 75
_BUSY = "another process is doing this now"


class _Pass(click.Command):
    """A command that notes how it ended, for `pbl status`, the summary and the metrics."""

    def invoke(self, ctx: click.Context) -> None:
        from pbl_workers.heartbeat import cron_pass

        with cron_pass(str(ctx.info_name), BUSY):
            super().invoke(ctx)


class _Cron(click.Group):
    command_class = _Pass


@click.group(
    cls=_Cron,
    help=f"""Regular jobs; each may run at any time, also twice. docs/deployment.md has a crontab and systemd timers.

    Exit code {BUSY} of import and backup: {_BUSY}.

    Example: pbl cron import && pbl cron refresh
    """,
)
def cron() -> None:
    pass


@cron.command("import")
@click.option("--settled", "settled_s", type=click.FloatRange(min=0), default=60.0, show_default=True,
              help="Seconds without a change after which a file counts as whole.")  # fmt: skip
def import_(settled_s: float) -> None:
    """Take over recordings that were uploaded to PBL_INCOMING as SUBJECT/SESSION/FILE, and register them.

    Exit code 1 when an upload was refused or could not be taken. After 30 minutes the process is ended by SIGALRM,
    whatever it waits for; the next run continues.

    Example: PBL_INCOMING=/srv/uploads pbl cron import
    """
    import pbl_schemas
    from pbl_schemas.operations.archive import busy
    from pbl_workers.incoming import import_uploads

    signal.alarm(AT_MOST_S)
    try:
        pbl_schemas.activate()
        taken = import_uploads(settled_s=settled_s)
    finally:
        signal.alarm(0)
    if taken is None:
        click.echo(busy("the next run takes the rest").short(), err=True)
        raise click.exceptions.Exit(BUSY)
    click.echo(
        f"{len(taken.registered)} registered, {len(taken.known)} known, {len(taken.refused)} refused, "
        f"{len(taken.left)} left, {taken.later} for the next run, {taken.uploading} not whole yet, "
        f"{len(taken.ignored)} ignored"
    )
    for name, note in sorted(taken.known.items()):
        click.echo(harmless(f"known: {name}: {note}", lines=False))
    for name, why in sorted(taken.ignored.items())[:_MOST_IGNORED]:
        click.echo(harmless(f"ignored, {why}: {name}", lines=False))
    if len(taken.ignored) > _MOST_IGNORED:
        click.echo(f"ignored: {len(taken.ignored) - _MOST_IGNORED} more")
    for what in ("refused", "left"):
        for _, error in sorted(getattr(taken, what).items()):
            click.echo(f"{what}: {error.text()}", err=True)
    if taken.refused or taken.left:
        raise click.exceptions.Exit(1)


@cron.command()
@click.option("--all", "everything", is_flag=True, help="Compare all rows, not only recent ones.")
def refresh(everything: bool) -> None:
    """Queue what can be computed: new recordings, choices and methods; once an hour, whatever is missing in any table.

    Example: pbl cron refresh
    """
    import pbl_schemas
    from pbl_workers.refresh import refresh as look

    pbl_schemas.activate()
    found = look(everything or None)
    if found is None:
        click.echo(_BUSY)
        return
    queued = ", ".join(f"{n} of {name}" for name, n in found.queued.items()) or "nothing"
    click.echo(f"queued: {queued}; {found.planned} fits planned, {found.freed} freed, {found.swept} obsolete")


@cron.command()
def release() -> None:
    """Put the jobs of dead workers back into the queue, and remove recordings that were begun and never registered.

    That is: parts that did not go on for a week, and recordings of the archive of which a process was killed before
    they had a row. `pbl status` shows how many wait for it.

    Example: pbl cron release
    """
    import pbl_schemas
    from pbl_schemas import video, worker
    from pbl_schemas.operations.archive import LOCK, archive_dir, remove_unfinished
    from pbl_workers.recover import free_dead

    pbl_schemas.activate(methods=False)
    freed = {t.__name__: n for t in pbl_schemas.computed_tables() if (n := free_dead(t))}
    click.echo(", ".join(f"{n} of {name}" for name, n in freed.items()) or "no dead reservations")
    with worker.installation_lock(LOCK, video.Video.connection) as obtained:
        removed = remove_unfinished(archive_dir()) if obtained else []  # else the next run
    if removed:
        n_bytes = sum(one.n_bytes for one in removed)
        click.echo(f"removed {len(removed)} recordings that were begun and did not go on ({n_bytes / 1e6:.0f} MB)")


@cron.command()
def reprocess() -> None:
    """Retry error rows whose cause was outside the recording: a missing model or file, a full disk, a crash.

    A cron job never deletes results: for another method or newer code see `pbl reprocess`.

    Example: pbl cron reprocess
    """
    import pbl_schemas
    from pbl_workers.requeue import retry_outside

    pbl_schemas.activate(methods=False)
    click.echo(", ".join(f"{n} {code}" for code, n in retry_outside().items() if n) or "nothing to try again")


@cron.command()
@click.option("--keep", type=click.IntRange(min=1), default=7, show_default=True, help="Backups that are kept.")
def backup(keep: int) -> None:
    """Save database, store and recordings into a new folder of PBL_BACKUP, and remove the oldest.

    A person who was forgotten is also gone from the backups once the last older one is removed.

    Example: PBL_BACKUP=/backup pbl cron backup --keep 7
    """
    import pbl_schemas
    from pbl_schemas.cli.db_backup import say
    from pbl_workers.backups import backup_folder, backup_regularly

    pbl_schemas.activate(methods=False)
    made = backup_regularly(backup_folder(), keep, click.echo)
    if made is None:
        click.echo(_BUSY, err=True)
        raise click.exceptions.Exit(BUSY)
    say(made)


@cron.command()
@click.option("--hours", type=click.FloatRange(min=0.01), default=24.0, show_default=True)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="Also write summary-DATE.txt and .html there."
)
def summary(hours: float, out: Path | None) -> None:
    """Summarise the last hours: finished, failed and waiting work, live workers, free disk space.

    Example: pbl cron summary --out /var/www/pbl
    """
    import pbl_schemas
    from pbl_workers.summary import as_text, make_summary, write

    pbl_schemas.activate(methods=False)
    found = make_summary(hours)
    click.echo(as_text(found), nl=False)
    if out is not None:
        for path in write(found, out):
            click.echo(str(path), err=True)


@cron.command()
@click.option("--remove-older-than", "days", type=click.FloatRange(min=1), metavar="DAYS",
              help="Delete files of the store that no row names and that are older.")  # fmt: skip
@click.option("--least-free", "least_gb", type=click.FloatRange(min=0), default=10.0, show_default=True,
              metavar="GB", help="Less free space is an error.")  # fmt: skip
def disk(days: float | None, least_gb: float) -> None:
    """Report free space, the store's size, files without a row and rows without their file; remove files of the store
    that a killed process was writing a week ago.

    Example: pbl cron disk --remove-older-than 30
    """
    import pbl_schemas
    from pbl_schemas.operations.archive import UNFINISHED_DAYS, disks
    from pbl_schemas.operations.orphans import WRITING, orphans, remove

    pbl_schemas.activate(methods=False)
    found = orphans()
    click.echo(f"store: {found.n_files} files, {found.n_bytes / 1e9:.2f} GB")
    click.echo(f"files without a row: {len(found.orphans)}, {sum(f.size for f in found.orphans) / 1e9:.2f} GB")
    for file in found.orphans[:20]:
        click.echo(f"  {file.path}  {file.age_s / 86400:.1f} days")
    if n := remove(found, UNFINISHED_DAYS * 86400, WRITING):
        click.echo(f"removed {n} that a killed process was writing")
    if days is not None:
        click.echo(f"removed: {remove(found, days * 86400)}")
    for name, free, total in disks():
        click.echo(f"disk {name}: {free:.1f} of {total:.1f} GB free")
    if found.lost:
        raise PblError(
            "BACKUP_INVALID",
            found=f"{len(found.lost)} files that rows name are not in the store: {', '.join(found.lost[:5])}",
            expected="every file that a row names",
            next_step="restore them from a backup, or delete the rows so that they are computed again",
        )
    full = [name for name, free, _ in disks() if free < least_gb]
    if full:
        raise PblError(
            "FILE_UNWRITABLE",
            found=f"less than {least_gb:g} GB free: {', '.join(full)}",
            expected="room for the next recordings",
            next_step="make room, or move PBL_STORE or PBL_ARCHIVE to a larger disk",
        )
