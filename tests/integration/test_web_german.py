"""German pages are German to the end: no English word is on one but names."""

import ast
import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_pipeline import texts
from pbl_pipeline.errors import CALL, CODES
from pbl_pipeline.kinetics import REASONS
from pbl_schemas import session, study
from pbl_schemas.intake.records import set_condition
from pbl_schemas.video import Video
from pbl_workers.populate import populate
from pbl_workers.web.remedies import AT_THE_MACHINE, IN_WORDS, WAYS, remedies
from tests import not_none
from tests.german import english_of, english_words
from tests.html_page import Page, commands_in
from tests.integration import web
from tests.integration.chain import fit_upright, replace, small_video
from tests.rows import register
from tests.source import ROOT, files, nodes
from tests.videos import constant_rate, numbered_frames, write_video


@pytest.fixture(scope="module")
def english() -> set[str]:
    return english_words()


@pytest.fixture(scope="module")
def clinic(module_tables: Path, module_patch: pytest.MonkeyPatch) -> None:
    """P001 at three visits, one not computed; a chair test, nobody, two people alike, a screen recording, a film."""
    replace(module_patch, fit_session=fit_upright)
    for name, day in (("gang", "2026-01-10"), ("gang zwei", "2026-04-10")):
        register(small_video(module_tables, name), session_label=day, mass_kg=70.5)
    chair = register(small_video(module_tables, "stuhl"), subject="P002", session_label="2026-02-01")
    set_condition(chair[0], activity="sit_to_stand")
    register(small_video(module_tables, "leer", people="nobody"), subject="P003", session_label="2026-02-02")
    register(small_video(module_tables, "zwei", people="two alike"), subject="P004", session_label="2026-02-03")
    of_screen = (np.pad(f, ((20, 20), (0, 0), (0, 0))) for f in numbered_frames(60, 72, 128))
    film = write_video(module_tables / "schirm.mp4", of_screen, constant_rate(60))
    register(film, subject="P005", session_label="2026-02-04")
    populate()
    register(small_video(module_tables, "neu"))  # of a visit without a label
    scores = {"mJOA": 12, "10MWT_m_per_s": 1.0}
    study.ClinicalScore.insert(
        {"session_id": i, "instrument": name, "score_value": value + i}
        for name, value in scores.items()
        for i in (1, 2)
    )


NAMES = (
    r"R\. Viewer|P00\d|pbl( \w+)*|blazepose[\w-]*|phase-transformer[\w-]*|gillette[\w-]*|mJOA(-LE)?|GDI|PBL [\w.+]+|"
    r"\b(gang|stuhl|leer|neu|zwei|schirm)[\w ]*(\.mp4)?|JSON|csv|trc|mot|zip|Version \d[\w.+]+|Timed Up and Go|"
    r"Four Square Step Test|Schwartz et al\. 2008|"
    r"csv|pre|baseline|\d+_\w+|Worker|Video_ID|WebGL|[A-Z]\w+[a-z][A-Z]\w+|Tracking|Keypoints"
)


@pytest.mark.parametrize("page", ["", "/letter"])
def test_a_visit_without_walking_says_so_once_and_shows_its_task(clinic: None, page: str):
    number = (session.Session & {"subject": "P002"}).fetch1("session_id")
    shown = web.client().get(f"/visits/{number}{page}").text
    assert shown.count("no recording of walking at the pace self-selected (there are: sit to stand)") <= 4
    assert "Stride time" not in shown
    assert "typically developing" not in shown
    assert shown.count("these times are shorter than those of a stopwatch") == 1
    walked = web.client().get(f"/visits/1{page}").text
    assert "Stride time" in walked


PAGES = [
    "/visits",
    "/visits?quality=nonsense",
    *(f"/visits/{n}" for n in range(1, 8)),
    *(f"/visits/{n}/letter" for n in range(1, 8)),
    "/visits/1/trend",
    "/visits/1/trend?measure=step_time_s",
    "/visits/new",
    *(f"/visits/{n}/{form}" for n in (1, 7) for form in ("enter", "facts", "upload")),
    *(f"/recordings/{n}" for n in range(1, 8)),
    "/compare?v=1&v=2",
    "/compare?v=1",
    "/compare?v=1&v=7",
    "/instruments",
    "/operate",
    "/visits/99",
    "/recordings/99",
    "/nowhere",
]


