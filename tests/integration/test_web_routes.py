"""Right and look of every address, in each spelling that the page may take for it: by the page's own list of routes."""

import contextlib
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest
from starlette.routing import Route
from starlette.testclient import TestClient

from pbl_schemas.review import Viewing
from pbl_workers.populate import populate
from pbl_workers.web import Options, Where, audit, create_app
from tests.integration import web
from tests.integration.chain import small_video
from tests.integration.test_web_attacks import rows
from tests.rows import register

#: Each address with 1 for its number: the roles that may open it ("*": anybody, "+": whoever is signed in) and what of
#: a person is looked at. An address that is new belongs in here.
LOOK, DECIDE, OPERATE = "reader reviewer", "reviewer", "operator"
#: A phone that opened a link, which has no role (test_web_phone.py).
PHONE = "phone"
EXPECTED = {
    "GET /": ("*", ""),
    "GET /enter": ("*", ""),
    "POST /leave": ("+", ""),
    "POST /language": ("+", ""),
    "GET /static/1": ("*", ""),
    "GET /vendor/1": ("*", ""),
    "GET /visits": (LOOK, ""),
    "GET /visits.json": (LOOK, ""),
    "POST /visits": (LOOK, ""),
    "GET /visits/1": (LOOK, ""),
    "GET /visits/1.json": (LOOK, ""),
    "GET /visits/1/letter": (LOOK, "letter"),
    "GET /visits/1/trend": (LOOK, "trend"),
    "GET /visits/1/trend.json": (LOOK, "trend"),
    "GET /visits/new": (DECIDE, ""),
    "GET /visits/new.json": (DECIDE, ""),
    "POST /visits/new": (DECIDE, ""),
    "GET /visits/1/facts": (LOOK, ""),
    "GET /visits/1/facts.json": (LOOK, ""),
    "POST /visits/1/facts": (DECIDE, ""),
    "GET /visits/1/upload": (DECIDE, ""),
    "GET /visits/1/upload.json": (DECIDE, ""),
    "POST /visits/1/upload": (DECIDE, ""),
    "GET /visits/1/enter": (LOOK, ""),
    "GET /visits/1/progress": (LOOK, "progress"),
    "GET /visits/1/report": (LOOK, "report"),
    "GET /visits/1/report/state": (LOOK, "report"),
    "GET /visits/1/export": (LOOK, "export"),
    "GET /compare": (LOOK, ""),
    "GET /instruments": (LOOK, ""),
    "POST /instruments": (DECIDE, ""),
    "GET /compare.json": (LOOK, ""),
    "GET /recordings/1": (LOOK, "page"),
    "GET /recordings/1.json": (LOOK, "page"),
    "GET /recordings/1/video": (LOOK, "video"),
    "GET /recordings/1/movement": (LOOK, "movement"),
    "GET /recordings/1/body": (LOOK, "body"),
    "GET /recordings/1/points": (LOOK, "points"),
    "GET /recordings/1/people": (LOOK, "people"),
    "GET /recordings/1/boxes": (LOOK, "boxes"),
    "GET /recordings/1/overlay": (LOOK, "overlay"),
    "GET /recordings/1/overlay/file": (LOOK, "overlay"),
    "GET /recordings/1/overlay/state": (LOOK, "overlay"),
    "POST /visits/1/enter": (DECIDE, ""),
    "POST /visits/1/accept": (DECIDE, ""),
    "POST /visits/1/compute": (DECIDE, ""),
    "POST /recordings/1/person": (DECIDE, ""),
    "POST /recordings/1/usable": (DECIDE, ""),
    "POST /recordings/1/events": (DECIDE, ""),
    "POST /visits/1/film": (DECIDE, ""),
    "POST /visits/1/film/end": (DECIDE, ""),
    "GET /phone/open": ("*", ""),
    "POST /phone/open": ("*", ""),
    "GET /phone/offline.js": ("*", ""),
    "GET /phone/store.js": ("*", ""),
    "GET /phone/authority.crt": ("*", ""),
    "GET /phone": (PHONE, ""),
    "GET /phone/state.json": (PHONE, ""),
    "POST /phone/look.json": (PHONE, ""),
    "POST /phone/recordings.json": (PHONE, ""),
    "PUT /phone/recordings/1.json": (PHONE, ""),
    "POST /phone/finish/1.json": (PHONE, ""),
    "POST /phone/sensors.json": (PHONE, ""),
    "GET /operate": (OPERATE, ""),
    "POST /operate/retry": (OPERATE, ""),
}
ROLES = ("reader", "reviewer", "operator")


def spellings(path: str) -> list[str]:
    """Ways to write an address that a reader of paths may take for the same, without the address itself."""
    ends = ("%0a", "%0d", "%00", "%09", "%20", "%0a/", "/", "//", "/.", "/%2e", "%2f", ";", "%3f", "%23", "%e2%80%ae",
            "%ff", ".json%0a", "/..;/x", "%85", "%e2%80%a8")  # fmt: skip
    found = [path + end for end in ends]
    found += ["/" + path, "/." + path, "/x/.." + path, "/%2e" + path, path.upper(), "/%0a" + path[1:]]
    found += ["/" + "".join(f"%{ord(c):02x}" for c in path[1:])]
    for number in ("01", "0" * 13 + "1", "0" * 4499 + "1", "+1", "%2b1", "-1", "1e0", "1.0", "1_0", "%201", "1%0a",
                   "1%00", quote("\u0661"), quote("\uff11"), quote("\u00b9"), "0x1", "1;"):  # fmt: skip
        found.append(re.sub(r"(?<=/)1(?=/|\.|$)", number, path))
    return sorted({f for f in found if f != path})


