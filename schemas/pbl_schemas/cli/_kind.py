"""`--kind`: which recordings of a visit, where it has several kinds."""

from __future__ import annotations

import click

from pbl_pipeline.filming import KINDS

kind_option = click.option(
    "--kind",
    "fit_set_kind",
    type=click.Choice(KINDS),
    help="Videos of one camera, trials of several, or markers, where the tables hold several.",
)
