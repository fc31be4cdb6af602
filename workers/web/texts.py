"""The page's texts in its languages, from one catalogue (`texts.toml`)."""

from __future__ import annotations

import functools
import re
import tomllib
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

#: The first is taken where a browser asks for none of them.
LANGUAGES = ("en", "de")
#: A command or its option, and one in brackets behind what it does.
_COMMAND = re.compile(r"\bpbl [a-z]|(?<![\w-])--[a-z]")
_IN_BRACKETS = re.compile(r" \((?:--|pbl )[^()]*\)")


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


def on_page(language: str, english: str) -> Markup:
    """Return what the library says as `library` does, without what names a command: a page says what to click."""
    shown = Markup(_IN_BRACKETS.sub("", library(language, english)))  # noqa: S704  it is escaped already
    if not _COMMAND.search(shown):
        return shown
    kept = " ".join(part for part in re.split(r"(?<=[.;]) ", english) if not _COMMAND.search(part)).rstrip(" ;")
    return Markup("{} {}").format(library(language, kept), text(language, "error.click"))


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
