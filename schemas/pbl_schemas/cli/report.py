"""`pbl report`: files for people about a visit in the tables."""

from __future__ import annotations

from pathlib import Path

import click

from pbl_pipeline.cli.options import LANGUAGE

from ._kind import kind_option


@click.command(epilog="Example: pbl report --subject P017 --session 2026-03-01 --out P017")
@click.option("--subject", required=True, help="Code of the subject.")
@click.option("--session", "session_label", help="Date or label of the visit; needed where the subject has several.")
@click.option("--fit-method", help="Name of the fit method; needed where several were used.")
@kind_option
@LANGUAGE
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the files.")
def report(language: str, out: Path, **named: str | None) -> None:
    """Write report.html, overlay videos, angles and events of one visit from the tables."""
    import pbl_schemas
    from pbl_pipeline.files import check_out_folder
    from pbl_schemas.reading.visits import write_visit

    check_out_folder(out)
    pbl_schemas.activate(methods=False)
    for path in write_visit({k: v for k, v in named.items() if v is not None}, out, language):
        click.echo(path)
