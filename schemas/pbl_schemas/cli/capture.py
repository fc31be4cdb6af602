"""`pbl capture`: links by which phones film for a visit, and the protocols that they lead through."""

from __future__ import annotations

import getpass
from pathlib import Path

import click


@click.group(epilog="Example: pbl capture link --visit 3 --url https://192.168.1.20:8484")
def capture() -> None:
    """Film with the browser of a phone (docs/capture.md): links for a visit, protocols."""


@capture.command(epilog="Example: pbl capture link --visit 3 --url https://192.168.1.20:8484 --protocol clinic")
@click.option("--visit", type=click.IntRange(min=1), required=True, metavar="NUMBER", help="Visit (`pbl list visits`).")
@click.option("--url", required=True, help="Address under which phones reach `pbl web`, as it prints it.")
@click.option("--hours", default=2.0, show_default=True, help="How long the link is good, at most 24.")
@click.option("--protocol", metavar="NAME", help="What the phone's page leads through.")
def link(visit: int, url: str, hours: float, protocol: str | None) -> None:
    """Print a link for one phone as a QR code and as text. It opens once `pbl web` runs at URL."""
    import segno

    import pbl_schemas
    from pbl_schemas.intake.phone_recordings import make_link

    pbl_schemas.activate(methods=False)
    _, key = make_link(visit, getpass.getuser(), hours, protocol)
    address = f"{url.rstrip('/')}/phone/open?key={key}"
    segno.make(address, error="m").terminal(compact=True)
    click.echo(address)


@capture.command(epilog="Example: pbl capture protocol clinic clinic.csv")
@click.argument("name")
@click.argument("sheet", type=click.Path(path_type=Path, dir_okay=False))
def protocol(name: str, sheet: Path) -> None:
    """Register protocol NAME: a row for each step of SHEET (CSV, XLSX), with the columns activity, pace, view (left,
    right, front, any) and passes."""
    import pbl_schemas
    from pbl_schemas.intake.protocols import add_protocol, read_protocol

    pbl_schemas.activate(methods=False)
    new = add_protocol(name, read_protocol(sheet))
    click.echo(f"protocol {name} is registered" if new else f"protocol {name} was registered already")
