"""Attacks on every address of the review page, by its own list of routes: what is added later is attacked as well.

Who may open which address: test_web_routes.py."""

import contextlib
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.routing import Route

from pbl_schemas import lab, session, study, video
from pbl_schemas.jobs import jobs_of
from pbl_workers.populate import populate
from pbl_workers.web import Options, Where, connections, create_app
from tests import Limits
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import everything, register

#: What a page must never run, whatever it stands in.
EVIL = '"><img src=x onerror=alert(1)><script>document.title="pwned"</script>'
#: Addresses for phones, attacked in test_web_phone.py: no session is one, and no form is sent to them.
OF_PHONES = {"/phone/look.json", "/phone/recordings.json", "/phone/sensors.json", "/phone/finish/1.json"}
#: Forms that change nothing but what the sender sees.
HARMLESS = {"/leave", "/language", "/visits"}


def routes() -> list[tuple[str, str]]:
    """Method and path of every address, with 1 for its number."""
    found = [r for r in create_app(Options()).routes if isinstance(r, Route)]
    assert len(found) > 20
    methods = [(m, re.sub(r"\{[^}]*\}", "1", r.path)) for r in found for m in r.methods or () if m != "HEAD"]
    return sorted(set(methods))


GETS = [path for method, path in routes() if method == "GET"]
POSTS = [path for method, path in routes() if method == "POST"]


def rows() -> dict[str, list[tuple]]:
    """Every row but DataJoint's own notes, which grow when a queue is looked at for the first time."""
    return {name: found for name, found in everything().items() if not name.split(".")[1].startswith("~")}


@pytest.fixture
def one_visit(tables: None, tmp_path: Path) -> None:
    """Visit 1 with video 1, nothing computed."""
    register(small_video(tmp_path, "walk", n=30), session_label="2026-01-10")


def test_no_form_is_taken_without_its_token_or_from_elsewhere(one_visit: None):
    browser = web.client("reviewer,operator")
    token, before = web.token(browser), rows()
    elsewhere = ({"origin": "https://evil.example"}, {"sec-fetch-site": "cross-site"}, {"origin": "null"})
    for path in set(POSTS) - OF_PHONES:
        for fields, headers in [({}, {}), ({"token": "x"}, {}), *(({"token": token}, h) for h in elsewhere)]:
            answer = browser.post(path, data=fields, headers=headers, follow_redirects=False)
            assert answer.status_code == (403 if fields or headers else 415), (path, fields, headers)
        plain = browser.post(path, content=f'{{"token": "{token}"}}', headers={"content-type": "application/json"})
        assert plain.status_code in (403, 415), path
    assert rows() == before


def test_a_reader_changes_nothing_anywhere(one_visit: None):
    reader = web.client("reader")
    token, before = web.token(reader), rows()
    for path in POSTS:
        if path not in HARMLESS:
            assert reader.post(path, data={"token": token}, follow_redirects=False).status_code == 403, path
    assert rows() == before


@pytest.mark.parametrize("number", ["0", "999", str(2**31), str(10**30), "01"])
def test_forged_numbers_are_a_page_that_says_so(one_visit: None, number: str):
    browser = web.client("reviewer,operator")
    token, before = web.token(browser), rows()
    for path in [p for p in GETS if "/1" in p]:
        answer = browser.get(path.replace("/1", f"/{number}"), follow_redirects=False)
        assert answer.status_code < 500, path
        assert number == "01" or answer.status_code in (400, 404, 409), (path, answer.status_code)
    for path in [p for p in POSTS if "/1" in p]:
        answer = browser.post(path.replace("/1", f"/{number}"), data={"token": token}, follow_redirects=False)
        assert 400 <= answer.status_code < 500, path
    assert rows() == before


@pytest.mark.parametrize("text", ["", "x" * 2000, "\x00", "'; DROP TABLE x; --", "\N{DISGUISED FACE}", "-1", "1e9"])
def test_forms_full_of_nonsense_are_refused(one_visit: None, text: str):
    browser = web.client("reviewer,operator")
    token, before = web.token(browser), rows()
    names = ("person", "method", "seen", "result", "check", "computed", "reason", "value:mJOA", "value:role", "table",
             "code", "key", "event", "time", "note", "x", "y", "video", "all")  # fmt: skip
    for path in POSTS:
        if path not in HARMLESS:
            answer = browser.post(path, data={"token": token, **dict.fromkeys(names, text)}, follow_redirects=False)
            assert answer.status_code < 500, (path, answer.text)
    assert rows() == before