@pytest.mark.parametrize("path", PAGES)
def test_a_german_page_has_no_english_word_and_none_names_a_command(clinic: None, english: set[str], path: str):
    browser = web.client(role="reviewer,operator")
    pages = {language: browser.get(path, headers={"accept-language": language}).text for language in texts.LANGUAGES}
    assert 'lang="de"' in pages["de"]
    assert not english_of(pages["de"], english, NAMES + r"|VIDEO_SCREEN|\S+/store" * (path == "/operate"))
    for page in pages.values():
        assert not commands_in(page)


@pytest.mark.parametrize("path", [p for p in PAGES if p not in ("/operate", "/instruments")])
def test_no_page_shows_the_name_of_a_value_in_tables(clinic: None, path: str):
    for language in texts.LANGUAGES:
        page = Page(web.client().get(path, headers={"accept-language": language}).text)
        own = [re.sub(r"(leer|zwei)_\w+", "", text) for text in page.texts]  # the names of recordings
        assert not [text for text in own if re.search(r"[a-z0-9]_[a-z]", text)]


def test_what_an_error_or_a_check_asks_for_is_a_link_to_where_it_is_done(clinic: None):
    """Choosing the person, another recording, the mark, the height; in both languages, and not for who may not."""
    number = {s: int((session.Session & {"subject": s}).fetch1("session_id")) for s in ("P004", "P005")}
    video = {s: int((Video & {"session_id": n}).fetch1("video_id")) for s, n in number.items()}
    asked = {
        f"/visits/{number['P004']}": [("decide.person", f"/recordings/{video['P004']}#decide")],
        f"/recordings/{video['P004']}": [("decide.person", f"/recordings/{video['P004']}#decide")],
        f"/visits/{number['P005']}": [
            ("upload.open", f"/visits/{number['P005']}/upload"),
            ("usable.mark", f"/recordings/{video['P005']}#usable"),
        ],
        f"/recordings/{video['P005']}": [("upload.open", f"/visits/{number['P005']}/upload")],
        "/visits/1": [("register.facts", "/visits/1/facts")],
        f"/visits/{number['P005']}/report": [("film.back", f"/visits/{number['P005']}"), ("visits.title", "/visits")],
    }
    browser, reader = web.client(), web.client(role="reader")
    for (page, links), language in itertools.product(asked.items(), texts.LANGUAGES):
        shown = {b: b.get(page, headers={"accept-language": language}).text for b in (browser, reader)}
        said = re.findall(r'<(?:p|dd)(?! class="buttons)[^>]*>.*?</(?:p|dd)>', shown[browser])
        for words, address in links:
            link = f'<a href="{address}">{texts.text(language, words)}</a>'
            assert any(link in one for one in said), (page, link)
            place, _, anchor = address.partition("#")
            assert not anchor or f'id="{anchor}"' in browser.get(place).text
        if "film.back" not in dict(links):
            assert texts.text(language, "error.click") not in "".join(s for s in said if "problem" in s), page
        if page != "/visits/1":
            assert not any(f'{a}">{texts.text(language, w)}</a></p>' in shown[reader] for w, a in links)


def test_pages_of_a_phone_and_without_a_session_are_german(clinic: None, english: set[str]):
    browser, phone = web.client(), web.client(signed_in=False)
    for one in (browser, phone):
        one.headers["accept-language"] = "de"
    refused = phone.get("/visits").text
    link = web.post(browser, "/visits/1/film", hours="2").text
    address, key = not_none(re.search(r"(/phone/open\?key=([\w-]+))", link)).groups()
    before = phone.get(address).text
    page = phone.post("/phone/open", data={"key": key}).text
    assert "data-said" in page
    assert "Aufstehen vom Stuhl" in page  # a step of a protocol
    for text in (refused, link, before, page, phone.get("/phone/open?key=another").text):
        assert 'lang="de"' in text
        assert not english_of(text, english, NAMES + r"|http\S+")


