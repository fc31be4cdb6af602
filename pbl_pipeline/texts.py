"""The texts of pages and reports in their languages, from one catalogue (`texts.toml`)."""

from __future__ import annotations

import functools
import html
import re
import string
import tomllib
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from pbl_pipeline.errors import CODES, Said
from pbl_pipeline.words import capital

#: The first is the default.
LANGUAGES = ("en", "de")
_NUMBER = re.compile(r"[-+\N{MINUS SIGN}]?\d+([.,]\d+)?(e[-+]?\d+)?%?")
#: A text with this many letters outside its places is used even if a place stays English.
_LEAST = 12
#: Text between two marks of a chart.
_TEXT = re.compile(r">[^<]+<")
#: Between the words of a list.
_LIST = re.compile(r"(, |; )")
_POINT, _PERCENT = re.compile(r"(?<=\d)\.(?=\d)"), re.compile(r"(?<=\d)%")
#: A command or its option, and one in brackets behind what it does.
_COMMAND = re.compile(r"\bpbl [a-z]|(?<![\w-])--[a-z]")
_IN_BRACKETS = re.compile(r" \((?:--|pbl )[^()]*\)")
#: The code of an error before what was found: of use to engineers, not on a page.
_CODED = re.compile(r"\b([A-Z][A-Z0-9_]+): ")
#: A place of a text, and what needs a language outside of places.
_PLACE, _WORDS = re.compile(r"\{\w*\}"), re.compile(r"[^\W\d_]")
#: How a place of a text shows its value.
_SPEC = re.compile(r":[^{}]*(?=\})")
#: Tags of a page, and its parts that are not read or are marked as names.
_TAGS = re.compile(r'(?s)(<style>.*?</style>|<b translate="no">.*?</b>|<[^>]+>)')
_LABELS = re.compile(r'(?<= (?:aria-label|data-label)=")[^"]+(?=")|(?<= alt=")[^"]+(?=")')
_SENTENCES = re.compile(r"(?<=[.!?]) (?=[A-Z0-9])")


@functools.cache
def catalogue() -> dict[str, dict[str, str]]:
    """Every text by "group.name": language to text. The English of the library is its own words where none is given."""
    groups = tomllib.loads((Path(__file__).parent / "texts.toml").read_text("utf-8"))
    for of_code in ("library", "said"):
        groups[of_code] = {name: {"en": name, **own} for name, own in groups[of_code].items()}
    return {f"{group}.{name}": text for group, names in groups.items() for name, text in names.items()}


def text(language: str, name: str, /, **values: Any) -> str:
    """A text in a language, its {places} filled in. A name that the catalogue lacks is a KeyError."""
    return catalogue()[name][language].format(**values)


@functools.cache
def _words(kind: str) -> dict[str, str]:
    """Every word of a kind of codes, in all languages and as the code itself -> its code."""
    of_kind = {
        n.removeprefix(f"coded.{kind}_"): said for n, said in catalogue().items() if n.startswith(f"coded.{kind}_")
    }
    spoken = {_folded(word): code for code, said in of_kind.items() for word in "|".join(said.values()).split("|")}
    return spoken | {_folded(code): code for code in of_kind}


def _folded(words: str) -> str:
    return " ".join(words.casefold().replace("_", " ").replace("-", " ").split())


def codes(kind: str) -> tuple[str, ...]:
    """Return the codes of a kind ("aid", "orthosis", "population", "role", "pace", "activity") that have words."""
    return tuple(dict.fromkeys(_words(kind).values()))


def code_of(kind: str, words: str) -> str:
    """Return the code that words of any language state, such as "walker" of "Rollator", "6_weeks" of "6 Wochen"; other
    words as they are."""
    folded = _folded(words)
    number, _, unit = folded.partition(" ")
    if kind == "role" and re.fullmatch("[0-9]{1,4}", number) and unit in _words("unit"):
        return f"{int(number)}_{_words('unit')[unit]}{'' if int(number) == 1 else 's'}"
    return _words(kind).get(folded, words)