@pytest.mark.parametrize("text", ["\u202egnp.exe", "a\u2066b", "\u200fx", "P\u200b1", "\x1b[2J", "a\x00b", "\ufeffx"])
def test_texts_that_read_otherwise_than_they_are_get_into_no_row(one_visit: None, text: str):
    browser = web.client("reviewer,operator")
    token, before = web.token(browser), rows()
    for path, fields in (
        ("/recordings/1/usable", {"usable": "no", "reason": "other", "note": text}),
        ("/visits/1/enter", {"value:role": text, "reason": text}),
        ("/visits/1/accept", {"result": "0", "check": "0", "reason": text}),
        ("/visits", {"search": text}),
        ("/visits", {text: "x"}),
    ):
        answer = browser.post(path, data={"token": token, **fields}, follow_redirects=False)
        assert answer.status_code == 400, (path, answer.status_code)
        assert text not in answer.text
    assert rows() == before


@pytest.fixture
def hostile(tables: None, tmp_path: Path) -> Iterator[None]:
    """Names, labels, roles, notes, instruments and errors that are written to run: visits 1 and 2 with videos."""
    paths = [small_video(tmp_path, f"<img src=x onerror=alert({i})>", n=240) for i in range(2)]
    for i, path in enumerate(paths):
        register(path, session_label=f"2026-0{i + 1}-10")
    populate()
    gone = small_video(tmp_path, "<script>alert(3)<'\">", n=30)
    register(gone, session_label="2026-05-10")
    gone.unlink()
    populate()
    assert len(jobs_of(video.VideoInfo).errors) == 1
    evil = EVIL[:64]
    session.Session.update1({"session_id": 1, "session_label": evil})
    study.Visit.insert1({"session_id": 1, "visit_role": EVIL[:32], "visit_note": EVIL})
    row = {"instrument_unit": EVIL[:16], "instrument_name": EVIL, "higher_is_better": True, "ordinal": True}
    study.ClinicalInstrument.insert1({"instrument": EVIL[:32], **row}, skip_duplicates=True)
    study.ClinicalScore.insert1({"session_id": 1, "instrument": EVIL[:32], "score_value": 3})
    lab.Population.insert1({"population": EVIL[:32], "population_description": ""}, skip_duplicates=True)
    lab.Subject.update1({"subject": "P001", "population": EVIL[:32]})
    yield
    (study.ClinicalScore & {"instrument": EVIL[:32]}).delete_quick()
    (study.ClinicalInstrument & {"instrument": EVIL[:32]}).delete_quick()


PAGES = ("/visits", "/visits/1", "/visits/2", "/visits/3", "/visits/1/enter", "/recordings/1", "/recordings/3",
         "/compare?v=1&v=2", "/operate",
         f"/visits?role={EVIL}&cohort={EVIL}&quality={EVIL}", f"/compare?v={EVIL}")  # fmt: skip


def test_names_are_text_on_every_page(hostile: None):
    browser = web.client(name=EVIL[:60])
    operator = web.client("operator", name=EVIL[:60])
    for path in PAGES:
        page = (operator if path == "/operate" else browser).get(path)
        assert page.status_code in (200, 400, 404), path
        assert "&lt;script&gt;" in page.text, path
        assert "onerror=alert" not in re.sub(r"&lt;img src=x onerror=alert|&lt;img src=x onerror", "", page.text), path
        assert not re.search(r"<img src=x|<script>", page.text), path
        assert not re.search(r"<style|\sstyle=|<script(?![^>]*\ssrc=\"/)", page.text), path


def test_no_name_runs_in_a_browser(hostile: None, chromium: Any):
    with web.shown(chromium, name=EVIL[:60]) as page:
        asked: list[str] = []
        page.on("dialog", lambda d: (asked.append(d.message), d.dismiss()))
        page.on("request", lambda r: asked.append(r.url) if r.url.endswith("/x") else None)
        for path in [p for p in PAGES if "?v=" not in p or "v=1" in p]:
            if path != "/operate":
                page.goto(path)
                page.wait_for_timeout(100)
                assert page.title() != "pwned"
                assert page.locator("main").is_visible()
        assert asked == []


@contextlib.contextmanager
def head_sent(port: int, line: str, cookie: str = "", more: str = "Content-Length: 5000") -> Iterator[socket.socket]:
    """A connection over which the head of a request went, whose body is still to come."""
    lines = [line, f"Host: 127.0.0.1:{port}", f"Cookie: pbl_session={cookie}", more,
             "Content-Type: application/x-www-form-urlencoded", "", ""]  # fmt: skip
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall("\r\n".join(lines).encode())
        yield slow


