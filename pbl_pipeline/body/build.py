"""Write the body's MJCF and the BML-MoVi marker table from the figures.

    python -m pbl_pipeline.body.build FIGURES.json

The two files under `data/` are part of the project; this command is needed only when the figures or the shapes change.
The body's SHA-256 changes with them, and every fit names the SHA-256 it was made with.
"""

from __future__ import annotations

import json
from pathlib import Path

import click

from pbl_pipeline.body._build import body_xml, marker_csv


@click.command()
@click.argument("figures", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path(__file__).parent / "data",
    show_default="the package's data folder",
    help="Folder the two files are written to.",
)
def build(figures: Path, out: Path) -> None:
    """Write pbl_body_40.xml and markers_bml_movi_87.csv from FIGURES (body_model_figures.json).

    Example: python -m pbl_pipeline.body.build body_model_figures.json
    """
    data = json.loads(figures.read_text(encoding="utf-8"))
    out.mkdir(parents=True, exist_ok=True)
    for name, text in (("pbl_body_40.xml", body_xml(data)), ("markers_bml_movi_87.csv", marker_csv(data))):
        (out / name).write_text(text, encoding="utf-8")
        click.echo(out / name)


if __name__ == "__main__":
    build()
