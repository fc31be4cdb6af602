"""`pbl status`: state of the tables, errors, and videos that wait for a choice."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pbl_schemas.reading.status import Status


@click.command()
@click.option("--exact", is_flag=True, help="Also count unqueued keys, for any number of videos.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, with the full error stacks.")
def status(exact: bool, as_json: bool) -> None:
    """Show per table how many rows are done, pending, running, in error or waiting; errors with their next step.

    \b
    Example: pbl status
    Example: pbl status --json > status.json
    """
    import pbl_schemas
    from pbl_schemas.reading.status import pipeline_status

    pbl_schemas.activate(methods=False)
    state = pipeline_status(exact or None)
    if as_json:
        click.echo(json.dumps(dataclasses.asdict(state), indent=2))
        return
    for line in lines(state):
        click.echo(line)


def lines(state: Status) -> list[str]:
    """The printed form."""
    from pbl_schemas.operations.archive import UNFINISHED_DAYS
    from pbl_schemas.reading.status import span

    out = [f"{state.videos} videos", ""]
    out.append(
        f"{'table':<16}{'done':>8}{'empty':>7}{'pending':>9}{'reserved':>10}{'error':>7}{'waiting':>9}"
        f"{'oldest':>9}{'per hour':>10}{'left':>9}"
    )
    for t in state.tables:
        out.append(
            f"{t.table:<16}{t.done:>8}{t.empty:>7}{t.pending:>9}{t.reserved:>10}{t.error:>7}{t.waiting:>9}"
            f"{span(t.oldest_s):>9}{f'{t.per_hour:.0f}' if t.per_hour else '-':>10}{span(t.left_s):>9}"
        )
    if not state.exact:
        out.append("pending: what is queued; `--exact` also counts what no worker has queued yet")
    out += [f"{t.table} waits: {t.delayed}" for t in state.tables if t.delayed]
    if state.cameras:
        kinds = ", ".join(f"{n} {kind}" for kind, n in state.cameras.items())
        out.append(f"intrinsics of the keypoints: {kinds} (file and measured are calibrations; docs/camera.md)")
    for w in state.workers:
        doing = w["worker_doing"] or "-"
        out.append(f"worker {w['worker_host']}:{w['worker_pid']} ({w['worker_resource']}): {doing}")
    if state.workers_lost:
        out.append(f"{state.workers_lost} workers lost in the last hour: their heartbeats ended, they did not")
    out += [f"cron {one.name}: {one.text()}" for one in state.cron]
    out += [f"disk {name}: {free:.1f} of {total:.1f} GB free" for name, free, total in state.disks]
    out += [f"{name}: {text}" for machine in state.machines for name, text in machine.rows()]
    if state.unfinished:
        ages, sizes = zip(*state.unfinished, strict=True)
        out.append(
            f"{len(ages)} recordings begun and not registered: {sum(sizes) / 1e9:.1f} GB, the oldest without a part"
            f" for {span(max(ages))} (`pbl cron release` removes them after {UNFINISHED_DAYS:g} days)"
        )
    if state.errors:
        n = sum(t.error for t in state.tables)
        shown = "" if n == len(state.errors) else f", {len(state.errors)} of {n}"
        out += ["", f"errors (tried again with: pbl retry){shown}"]
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
        out += [f"  video_id={w.video_id}  {w.about}", f"    {w.reason}"]
        out += [f"    look:  {w.look}", f"    next:  {w.next_step}"]
    if state.not_usable:
        out += ["", "not usable (taken back with: pbl choose VIDEO_ID --usable)"]
    out += [f"  video_id={m.video_id}  {m.about}: {m.reason} ({m.by})" for m in state.not_usable]
    return out
