"""Look at a recording: its video, the fitted body, curves and events on one time line."""

from __future__ import annotations

import re

from starlette.routing import Route

from .pages import Pages
from .tables import Tables
from .videos import Videos

_OWN = re.compile(r"/(visits|recordings)(/\d{1,10})?")


def routes(pages: Pages, tables: Tables, videos: Videos) -> list[Route]:
    """The addresses of this part."""
    return []


def own_address(text: str) -> str:
    """An address of this page that a form names, else the list's."""
    return text if _OWN.fullmatch(text) else "/visits"
