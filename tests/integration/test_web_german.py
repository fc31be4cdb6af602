"""German pages are German to the end: no English word is on one but names."""

from __future__ import annotations

import ast
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

import pbl_pipeline.fit
from pbl_pipeline.kinetics import REASONS
from schemas import study
from schemas.intake.conditions import set_condition
from tests.integration import web
from tests.integration.chain import fit_upright, small_video
from tests.rows import register
from workers.populate import populate
from workers.web import texts

#: Attributes that a person reads or hears.
_READ = ("aria-label", "alt", "title", "placeholder", "data-play", "data-pause", "data-text")
#: English words that are German words as well, or names of units and formats.
_BOTH = {"in", "an", "am", "was", "war", "so", "die", "des", "also", "links", "person", "median"}


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


@pytest.fixture(scope="module")
def english() -> set[str]:
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
    return found


@pytest.fixture(scope="module")
def clinic(module_tables: Path, module_patch: pytest.MonkeyPatch) -> None:
    """P001 at three visits, one not computed; a chair test, nobody, two people alike, and a person chosen by hand."""
    module_patch.setattr(pbl_pipeline.fit, "fit_session", fit_upright)
    for name, day in (("gang", "2026-01-10"), ("gang zwei", "2026-04-10")):
        register(small_video(module_tables, name), session_label=day, mass_kg=70.5)
    chair = register(small_video(module_tables, "stuhl"), subject="P002", session_label="2026-02-01")
    set_condition(chair[0], activity="sit_to_stand")
    register(small_video(module_tables, "leer", people="nobody"), subject="P003", session_label="2026-02-02")
    register(small_video(module_tables, "zwei", people="two alike"), subject="P004", session_label="2026-02-03")
    populate()
    register(small_video(module_tables, "neu"), session_label="2026-09-10")
    study.ClinicalScore.insert({"session_id": i, "instrument": "mJOA", "score_value": 12 + i} for i in (1, 2))


NAMES = (
    r"R\. Viewer|P00\d|pbl( \w+)*|blazepose[\w-]*|phase-transformer[\w-]*|gillette[\w-]*|mJOA(-LE)?|GDI|PBL [\w.+]+|"
    r"(gang|stuhl|leer|neu|zwei)[\w ]*(\.mp4)?|JSON|csv|trc|mot|zip|Timed Up and Go|Four Square Step Test|"
    r"Schwartz et al\. 2008|"
    r"csv|pre|baseline|\d+_\w+|Worker|Video_ID|WebGL|[A-Z]\w+[a-z][A-Z]\w+|Tracking|Keypoints|--[\w-]+"
)


@pytest.mark.parametrize(
    "path",
    [
        "/visits",
        "/visits?quality=nonsense",
        *(f"/visits/{n}" for n in range(1, 7)),
        *(f"/visits/{n}/letter" for n in range(1, 7)),
        "/visits/1/trend",
        "/visits/1/trend?measure=step_time_s",
        "/visits/1/enter",
        *(f"/recordings/{n}" for n in range(1, 7)),
        "/compare?v=1&v=2",
        "/compare?v=1",
        "/instruments",
        "/operate",
        "/visits/99",
        "/recordings/99",
        "/nowhere",
    ],
)
def test_a_german_page_has_no_english_word(clinic: None, english: set[str], path: str):
    browser = web.client(role="reviewer,operator")
    browser.headers["accept-language"] = "de"
    page = browser.get(path)
    assert 'lang="de"' in page.text
    assert not english_of(page.text, english, NAMES)


def test_refusals_of_forms_are_german(clinic: None, english: set[str]):
    browser = web.client(role="reviewer,operator")
    browser.headers["accept-language"] = "de"
    long, fields = "x" * 300, ("instrument", "instrument_name", "instrument_unit", "instrument_low", "minimal_change")
    for values in (
        {},
        dict.fromkeys(fields, long),
        dict.fromkeys(fields, "-1,5"),
        {"instrument": "BBS", "ordinal": "?"},
    ):
        page = web.post(browser, "/instruments", **values).text
        assert page.count('class="problem"') >= 3
        assert not english_of(page, english, NAMES + r"|instrument\w*|x{3,}|minimal_\w+"), values
    seen = re.search(r'name="seen" value="([^"]+)"', browser.get("/visits/1/enter").text)
    assert seen is not None
    for value in ("99", "-1", "viel", "12.5", "nan"):
        page = web.post(browser, "/visits/1/enter", seen=seen[1], **{"value:mJOA": value}).text
        assert 'class="problem"' in page, value
        assert not english_of(page, english, NAMES + "|viel|nan|score"), value


def advice() -> dict[str, str]:
    """Advice of every check in the library and the tables, with {place} for what is filled in, and where it stands."""
    root, found = Path(pbl_pipeline.__file__).parent.parent, {}

    def of(node: ast.expr) -> list[str]:
        if isinstance(node, ast.Constant):
            return [str(node.value)]
        if isinstance(node, ast.JoinedStr):
            return ["".join(v.value if isinstance(v, ast.Constant) else "0.5" for v in node.values)]  # type: ignore[misc]
        if isinstance(node, ast.IfExp):
            return [*of(node.body), *of(node.orelse)]
        return []  # made elsewhere

    for file in (f for room in ("pbl_pipeline", "schemas") for f in sorted((root / room).rglob("*.py"))):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Check" and len(node.args) > 4:
                found |= {text: file.name for text in of(node.args[4]) if text}
    return found


def test_the_advice_of_every_check_has_its_german(english: set[str]):
    every = advice()
    assert len(every) > 25
    untold = {text: file for text, file in every.items() if "<span" in texts.library("de", text)}
    # The advice about the far leg names a side and is written out for both.
    assert not {t: f for t, f in untold.items() if "leg was behind the" not in t}


@pytest.mark.parametrize("code", REASONS)
def test_the_reason_for_missing_forces_has_its_german(code: str):
    assert texts.library_words("de", REASONS[code]) != REASONS[code]