def test_refusals_of_registration_and_upload_are_german(clinic: None, english: set[str]):
    browser = web.client()
    browser.headers["accept-language"] = "de"
    token, long = web.token(browser), "x" * 300
    seen = not_none(re.search(r'name="seen" value="([^"]+)"', browser.get("/visits/1/facts").text))
    stated = {"height_m": "172", "mass_kg": "viel", "population": long, "assistive_device": long}
    pages = [
        web.post(browser, "/visits/new", subject="P001", visit="2026-01-10").text,
        web.post(
            browser, "/visits/new", **dict.fromkeys(("subject", "visit", "date", "role", "population"), long)
        ).text,
        web.post(browser, "/visits/new", subject="p1", visit="x", height_m="1,7x", date="31.2.2026").text,
        web.post(browser, "/visits/1/facts", seen=seen[1], **stated).text,
        web.post(browser, "/visits/1/facts", seen="alt", height_m="1,7").text,
    ]
    photo = b"\0\0\0\x18ftypheic" + bytes(500)
    for name, content in (
        ("IMG_1.HEIC", photo),
        ("IMG_1.mov", photo),
        ("neu.txt", b"x"),
        ("neu.mp4", b""),
        ("neu.mp4", b"x"),
    ):
        sent = {"token": token, "activity": "walking", "pace": ""}
        pages.append(browser.post("/visits/1/upload", data=sent, files=[("files", (name, content))]).text)
    for page in pages:
        assert 'class="problem"' in page or 'role="alert"' in page or "DECIDED_MEANWHILE" in page
        assert not english_of(page, english, NAMES + r"|x{3,}|IMG_1\.\w+|neu\.\w+|\.\w+|p1|1,7x|viel")


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
    seen = not_none(re.search(r'name="seen" value="([^"]+)"', browser.get("/visits/1/enter").text))
    contradict = {"value:mJOA": "2", "value:mJOA-LE": "3"}, {"value:10MWT_s": "1,5", "value:10MWT_m_per_s": "2"}
    for value in (*({"value:mJOA": v} for v in ("99", "-1", "viel", "12.5", "nan")), *contradict):
        page = web.post(browser, "/visits/1/enter", seen=seen[1], **value).text
        assert 'class="problem"' in page, value
        assert not english_of(page, english, NAMES + "|viel|nan|score"), value


