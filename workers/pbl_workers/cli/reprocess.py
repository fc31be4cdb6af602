"""`pbl reprocess`: compute again, behind all new work."""

from __future__ import annotations

import click

from pbl_pipeline.errors import PblError


@click.command()
@click.option(
    "--table", required=True, metavar="NAME", help="Computed table to begin with; what follows is computed anew."
)
@click.option(
    "--new-method", metavar="NAME", help="Add this method to all that went through another; nothing is deleted."
)
@click.option("--method", metavar="NAME", help="Only results of this method.")
@click.option(
    "--since", metavar="TIME", help="Only results computed (with --new-method: videos registered) since, UTC."
)
@click.option("--before", metavar="TIME", help="Only results computed before this time, UTC.")
@click.option("--yes", is_flag=True, help="Do it. Without this, only say what would be done.")
def reprocess(
    table: str, new_method: str | None, method: str | None, since: str | None, before: str | None, yes: bool
) -> None:
    """Compute results again, with lower priority than new videos. Prints what it would do; --yes does it.

    With --new-method the old rows stay and the new method's are added beside them. Without, the chosen rows and all
    dependent results are deleted, in small steps, and queued again.

    \b
    Example: pbl reprocess --table SessionFit --new-method gauss-newton
    Example: pbl reprocess --table Keypoints --before 2026-06-01 --yes
    """
    import pbl_schemas
    from pbl_pipeline import progress
    from pbl_workers import requeue

    pbl_schemas.activate()
    if new_method and (method or before):
        raise PblError(
            "USAGE",
            found="--new-method together with --method or --before",
            expected="either a method that is added, or results that are computed again",
            next_step="leave one out",
        )
    if new_method:
        day = requeue.parse_time(since)
        plan = requeue.plan_new_method(table, new_method, day.date() if day else None)
    else:
        plan = requeue.plan_again(table, method, requeue.parse_time(since), requeue.parse_time(before))
    for line in requeue.summary(plan):
        click.echo(line)
    n = len(plan.add) + len(plan.outdated)
    if not n:
        return
    if not yes:
        click.echo("nothing was changed; add --yes to do it")
        return
    with progress.bar("reprocess", total=n, unit="row") as update:
        done = 0
        for so_far in requeue.carry_out(plan):
            update(so_far - done)
            done = so_far
    click.echo(f"{n} queued with low priority; `pbl worker` computes them")
