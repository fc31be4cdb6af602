"""`pbl choose`: choose the measured person."""

from __future__ import annotations

import getpass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline.words import UNUSABLE

if TYPE_CHECKING:
    from pbl_schemas.decisions.candidates import Candidates


@click.command()
@click.argument("video_id", type=int)
@click.argument("person", type=click.IntRange(min=1), required=False)
@click.option("--sheet", type=click.Path(path_type=Path), help="Write a picture of the numbered people (.jpg, .png).")
@click.option("--tracking-method", metavar="NAME", help="Which tracking is meant, where a video has several.")
@click.option(
    "--not-usable", "reason", type=click.Choice(tuple(UNUSABLE)), help="Leave the video out, for this reason."
)
@click.option("--note", default="", metavar="TEXT", help="With --not-usable: details, without names.")
@click.option("--usable", is_flag=True, help="Take --not-usable back.")
def choose(
    video_id: int,
    person: int | None,
    sheet: Path | None,
    tracking_method: str | None,
    reason: str | None,
    note: str,
    usable: bool,
) -> None:
    """Measure PERSON of video VIDEO_ID, or leave the video out. The choice overrides the automatic one.

    Results of another person are deleted and listed; `pbl populate` recomputes them. Without PERSON nothing
    changes: the persons, their scores and the reason of the automatic choice are printed, and with --sheet a picture of
    them is written. A video that is --not-usable takes part in no fit; its visit is computed without it, and what was
    computed with it comes back with --usable.

    \b
    Example: pbl choose 3 --sheet persons.jpg
    Example: pbl choose 3 2
    Example: pbl choose 3 --not-usable interrupted --note "stumbled at the turn"
    """
    if (person is not None) + (reason is not None) + usable > 1:
        raise click.UsageError("PERSON, --not-usable and --usable: choose one.")
    if note and reason is None:
        raise click.UsageError("--note goes with --not-usable.")
    import pbl_schemas
    from pbl_schemas.decisions.candidates import candidates, write_sheet
    from pbl_schemas.decisions.review_decisions import decide_person

    pbl_schemas.activate(methods=False)
    if reason is not None or usable:
        _decide_usable(video_id, reason, note)
        return
    if person is None or sheet is not None:
        found = candidates(video_id, tracking_method)
        for line in lines(found):
            click.echo(line)
        if sheet is not None:
            for number, about in enumerate(found):
                name = sheet if number == 0 else sheet.with_stem(f"{sheet.stem}.{about.key['tracking_method']}")
                click.echo(f"people: {write_sheet(about, name)}")
    if person is None:
        return
    result = decide_person(video_id, person, tracking_method, getpass.getuser())
    click.echo(f"video_id {video_id}: person {person} will be measured")
    for name, n in result.items():
        click.echo(f"  deleted {n} rows of {name}")
    click.echo("next: pbl populate")


def _decide_usable(video_id: int, reason: str | None, note: str) -> None:
    from pbl_schemas.decisions.review_decisions import mark_not_usable, take_back

    who = getpass.getuser()
    if reason is None:
        take_back(video_id, who)
        click.echo(f"video_id {video_id} is used")
    else:
        mark_not_usable(video_id, reason, note, who)
        click.echo(f"video_id {video_id} is left out: {reason}")
    click.echo("next: pbl populate")


def lines(found: list[Candidates]) -> list[str]:
    """Return the candidates as printed lines."""
    from pbl_schemas.tracking import choose_command

    out = []
    for about in found:
        out.append(f"video_id {about.key['video_id']}  {about.name}  {about.key['tracking_method']}: {about.status}")
        for person, score in about.scores.items():
            said = "no score" if score is None else f"score {score:.2f}"
            out.append(f"  person {person}: {said}" + (", measured" if person == about.chosen else ""))
        if about.reason:
            out.append(f"  {about.reason}")
        if about.status == "NEEDS_CHOICE":
            numbers = "|".join(map(str, sorted(about.scores)))
            out.append(f"  next: {choose_command(about.key, numbers)}")
    return out
