"""`pbl list`: people, visits, videos, methods, decisions and looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import pandas as pd


@click.group("list", epilog="Example: pbl list videos --subject P017")
def list_() -> None:
    """List people, visits, videos, methods, decisions and looks.

    Example: pbl list visits --population patient --csv > visits.csv
    """


_FORMAT = (
    click.option("--json", "as_json", is_flag=True, help="Print a JSON list of rows instead of a table."),
    click.option("--csv", "as_csv", is_flag=True, help="Print CSV instead of a table."),
)
_PEOPLE = (
    click.option("--subject", metavar="CODE", help="Of this person."),
    click.option("--population", metavar="NAME", help="Of people of this group."),
    click.option("--project", metavar="NAME", help="Of people of this study or clinic."),
)
_VISITS = (*_PEOPLE, click.option("--session", "session_label", metavar="LABEL", help="Of visits of this label."))


def _options(*given: Callable) -> Callable:
    def decorate(command: Callable) -> Callable:
        for option in reversed((*given, *_FORMAT)):
            command = option(command)
        return command

    return decorate


@list_.command(epilog="Example: pbl list subjects --population healthy")
@_options(*_PEOPLE)
def subjects(as_json: bool, as_csv: bool, **restriction: str | None) -> None:
    """The people, with how many visits and videos each has."""
    _print("subjects", restriction, as_json, as_csv)


@list_.command(epilog="Example: pbl list visits --subject P017")
@_options(*_VISITS)
def visits(as_json: bool, as_csv: bool, **restriction: str | None) -> None:
    """The visits, with how many videos and results each has."""
    _print("visits", restriction, as_json, as_csv)


@list_.command(epilog="Example: pbl list changes --subject P017")
@_options(*_PEOPLE)
def changes(as_json: bool, as_csv: bool, **restriction: str | None) -> None:
    """The changes of index and measures between a visit and the one before, and the probability that each is real.

    `not_comparable` states why two visits cannot be compared, such as different camera views.
    """
    _print("changes", restriction, as_json, as_csv)


@list_.command(epilog="Example: pbl list videos --subject P017 --session 2026-03-01 --json")
@_options(*_VISITS, click.option("--activity", help="Of this activity, such as walking."))
def videos(as_json: bool, as_csv: bool, **restriction: str | None) -> None:
    """The videos, with their numbers: which `pbl why`, `pbl choose` and `pbl move` take."""
    _print("videos", restriction, as_json, as_csv)


@list_.command(epilog="Example: pbl list decisions --subject P017 --json")
@_options(*_VISITS)
def decisions(as_json: bool, as_csv: bool, **restriction: str | None) -> None:
    """Decisions on the review page or by `pbl choose`, newest first: by whom, when, and the previous state."""
    _print("decisions", restriction, as_json, as_csv)


@list_.command(epilog="Example: pbl list looks --subject P017 --csv > looks.csv")
@_options(*_VISITS)
def looks(as_json: bool, as_csv: bool, **restriction: str | None) -> None:
    """Looks at recordings on the review page, newest first. Recorded if PBL_AUDIT_LOOKS=1 is set."""
    _print("looks", restriction, as_json, as_csv)


@list_.command(epilog="Example: pbl list methods --stage fit")
@_options(click.option("--stage", metavar="NAME", help="Of this stage, such as keypoint, fit or gait."))
def methods(as_json: bool, as_csv: bool, stage: str | None) -> None:
    """The methods by stage. Options take the key of a method, or its name for the newest version."""
    from pbl_schemas import activate
    from pbl_schemas.reading import registered

    activate()
    _show(registered.method_rows(stage), as_json, as_csv)


def _print(what: str, restriction: dict[str, str | None], as_json: bool, as_csv: bool) -> None:
    from pbl_schemas import activate, session
    from pbl_schemas.reading import registered

    activate(methods=False)
    given = session.as_registered({k: v for k, v in restriction.items() if v is not None})
    _show(getattr(registered, what)(given), as_json, as_csv)


def _show(rows: pd.DataFrame, as_json: bool, as_csv: bool) -> None:
    if as_json and as_csv:
        raise click.UsageError("--json and --csv: choose one.")
    if as_json:
        click.echo(rows.to_json(orient="records", date_format="iso", indent=1))
    elif as_csv:
        from pbl_pipeline.csv_cells import frame_to_csv

        click.echo(frame_to_csv(rows), nl=False)
    elif rows.empty:
        click.echo("none")
    else:
        click.echo(rows.astype(object).where(rows.notna(), "").map(_cell).to_string(index=False))


def _cell(value: Any) -> str:
    return f"{value:%Y-%m-%d %H:%M}" if hasattr(value, "hour") else str(value)
