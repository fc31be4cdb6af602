"""The English that is left on a German page."""

import functools
import json
import re
from html.parser import HTMLParser

from pbl_pipeline import texts

#: Attributes that a person reads or hears.
_READ = ("aria-label", "alt", "title", "placeholder", "data-play", "data-pause", "data-text", "data-failed",
         "data-checked")  # fmt: skip
#: English words that are German words as well, or names of units and formats.
_BOTH = {"in", "an", "am", "was", "war", "so", "die", "des", "also", "links", "person", "median"}

#: Names on a report: of methods, files and sources.
REPORT_NAMES = (
    r"demo|sports2d-demo|\bwalk(\.mp4)?\b|blazepose\S*|\S+-transformer\S*|gillette\S*|gauss-newton|pbl-\S+|PBL\S* \S+"
    r"|[A-Za-z]\w*\.\w+|Gillette Children's Specialty Healthcare|MIT \(c\)"
    r"|Gait (&|Deviation Index|Profile Score)|cpu"
    r"|The effect of walking speed on the gait of typically .* children|Plug-in Gait|\[\w+\]|Kalman|GDI|SHA-256"
    r"|\d+\.\d+\.\d+\+g[0-9a-f]+"
)


class _Reader(HTMLParser):
    """The texts of a page, without scripts, styles and what is marked as a name (translate="no", code)."""

    _VOID = frozenset({"meta", "link", "input", "img", "br", "rect", "circle", "line"})

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self._hidden: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        hides = tag in ("script", "style", "code", "video") or given.get("translate") == "no"
        other = given.get("lang") not in (None, "de")  # such as the button that changes the language
        if self._hidden or hides or (other and tag in ("button", "input")):
            if tag not in self._VOID:
                self._hidden.append(tag)
            return
        self.texts += [text for name in _READ if (text := given.get(name))]
        said = json.loads(given.get("data-said") or "{}")  # by the script of the page
        self.texts += [by_language["de"] for by_language in said.values()]
        if other and tag != "html":
            self.texts.append(f"<{tag} lang={given['lang']}>")

    def handle_endtag(self, tag: str) -> None:
        if self._hidden and tag in self._hidden:
            while self._hidden.pop() != tag:
                pass

    def handle_data(self, data: str) -> None:
        if not self._hidden and data.strip():
            self.texts.append(data)


def words(text: str) -> set[str]:
    return set(re.findall(r"[a-zäöüß]+", text.lower()))


@functools.cache
def english_words() -> set[str]:
    """Words of the English texts that no German text has."""
    of: dict[str, set[str]] = {"en": set(), "de": set()}
    for name, text in texts.catalogue().items():
        of["en"] |= words(text.get("en", name.removeprefix("library.")))
        of["de"] |= words(text["de"])
    return {w for w in of["en"] - of["de"] - _BOTH if len(w) > 1}


def english_of(page: str, english: set[str], names: str) -> list[str]:
    """Texts of a page with an English word or a decimal point that belongs to no name."""
    reader = _Reader()
    reader.feed(page)
    found = []
    for text in reader.texts:
        own = re.sub(names, " ", text)
        if (words(own) & english) or re.search(r"(?<![\d.])\d+\.\d+(?![\d.])", own) or own.startswith("<"):
            found.append(" ".join(text.split()))
        elif found and found[-1].startswith("<"):
            found[-1] += text  # what is marked
    return found
