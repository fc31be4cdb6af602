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

    A printed table ends after `--limit` rows; `--json` and `--csv` have all.

    Example: pbl list visits --population patient --csv > visits.csv
    """


#: Option of the lists that grow with the recordings.
_LIMIT = click.option("--limit", type=click.IntRange(min=0), default=200, show_default=True, metavar="N",
                      help="Rows of the printed table at most; 0: all.")  # fmt: skip
_FORMAT = (
    click.option("--json", "as_json", is_flag=True, help="Print a JSON list of rows instead of a table."),
    click.option("--csv", "as_csv", is_flag=True, help="Print CSV instead of a table."),
)
_PEOPLE = (
    click.option("--subject", metavar="CODE", help="Of this person."),
    click.option("--population", metavar="NAME", help="Of people of this group."),
    click.option("--project", metavar="NAME", help="Of people of this study or clinic."),
    _LIMIT,
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
def subjects(**given: Any) -> None:
    """The people, with how many visits and videos each has."""
    _print("subjects", **given)


@list_.command(epilog="Example: pbl list visits --subject P017")
@_options(*_VISITS)
def visits(**given: Any) -> None:
    """The visits, with how many videos and results each has."""
    _print("visits", **given)


@list_.command(epilog="Example: pbl list changes --subject P017")
@_options(*_PEOPLE)
def changes(**given: Any) -> None:
    """The changes of index and measures between a visit and the one before, and the probability that each is real.

    `not_comparable` states why two visits cannot be compared, such as different camera views.
    """
    _print("changes", **given)


@list_.command(epilog="Example: pbl list videos --subject P017 --session 2026-03-01 --json")
@_options(*_VISITS, click.option("--activity", help="Of this activity, such as walking."))
def videos(**given: Any) -> None:
    """The videos, with their numbers: which `pbl why`, `pbl choose` and `pbl move` take."""
    _print("videos", **given)


@list_.command(epilog="Example: pbl list decisions --subject P017 --json")
@_options(*_VISITS)
def decisions(**given: Any) -> None:
    """Decisions on the review page or by `pbl choose`, newest first: by whom, when, and the previous state."""
    _print("decisions", **given)


@list_.command(epilog="Example: pbl list looks --subject P017 --csv > looks.csv")
@_options(*_VISITS)
def looks(**given: Any) -> None:
    """Looks at recordings on the review page, newest first. Recorded if PBL_AUDIT_LOOKS=1 is set."""
    _print("looks", **given)


@list_.command(epilog="Example: pbl list methods --stage fit")
@_options(click.option("--stage", metavar="NAME", help="Of this stage, such as keypoint, fit or gait."))
def methods(as_json: bool, as_csv: bool, stage: str | None) -> None:
    """The methods by stage. Options take the key of a method, or its name for the newest version."""
    from pbl_schemas import activate
    from pbl_schemas.reading import registered

    activate()
    _show(registered.method_rows(stage), as_json, as_csv)


def _print(what: str, as_json: bool, as_csv: bool, limit: int, **restriction: str | None) -> None:
    from pbl_schemas import activate, session
    from pbl_schemas.reading import registered

    activate(methods=False)
    given = session.as_registered({k: v for k, v in restriction.items() if v is not None})
    most = None if as_json or as_csv or not limit else limit
    rows = getattr(registered, what)(given, most and most + 1)
    _show(rows[:most], as_json, as_csv)
    if most and len(rows) > most:
        n = registered.total(what, given)
        left = "further rows" if n is None else f"{n - most} further rows"
        click.echo(f"{left} left out: `--limit 0` prints all, `--csv` and `--json` have all", err=True)


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