def coded(language: str, kind: str, code: str) -> str:
    """Return the words of a code in a language; a code without words as it is."""
    number, _, unit = code.partition("_")
    if kind == "role" and number.isdigit() and (one := _words("unit").get(unit)) is not None:
        return f"{number} {catalogue()[f'coded.unit_{one}'][language].split('|')[int(number) != 1]}"
    return catalogue().get(f"coded.{kind}_{code}", {}).get(language, code).split("|")[0]


def library_words(language: str, english: str) -> str:
    """Return an English text of the library in a language, unchanged if it is not in the catalogue."""
    found = _own_words(language, english)
    return english if found is None else found


def _own_words(language: str, english: str) -> str | None:
    """`_library_words`; a text of `errors.said` by its template: its names stay, its numbers and own texts do not."""
    if isinstance(english, Said):
        name = bare(english.template)
        own = catalogue().get(f"said.{name}") or catalogue().get(f"library.{name}")
        template = own[language] if own else name
        if own or (english.values and not _WORDS.search(_PLACE.sub("", name))):  # one that only joins has no language
            return template.format(**{place: _value(language, english, place) for place in english.values})
    return _library_words(language, str(english))


def bare(template: str) -> str:
    """Return a text with its places as the catalogue names it: "{s:.2f} s" as "{s} s"."""
    return _SPEC.sub("", template)


def _value(language: str, text: Said, name: str) -> str:
    """Return a value of a text as the text shows it, in a language."""
    value = text.values[name]
    if isinstance(value, str):
        return library_words(language, value) if isinstance(value, Said) else value
    spec = next((spec for _, field, spec, _ in string.Formatter().parse(text.template) if field == name), "")
    return decimals(language, format(value, spec or ""))


@functools.lru_cache(4096)
def _library_words(language: str, english: str) -> str | None:
    if english in CODES:
        return english
    own = catalogue().get(f"library.{english}", {}).get(language)
    if own is not None:
        return own
    for at in (m.start() for m in re.finditer(r" \(", english) if english.endswith(")")):
        # A check, followed in brackets by its recording or by a reason, which has several words.
        if (own := catalogue().get(f"library.{english[:at]}", {}).get(language)) is not None:
            inner = english[at + 2 : -1]
            return f"{own} ({library_words(language, inner) if ' ' in inner else inner})"
    for joint in (": ", "; "):
        for at in (m.start() for m in re.finditer(joint, english)):
            first, rest = english[:at], _library_words(language, english[at + len(joint) :])
            # Before a colon a single word may be the name of a recording, and one that stands for others surely is.
            name = first if joint == ": " and " " not in first else None
            stands = name and catalogue().get(f"library.{name}", {}).get("en", name) != name
            parts = name if stands else _library_words(language, first) or name, rest
            if parts[0] is not None and parts[1] is not None:
                return joint.join(p for p in parts if p is not None)
    best = None
    for pattern, own in _patterns(language):
        if (match := pattern.fullmatch(english)) is None:
            continue
        places = match.groupdict()
        made = _filled(language, match, own)
        # A place that is neither known nor a single word may be a wrong split of the text: another pattern may fit.
        if all(" " not in v or _library_words(language, v) is not None for v in places.values()):
            return made
        best = best or (made if len(re.sub(r"\{\w+\}", "", own)) >= _LEAST else None)
    if best is not None:
        return best
    return decimals(language, english) if _NUMBER.fullmatch(english) else None


def _filled(language: str, places: re.Match[str], own: str) -> str:
    """Return a text with its places filled in."""
    return own.format(**{name: _in_place(language, value) for name, value in places.groupdict().items()})


def _in_place(language: str, value: str) -> str:
    """Return what fills a place; of a list whose words are all known, each in the language."""
    whole = library_words(language, value)
    parts = _LIST.split(value)
    words = [_library_words(language, part) for part in parts[::2]] if whole == value else [None]
    if None in words:
        return whole
    parts[::2] = words
    return "".join(map(str, parts))


