"""`pbl db migrate`: bring the tables of an older release to this one."""

from __future__ import annotations

import click


@click.command()
@click.option("--dry-run", is_flag=True, help="Print what would be done, change nothing. Exit code 1: more is needed.")
def migrate(dry_run: bool) -> None:
    """Bring the tables on the server to their definitions in this version: create what is missing, apply numbered
    migrations, then compare. Safe to repeat.

    Rows stay as they are. Make a backup first, stop the workers, and use an account that may alter tables.

    \b
    Example: pbl db migrate --dry-run
    Example: pbl db backup /backup/before && pbl db migrate
    """
    from schemas import migrations
    from schemas.reading.bridge import changed_defaults

    known = migrations.applied()
    click.echo(f"{len(known)} migrations applied so far" + (f", last {known[-1].when} UTC" if known else ""))
    outcome = migrations.migrate(dry_run, click.echo)
    for line in outcome.created:
        click.echo(f"  {line}")
    for title, statements in outcome.steps:
        click.echo(f"{title}: {len(statements)} statements")
        for statement in statements if dry_run else ():
            click.echo(f"  {statement};")
    for line in outcome.open:
        click.echo(f"  needs its own migration: {line}")
    if outcome.open:
        raise click.exceptions.Exit(1)
    for line in changed_defaults():
        click.echo(line)
    done = not outcome.created and not any(s for _, s in outcome.steps)
    click.echo("The tables are as this version defines them." if done or not dry_run else "Nothing was changed.")
