"""`--kind`: which recordings of a visit, where it has several kinds."""

from __future__ import annotations

import click

#: The kinds are `pbl_schemas.fit.KINDS`, which is not imported for the help.
kind_option = click.option(
    "--kind",
    "fit_set_kind",
    type=click.Choice(["single", "rig", "markers"]),
    help="Videos of one camera, trials of several, or markers, where the tables hold several.",
)