@functools.cache
def _patterns(language: str) -> tuple[tuple[re.Pattern[str], str], ...]:
    """The library's texts with places, those with the longest fixed text first."""
    texts = catalogue().items()
    names = (n.removeprefix("library.") for n, said in texts if "library." in n[:8] and "{" in n and language in said)
    of_words = sorted(names, key=lambda n: -len(re.sub(r"\{\w+\}", "", n)))
    made = [(re.sub(r"\\\{(\w+)\\\}", r"(?P<\1>.+?)", re.escape(n)), n) for n in of_words]
    return tuple((re.compile(p, re.DOTALL), catalogue()[f"library.{n}"][language]) for p, n in made)


def decimals(language: str, text: str) -> str:
    """Return a text with the decimal and percent signs of the language."""
    return _PERCENT.sub("\N{NO-BREAK SPACE}%", _POINT.sub(",", text)) if language == "de" else text


def in_chart(language: str, chart: Markup) -> Markup:
    """Return a chart whose numbers have the decimals of a language."""
    return Markup(_TEXT.sub(lambda m: decimals(language, m[0]), chart))  # noqa: S704  it was escaped when it was drawn


def page_in(language: str, page: str) -> str:
    """Return a page that the library wrote, its texts and labels in a language; unknown ones stay as they are."""
    parts = _TAGS.split(page)
    parts[::2] = [_said(language, text) for text in parts[::2]]
    parts[1::2] = [_LABELS.sub(lambda m: _said(language, m[0]), tag) for tag in parts[1::2]]
    return "".join(parts)


def _said(language: str, escaped: str) -> str:
    """Return an escaped text in a language: as a whole, else sentence by sentence."""
    text = " ".join(html.unescape(escaped).split())
    if not text:
        return escaped
    parts = [text] if f"library.{text}" in catalogue() else _SENTENCES.split(text)
    said = [_sentence(language, part) for part in parts]
    own = _sentence(language, text) if None in said else None
    own = own or " ".join(new or part for new, part in zip(said, parts, strict=True))
    before, after = (" " if edge.isspace() else "" for edge in (escaped[0], escaped[-1]))
    return f"{before}{escape(own)}{after}"


def _sentence(language: str, text: str) -> str | None:
    """Return a text of the library in a language, which here may begin with a capital and end with a stop."""
    if not any(c.isalpha() for c in text):
        return decimals(language, text)
    stops = (pattern for pattern, _ in _patterns(language) if pattern.pattern.endswith(r"\."))
    if f"library.{text}" in catalogue() or any(pattern.fullmatch(text) for pattern in stops):
        return _library_words(language, text)
    bare = text.removesuffix(".")
    if (own := _library_words(language, bare)) is not None:
        return own + text[len(bare) :]
    own = _library_words(language, bare[0].lower() + bare[1:])
    return None if own is None else capital(own) + text[len(bare) :]


def library(language: str, english: str) -> str:
    """Return an English text of the library in the language of a page: HTML, marked as English if it stays so."""
    own = _own_words(language, english)
    if own is not None or language == "en":
        return escape(own or str(english))
    return Markup('<span lang="en">{}</span>').format(english)


def on_page(language: str, english: str, click: bool = True) -> Markup:
    """Return a text as `library` does, without codes of errors and without the sentences that name a command, instead
    of which a page says what to click; not with `click` False, where links say it."""
    if isinstance(english, Said) and (own := _own_words(language, english)) is not None:
        return escape(_uncoded(own))
    english = _uncoded(str(english))
    shown = Markup(_IN_BRACKETS.sub("", library(language, english)))  # noqa: S704  it is escaped already
    if not _COMMAND.search(shown):
        return shown
    parts = re.split(r"(?<=[.;]) |(?<=:) (?=`?pbl )|, (?=then `?pbl )", english)
    kept = " ".join(part for part in parts if not _COMMAND.search(part)).rstrip(" ;:").removesuffix("; next")
    if kept:
        kept = library(language, kept) + ("" if kept.endswith((".", "!", "?")) else ".")
    return Markup(" ").join(part for part in (kept, text(language, "error.click") if click else "") if part)


def _uncoded(text: str) -> str:
    return _CODED.sub(lambda found: "" if found[1] in CODES else found[0], text)


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