@pytest.fixture(scope="module")
def one_visit(module_tables: Path, module_patch: pytest.MonkeyPatch) -> None:
    """Visit 1 with recording 1, computed; and each look is to leave a row."""
    module_patch.setenv("PBL_AUDIT_LOOKS", "1")
    module_patch.setattr(audit, "AGAIN_S", 0.0)
    register(small_video(module_tables, "walk"), session_label="2026-01-10")
    populate()


@pytest.fixture(scope="module")
def browsers(one_visit: None) -> Iterator[dict[str, TestClient]]:
    with contextlib.ExitStack() as stack:  # one event loop for all requests of a browser
        yield {role: stack.enter_context(web.client(role)) for role in ROLES}


def looks() -> list[tuple[str, int | None, int | None]]:
    return [(r["viewing_what"], r["video_id"], r["session_id"]) for r in Viewing().to_dicts(order_by="viewing_id")]


def test_every_address_is_expected_here():
    found = {
        f"{method} {re.sub(r'{[^}]*}', '1', route.path)}"
        for route in create_app(Options()).routes
        if isinstance(route, Route)
        for method in route.methods or ()
        if method != "HEAD"
    }
    assert found == set(EXPECTED)


def test_each_address_opens_for_its_roles_and_leaves_its_row(browsers: dict[str, TestClient]):
    stranger, before = web.client(signed_in=False), rows()
    for name, (allowed, look) in EXPECTED.items():
        method, path = name.split()
        if name == "GET /enter":  # says 401 itself where a link is no way in
            continue
        answer = stranger.request(method, path)
        assert "P001" not in answer.text, name
        if path != "/":  # shows the way in
            assert (answer.status_code == 401) == (allowed != "*"), name
        of = (1, None) if "recordings" in path else (None, 1)
        for role, browser in browsers.items():
            Viewing().delete_quick()
            answer = browser.request(method, path, follow_redirects=False)
            status = answer.status_code
            if role in allowed or allowed in "*+":
                if name == "GET /phone/open":  # says 403 itself where the key opens nothing
                    continue
                assert status in ((200, 303, 400, 404, 409) if method == "GET" else (415,)), (name, role, status)
                assert looks() == ([(look, *of)] if look else []), (name, role)
            else:
                assert (status, "P001" in answer.text) == (403, False), (name, role)
                assert looks() == [], (name, role)
    Viewing().delete_quick()
    changed = {table for table, found in rows().items() if found != before[table]}
    assert changed <= {"pbl_lab.numbered"}  # of the looks


@pytest.mark.parametrize("name", [n for n in EXPECTED if EXPECTED[n][0] != "*"])
def test_no_spelling_of_an_address_passes_its_right_or_its_row(browsers: dict[str, TestClient], name: str):
    """What is answered is answered to those who may, with its row; what is none of our addresses is not answered."""
    (method, path), (allowed, look) = name.split(), EXPECTED[name]
    Viewing().delete_quick()
    for spelled in spellings(path):
        for role, browser in browsers.items():
            status = browser.request(method, web.BASE + spelled, follow_redirects=False).status_code
            assert status in ((200, 303, 400, 403, 404, 409) if method == "GET" else (403, 404, 415)), (spelled, status)
            if status not in (403, 404):
                assert role in allowed or allowed == "+", (spelled, role, status)
                assert bool(looks()) == bool(look), (spelled, role, status)
                Viewing().delete_quick()
    assert looks() == []


def test_addresses_that_no_browser_sends(one_visit: None):
    """By a socket: a client of HTTP would put them right."""
    app, cookie = web.app_with_cookie("reader")
    with web.running(app, Where()) as port:
        for target in ("/operate%0a", "/operate%", "/operate%0", "/./operate", "//operate", "/operate#", "/operate\t",
                       "http://127.0.0.1/operate%0a", "*", "/visits/../operate", "/visits/" + "1" * 4500):  # fmt: skip
            lines = [f"GET {target} HTTP/1.1", f"Host: 127.0.0.1:{port}", f"Cookie: pbl_session={cookie}"]
            with socket.create_connection(("127.0.0.1", port), timeout=5) as sent:
                sent.sendall("\r\n".join([*lines, "Connection: close", "", ""]).encode())
                answer = b"".join(iter(lambda: sent.recv(65536), b""))
            assert answer.split(b" ")[1] in (b"400", b"403", b"404"), (target, answer[:100])
            assert b"Queues" not in answer


def test_an_address_that_belongs_to_no_page_is_refused_by_default(one_visit: None):
    for path in ("/nothing", "/visits/1/nothing", "/recordings", "/static", "/docs", "/openapi.json"):
        assert web.client(signed_in=False).get(path).status_code == 401, path
        for role in ROLES:
            assert web.client(role).get(path).status_code == 404, (path, role)
        for method in ("PUT", "DELETE", "OPTIONS", "TRACE", "PROPFIND", "CONNECT"):
            for known in (path, "/visits", "/recordings/1/video"):
                answer = web.client().request(method, known)
                assert answer.status_code in (403, 404, 405), (method, known)
                assert web.client(signed_in=False).request(method, known).status_code in (401, 403), (method, known)
    assert looks() == []
