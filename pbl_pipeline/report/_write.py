"""The page itself."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

from pbl_pipeline.gait import NormativeSet
from pbl_pipeline.report.page import page_of
from pbl_pipeline.report.types import Picture
from pbl_pipeline.visit import Visit


def write_report(
    path: str | Path,
    visit: Visit,
    pictures: Mapping[str, Sequence[Picture]] | None = None,
    title: str = "Gait report",
    norm: NormativeSet | None = None,
) -> Path:
    """Write the report of a visit as one HTML file and return its path.

    The file holds its pictures, charts and styles and asks for nothing from elsewhere, so it can be mailed, printed
    and opened from a folder. Every text is escaped. A visit without gait gives a page that says so and shows the
    angles over time. The file appears when it is complete.

    `pictures`: by the name of the recording. `norm`: the set of the index; None for the one that the measures name,
    where it is one that ships. Raises what `Recording.fit` and `Recording.keypoints` raise.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = resources.files("pbl_pipeline.report").joinpath("templates")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = environment.from_string(folder.joinpath("report.html").read_text(encoding="utf-8"))
    css = Markup(folder.joinpath("report.css").read_text(encoding="utf-8"))  # noqa: S704  our own file
    page = {"tiles": [], "measures": [], "cycle_charts": [], "index": None, "forces": None} | page_of(
        visit, pictures or {}, title, norm
    )
    part = path.with_name(f"{path.name}.part{os.getpid()}")
    try:
        part.write_text(template.render(page=page, css=css), encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path
