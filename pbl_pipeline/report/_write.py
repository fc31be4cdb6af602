"""The page itself."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

from pbl_pipeline.report._page import page_of
from pbl_pipeline.report._types import SessionReport


def write_report(path: str | Path, report: SessionReport) -> Path:
    """Write the report of a session as one HTML file and return its path.

    The file holds its pictures, charts and styles and asks for nothing from elsewhere, so it can be mailed, printed
    and opened from a folder. Every text is escaped. A session without gait gives a page that says so and shows the
    angles over time. The file appears when it is complete.

    Raises
    ------
    PblError
        FILE_FORMAT where `report.metrics` is not of the fits in `report.trials`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = resources.files("pbl_pipeline.report").joinpath("templates")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = environment.from_string(folder.joinpath("report.html").read_text(encoding="utf-8"))
    css = Markup(folder.joinpath("report.css").read_text(encoding="utf-8"))  # noqa: S704  our own file
    page = {"tiles": [], "measures": [], "cycle_charts": [], "index": None} | page_of(report)
    part = path.with_name(f"{path.name}.part{os.getpid()}")
    try:
        part.write_text(template.render(page=page, css=css), encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path
