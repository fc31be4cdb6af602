"""The page's texts in its languages, from one catalogue (`texts.toml`)."""

from __future__ import annotations

import functools
import tomllib
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

#: The first is taken where a browser asks for none of them.
LANGUAGES = ("en", "de")


@functools.cache
def catalogue() -> dict[str, dict[str, str]]:
    """Every text by "group.name": language to text."""
    groups = tomllib.loads((Path(__file__).parent / "texts.toml").read_text("utf-8"))
    return {f"{group}.{name}": text for group, names in groups.items() for name, text in names.items()}


def text(language: str, name: str, /, **values: Any) -> str:
    """A text in a language, its {places} filled in. A name that the catalogue lacks is a KeyError."""
    return catalogue()[name][language].format(**values)


def library(language: str, english: str) -> str:
    """What the library says in English, in the language of a page: HTML, marked as English where it stays so."""
    own = catalogue().get(f"library.{english}", {}).get(language)
    if own is not None or language == "en":
        return escape(own or english)
    return Markup('<span lang="en">{}</span>').format(english)


def plain_library(language: str, english: str) -> str:
    """What the library says in English, in the language of a page as plain text; English where there is no other."""
    return catalogue().get(f"library.{english}", {}).get(language, english)


def language_of(cookie: str | None, accepted: str) -> str:
    """The language that a person chose, else the first of ours that her browser prefers."""
    if cookie in LANGUAGES:
        return cookie
    weighed = []
    for place, part in enumerate(accepted[:500].split(",")):
        name, _, quality = part.strip().partition(";q=")
        try:
            weight = float(quality or 1.0)
        except ValueError:
            continue
        weighed.append((-weight, place, name.strip().lower().partition("-")[0]))
    return next((name for _, _, name in sorted(weighed) if name in LANGUAGES), LANGUAGES[0])