class _Forms(HTMLParser):
    """The forms of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[_Form] = []
        self._list = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {k: v or "" for k, v in attrs}
        name, kind = given.get("name", ""), given.get("type", "text")
        if tag == "form":
            self.found.append(_Form(given.get("action", ""), given.get("method", "get"), "enctype" in given))
        elif not self.found:
            return
        elif tag == "option" and "selected" in given and self._list:
            self.found[-1].fields[self._list] = given["value"]
        elif tag in ("input", "select", "textarea") and name and kind not in ("file", "checkbox"):
            self._list = name if tag == "select" else ""
            self.found[-1].fields[name] = given.get("value", "")
            if kind != "hidden":
                self.found[-1].asked.append(name)
        elif tag == "button" and name:
            self.found[-1].fields.setdefault(name, given.get("value", ""))


@dataclasses.dataclass
class _Form:
    """Where a form goes, its fields as they are, and the names of those that a person fills in."""

    action: str
    method: str
    of_files: bool
    fields: dict[str, str] = dataclasses.field(default_factory=dict)
    asked: list[str] = dataclasses.field(default_factory=list)


@pytest.mark.long
@pytest.mark.parametrize(
    "path",
    ["/visits", "/visits/new", "/visits/1", "/visits/1/facts", "/visits/1/upload", "/visits/1/enter", "/visits/1/trend",
     "/instruments", "/recordings/1"],
)  # fmt: skip
def test_any_value_of_any_field_is_taken_or_refused_beside_it(clinic: None, english: set[str], path: str):
    """The last test here: what is taken is another clinic. Empty, too long, of a wrong kind, out of range, with
    decimals of either language, twice."""
    browser = web.client(role="reviewer,operator")
    browser.headers["accept-language"] = "de"
    bad = [[""], ["x" * 300], ["<b>?"], ["-1"], ["9" * 400], ["1,5"], ["1.234,5"], ["31.2.2026"], ["1", "2"]]
    asked = {(f.action, name) for f in _Forms(browser.get(path).text).found for name in f.asked}
    assert asked
    for (action, name), values in itertools.product(sorted(asked), bad):
        there = _Forms(browser.get(path).text).found
        form = next((f for f in there if f.action == action and name in f.asked), None)
        if form is None:  # as of a check that was accepted
            continue
        sent = {**form.fields, name: values}
        files = [("files", ("neu.txt", b"x"))] if form.of_files else None
        how: Any = {"params": sent} if form.method == "get" else {"data": sent, "files": files}
        answer = browser.request(form.method, action, **how, follow_redirects=False)
        about = (action, name, [v[:12] for v in values])
        if answer.status_code == 303:
            continue
        if name == "segment" and values != [""]:  # a list: other values do not come from the page
            assert answer.status_code == 415, about
            continue
        assert answer.status_code in (200, 400, 409), about
        assert "INTERNAL" not in answer.text, about
        shown = re.sub(r"(?s)<datalist.*?</datalist>", "", answer.text)
        assert not english_of(shown, english, NAMES + r"|x{3,}|neu\.txt|1\.234,5|<b>\?|instrument\w*|\w+_\w+"), about
        if answer.status_code == 200 and form.method == "post" and action != "/visits":
            at = answer.text.find(f'name="{name}"')
            beside = answer.text[at : answer.text.find("</div>", at)]
            # A right value may leave another field wrong; 300 letters are too many for each.
            assert 'class="problem"' in (beside if values == bad[1] and not form.of_files else answer.text), about


def advice() -> Iterator[str]:
    """Advice of every check in the library and the tables, with a number for what is filled in."""
    for file in files("pbl_pipeline", "pbl_schemas"):
        tree = nodes(file)
        named = _named(tree)
        for node in tree:
            made = isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("Check", "warn_if")
            if not made or not isinstance(node, ast.Call) or len(node.args) < 5:
                continue
            yield from _texts_of(node.args[4], named)


def _named(tree: Iterable[ast.AST]) -> dict[str, list[ast.expr]]:
    """Values that the names of a module get."""
    named: dict[str, list[ast.expr]] = {}
    for node in tree:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            named.setdefault(node.targets[0].id, []).append(node.value)
    return named


def _parts(node: ast.Call, named: dict[str, list[ast.expr]]) -> dict[str, ast.expr]:
    """Found, expected and next step of an error, by name or in their places; a name stands for its last value."""
    names, of = ("found", "expected", "next_step"), getattr(node.func, "id", "")
    places = node.args[1:] if of == "PblError" else node.args if of in ("refused", "_refused", "conflict") else []
    out: list[ast.expr] = []
    for place in places:
        value = _last(place.value, named) if isinstance(place, ast.Starred) else place
        out += value.elts if isinstance(place, ast.Starred) and isinstance(value, ast.Tuple) else [value]
    found = dict(zip(names, out, strict=False)) | {k.arg: k.value for k in node.keywords if k.arg in names}
    return {name: _last(value, named) for name, value in found.items()}


def _last(value: ast.expr, named: dict[str, list[ast.expr]]) -> ast.expr:
    before = [v for v in named.get(getattr(value, "id", ""), ()) if v.lineno <= value.lineno]
    return max(before, key=lambda v: v.lineno, default=value)


def _texts_of(node: ast.expr, named: dict[str, list[ast.expr]]) -> list[str]:
    """Texts that an expression may be; none where it is made elsewhere."""
    if isinstance(node, ast.Constant):
        return [str(node.value)]
    if isinstance(node, ast.JoinedStr):
        return ["".join(v.value if isinstance(v, ast.Constant) else "0.5" for v in node.values)]  # type: ignore[misc]
    if isinstance(node, ast.IfExp):
        return [*_texts_of(node.body, named), *_texts_of(node.orelse, named)]
    if isinstance(node, ast.BinOp):
        return [a + b for a in _texts_of(node.left, named) for b in _texts_of(node.right, named)]
    if isinstance(node, ast.Name):
        return [text for value in named.get(node.id, ()) for text in _texts_of(value, {})]
    return []


def test_the_advice_of_every_check_has_its_german(english: set[str]):
    every = set(advice()) - {""}
    assert len(every) > 25
    untold = {text for text in every if "<span" in texts.library("de", text)}
    # The advice about the far leg names a side and is written out for both.
    assert not {t for t in untold if "leg was behind the" not in t}


#: Where a page or what it calls refuses; what only commands and JSON say is left out.
REFUSING = (
    *(f"schemas/pbl_schemas/{name}.py" for name in (
        "studies/visit_forms", "decisions/review_decisions", "decisions/event_corrections", "reading/shown",
        "reading/trend",
    )),
    *(f"workers/pbl_workers/{name}.py" for name in ("browser_uploads", "phone_uploads")),
    "workers/pbl_workers/incoming.py:check_room",
    *(f"workers/pbl_workers/web/{name}.py" for name in ("registration", "decide", "computing", "reports", "movement")),
)  # fmt: skip


@pytest.mark.parametrize("file", REFUSING)
def test_every_refusal_of_a_page_has_its_german(file: str):
    file, _, function = file.partition(":")
    tree = nodes(ROOT / file)[0]
    assert isinstance(tree, ast.Module)
    (top,) = [n for n in tree.body if getattr(n, "name", "") == function] if function else [tree]
    named, said = _named(ast.walk(tree)), []
    for node in ast.walk(top):
        if isinstance(node, ast.Call):
            said += [text for part in _parts(node, named).values() for text in _texts_of(part, {})]
    assert said
    assert not [text for text in said if "<span" in texts.on_page("de", text)]


def refusals() -> Iterator[tuple[str, str, str]]:
    """Code, found and next step of every error of library and tables, with numbers for what is filled in."""
    for file in files("pbl_pipeline", "pbl_schemas"):
        named = _named(nodes(file))
        for node in nodes(file):
            if not isinstance(node, ast.Call) or "next_step" not in (parts := _parts(node, named)):
                continue
            given = {name: _texts_of(part, {}) for name, part in parts.items()}
            codes = [a.value for a in node.args if isinstance(a, ast.Constant) and a.value in CODES] or ["FIT_INPUT"]
            for found, step in itertools.product(given.get("found") or ["x"], given["next_step"] or ["x"]):
                yield str(codes[0]), found, step


def test_no_reason_on_a_page_has_a_code_or_a_command():
    every = set(refusals())
    assert len(every) > 250
    wrong = []
    for code, found, step in every:
        failed = f"search for people failed ({code}: {found}); next: {step}, then pbl retry"  # as `pbl why` says it
        for reason, language in itertools.product((f"{code}: {found}", step, failed), texts.LANGUAGES):
            shown = str(texts.on_page(language, reason))
            if commands_in(shown) or re.search(rf"(?<![\w-])--[a-z]|\bpbl [a-z]|\b({'|'.join(CODES)}):", shown):
                wrong.append((reason, shown))
    assert not wrong, wrong[:3]


@pytest.mark.parametrize("code", sorted(CODES))
def test_every_code_is_a_link_or_is_said_in_words(code: str):
    """A call has no link by its cause: its author places a new code. A step is never only a command without a link."""
    ways = remedies(code, visit=3, recording=7)
    assert bool(ways) != (code in AT_THE_MACHINE + IN_WORDS)
    assert code in WAYS or CODES[code].cause != CALL
    for language, (_, _, step) in itertools.product(texts.LANGUAGES, (r for r in refusals() if r[0] == code)):
        shown = texts.on_page(language, step, click=not ways)
        assert not commands_in(shown)
        assert ways or shown


def test_a_choice_carried_to_another_tracking_has_its_german():
    """As this version writes it and as rows of earlier versions hold it."""
    for reason in (
        "Person 3 was recognised: chosen by hand in the tracking old-v1.",
        "Person 2 of the tracking old-v1 was chosen by hand and cannot be recognised for certain here. Choose the "
        "person again.",
        "Person 3 is the one whom somebody chose by hand in the tracking old-v1.",
        "In the tracking old-v1 person 2 was chosen by hand, whom nobody here surely is. A person has to choose again.",
    ):
        told = str(texts.library("de", reason))
        assert "old-v1" in told
        assert "<span" not in told


@pytest.mark.parametrize("code", REASONS)
def test_the_reason_for_missing_forces_has_its_german(code: str):
    assert texts.library_words("de", REASONS[code]) != REASONS[code]
