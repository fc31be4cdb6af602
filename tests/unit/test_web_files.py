"""The review page's own files: texts in both languages, scripts of others as published."""

from __future__ import annotations

import hashlib
import re
import string
from pathlib import Path

from workers.web import texts

WEB = Path(texts.__file__).parent
_PAGES = [*WEB.glob("templates/*.html"), *WEB.glob("*.py")]


def test_every_text_is_in_both_languages_with_the_same_places():
    for name, by_language in texts.catalogue().items():
        assert set(by_language) == set(texts.LANGUAGES), name
        places = {frozenset(p for _, p, _, _ in string.Formatter().parse(t) if p) for t in by_language.values()}
        assert len(places) == 1, name


def test_every_text_that_a_page_names_is_in_the_catalogue():
    named = {n for f in _PAGES for n in re.findall(r"""\bt\("([a-z_]+\.[A-Za-z_]+)"[,)]""", f.read_text())}
    assert len(named) > 40
    assert named <= set(texts.catalogue())


#: Groups and texts that are named by a value: a state, an outcome, a reason, a filter, an event.
_BY_VALUE = re.compile(
    r"(role|state|quality|trend|enter|decided)\.|visits\.(cohort|role|quality|state)|recording\.foot_"
    r"|operate\.(done|empty|pending|reserved|error|waiting|oldest|per_hour|left)$"
    r"|unusable\.|usable\.(yes|no)|byhand\.(automatic|hand)"
)


def test_every_text_of_the_catalogue_is_on_a_page():
    pages = "".join(f.read_text() for f in _PAGES)
    assert not [n for n in texts.catalogue() if not _BY_VALUE.match(n) and not re.search(f"[\"']{n}[\"']", pages)]


def test_scripts_of_others_are_those_that_the_readme_names():
    rows = re.findall(r"^\| `([^`]+)` \|.*\| ([0-9a-f]{64}) \|$", (WEB / "vendor/README.md").read_text(), re.MULTILINE)
    found = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in WEB.glob("vendor/*.min.*")}
    assert dict(rows) == found
    assert len(list(WEB.glob("vendor/*.LICENSE"))) == 2


def test_scripts_of_others_are_named_with_their_versions():
    """A page, or a script of ours, that names a vendored file names one that is there."""
    named = {n for f in [*_PAGES, *WEB.glob("static/*.js")] for n in re.findall(r"/vendor/([\w.-]+)", f.read_text())}
    assert {p.name for p in WEB.glob("vendor/*.min.*")} == named


def test_the_browsers_language():
    assert texts.language_of(None, "de-AT,de;q=0.9,en;q=0.5") == "de"
    assert texts.language_of(None, "fr;q=0.9, en;q=0.5, de;q=0.1") == "en"
    assert texts.language_of("de", "en") == "de"
    assert texts.language_of("xx", ";;;q=x,,") == "en"
