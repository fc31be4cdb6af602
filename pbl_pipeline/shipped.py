"""Files that ship with the package: texts, and models whose numbers are JSON."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.bounded import parse_json

if TYPE_CHECKING:
    from jinja2 import Template


def shipped_text(path: str) -> str:
    """Return the text of a file by its path within the package, such as "study/frame_columns.csv"."""
    return resources.files("pbl_pipeline").joinpath(path).read_text(encoding="utf-8")


def shipped_page(path: str) -> Template:
    """Return a page by its path within the package: every text is escaped, and a missing name is an error."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.from_string(shipped_text(path))


def shipped_model(path: str, arrays: Iterable[str]) -> dict[str, Any]:
    """Return the fields of a model, those named in `arrays` as arrays, without `made_by`."""
    data: dict[str, Any] = parse_json(shipped_text(path))
    del data["made_by"]
    return data | {name: np.array(data[name]) for name in arrays}
