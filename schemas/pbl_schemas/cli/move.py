"""`pbl move`: a video into another visit."""

from __future__ import annotations

import click


@click.command()
@click.argument("video_id", type=int)
@click.option("--to", "target", required=True, metavar="SUBJECT/SESSION", help="Where the recording belongs.")
@click.option("--yes", is_flag=True, help="Do it. Without it only the changes are printed.")
def move(video_id: int, target: str, yes: bool) -> None:
    """Move video VIDEO_ID, registered for the wrong person or visit, to the right one.

    Where several cameras filmed the trial, all of its videos go. Keypoints stay. Fits that hold them are deleted with
    all dependent results; `pbl populate` fits the rest of the old visit, and the new one. A person or visit that is new
    is made.

    \b
    Example: pbl move 17 --to P018/2026-03-01
    Example: pbl move 17 --to P018/2026-03-01 --yes && pbl populate
    """
    subject, slash, label = target.partition("/")
    if not slash or not label:
        raise click.UsageError(f"--to {target}: expected SUBJECT/SESSION, such as P018/2026-03-01.")
    import pbl_schemas
    from pbl_schemas.intake.move import carry_out, plan_move

    pbl_schemas.activate(methods=False)
    plan = plan_move(video_id, subject, label)
    new = " (a new person)" if plan.new_subject else " (a new visit)" if plan.new_session else ""
    click.echo(f"video_id {video_id}: from {'/'.join(plan.before)} to {'/'.join(plan.after)}{new}")
    for number, path in plan.files.items():
        click.echo(f"  video_id {number}, {path.name}")
    for table, n in plan.deleted.items():
        click.echo(f"  {'deleted' if yes else 'would be deleted'}: {n} rows of {table}")
    if not plan.left:
        click.echo(f"  {'/'.join(plan.before)} keeps no video; its row stays")
    if not yes:
        click.echo("nothing was changed; add --yes to do it")
        return
    carry_out(plan)
    click.echo("next: pbl populate")