def dripped(slow: socket.socket, drip: bytes, longest_s: float = 8.0) -> tuple[bytes, float]:
    """What is answered while bytes are sent now and then, and the seconds until the other side closed."""
    start, answer = time.monotonic(), b""
    slow.settimeout(0.05)
    while time.monotonic() - start < longest_s:
        try:
            if drip:
                slow.sendall(drip)
            part = slow.recv(65536)
        except TimeoutError:
            continue
        except ConnectionError:
            break
        answer += part
        if not part and not drip:  # who still sends notices it by an error
            break
    return answer, time.monotonic() - start


@pytest.mark.parametrize("drip", [b"a", b""])
@pytest.mark.parametrize("size", ["Content-Length: 5000", "Transfer-Encoding: chunked"])
def test_a_form_that_never_ends_keeps_no_connection(
    one_visit: None, drip: bytes, size: str, caplog: pytest.LogCaptureFixture, limits: Limits
):
    limits(connections, REQUEST_S=0.5)
    app, cookie = web.app_with_cookie()
    with web.running(app, Where()) as port, head_sent(port, "POST /visits HTTP/1.1", cookie, size) as slow:
        _, seconds = dripped(slow, b"1\r\na\r\n" if drip and size.startswith("Transfer") else drip)
        assert seconds < 3
    assert "Traceback" not in caplog.text  # a client that leaves is not an error of the program


@pytest.mark.parametrize("drip", [b"a", b"a" * 60_000, b""])
@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("GET / HTTP/1.1", b"401"),
        ("GET /visits HTTP/1.1", b"401"),
        ("POST /visits HTTP/1.1", b"401"),
        ("GET /static/page.css HTTP/1.1", b"200"),
        ("GET /operate%0a HTTP/1.1", b"404"),
    ],
)
def test_a_body_that_nobody_reads_keeps_no_connection(one_visit: None, line: str, status: bytes, drip: bytes):
    """The answer comes, and with its end the connection is closed, long before the limit of a request."""
    with web.running(create_app(Options()), Where()) as port:
        with head_sent(port, line, more="Content-Length: 100000000") as slow:
            answer, seconds = dripped(slow, drip)
        assert answer.split(b" ")[1] == status
        assert seconds < 5
        assert connections.REQUEST_S > 5


def test_a_form_that_comes_in_pieces_and_requests_in_one_are_answered(one_visit: None):
    app, cookie = web.app_with_cookie()
    session = app.state.site.sessions.find(cookie)
    body = f"token={session.token}&role=pre".encode()
    with web.running(app, Where()) as port:
        with head_sent(port, "POST /visits HTTP/1.1", cookie, f"Content-Length: {len(body)}") as slow:
            for i in range(len(body)):
                slow.sendall(body[i : i + 1])
                time.sleep(0.02)
            slow.settimeout(5)
            assert b"location: /visits?role=pre" in slow.recv(65536)
            slow.sendall(f"GET /visits HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: pbl_session={cookie}\r\n\r\n".encode())
            assert b" 200 " in slow.recv(65536)  # the connection is kept
        two = f"GET /static/page.css HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
        with socket.create_connection(("127.0.0.1", port)) as both:
            both.sendall((two + two.replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n")).encode())
            both.settimeout(5)
            assert b"".join(iter(lambda: both.recv(65536), b"")).count(b"HTTP/1.1 200") == 2


@pytest.mark.parametrize("host", ["two", "none", "port only", "absolute"])
def test_requests_that_name_another_host_in_other_ways(one_visit: None, host: str):
    app, cookie = web.app_with_cookie()
    lines = {
        "two": ["GET /visits HTTP/1.1", "Host: 127.0.0.1", "Host: evil.example"],
        "none": ["GET /visits HTTP/1.0"],
        "port only": ["GET /visits HTTP/1.1", "Host: :80"],
        "absolute": ["GET http://evil.example/visits HTTP/1.1", "Host: evil.example"],
    }[host]
    with web.running(app, Where()) as port, socket.create_connection(("127.0.0.1", port)) as sent:
        sent.settimeout(60)
        sent.sendall("\r\n".join([*lines, f"Cookie: pbl_session={cookie}", "Connection: close", "", ""]).encode())
        answer = sent.recv(65536)
    assert answer.startswith(b"HTTP/1.1 400")
    assert b"P001" not in answer
