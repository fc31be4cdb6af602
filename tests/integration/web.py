"""The review page as tests use it: signed in, over the tables of the test."""

import contextlib
import re
import socket
import sys
import threading
from collections.abc import Iterator
from typing import Any

import uvicorn
from starlette.testclient import TestClient

from pbl_workers.on_request import compute_visit
from pbl_workers.web import Options, ResultsFolder, Where, create_app
from pbl_workers.web.serve import config
from pbl_workers.web.site import Target
from tests.rows import one_query_at_a_time

BASE = "http://127.0.0.1:8484"


def client(
    role: str = "reviewer",
    name: str = "R. Viewer",
    signed_in: bool = True,
    target: Target = compute_visit,
    folder: ResultsFolder | None = None,
) -> TestClient:
    """A browser of this machine, of a role or several ("reader,operator"); errors of the program are answers, as they
    are for a browser. target: what computes a visit; folder: what is shown instead of the tables."""
    app = create_app(Options(name=name, roles=tuple(role.split(",")), target=target, folder=folder))
    browser = TestClient(app, base_url=BASE, raise_server_exceptions=False, headers={"accept-language": "en"})
    if signed_in:
        key = app.state.site.sessions.new_link(name, *role.split(","))
        found = browser.get("/enter", params={"key": key}, follow_redirects=False)
        assert found.status_code == 303, found.text
    return browser


def app_with_cookie(role: str = "reviewer") -> tuple[Any, str]:
    """The page, and the cookie of a session, for tests that speak HTTP themselves."""
    app = create_app(Options())
    sessions = app.state.site.sessions
    return app, sessions.enter(sessions.new_link("A", role))


def token(browser: TestClient) -> str:
    """The token of the session's forms, which a page that is not there has as well."""
    found = re.search(r'name="token" value="([^"]+)"', browser.get("/nothing").text)
    assert found
    return found[1]


def post(browser: TestClient, path: str, **fields: object):
    """Send a form of the page; the answer as it is, without going where it leads."""
    return browser.post(path, data={"token": token(browser), **fields}, follow_redirects=False)


def form_of(browser: TestClient, page: str, action: str) -> dict[str, str]:
    """The hidden fields of the form of a page that is sent to `action`, and the events that it shows."""
    text = browser.get(page).text
    form = text[text.index(f'action="{action}"') :]
    form = form[: form.index("</form>")]
    events = re.findall(r'data-(events)="([^"]*)"', form)
    return dict([*re.findall(r'type="hidden" name="([a-z]+)" value="([^"]*)"', form), *events])


@contextlib.contextmanager
def running(app: Any, where: Where) -> Iterator[int]:
    """Serve the page; yields its port."""
    listening = socket.create_server((where.host, 0))
    server = uvicorn.Server(config(app, where))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    with one_query_at_a_time():
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join(10)


@contextlib.contextmanager
def shown(
    chromium: Any, role: str = "reviewer", size: tuple[int, int] = (390, 800), name: str = "R. Viewer",
    refused: bool = False, target: Target = compute_visit, **context: Any
) -> Iterator[Any]:  # fmt: skip
    """A page of the browser `chromium`, signed in; an error of a script or an answer that failed fails the test, but
    with `refused` an answer that says why something is not done or not there (4xx)."""
    app = create_app(Options(name=name, roles=tuple(role.split(",")), target=target))
    viewport = {"width": size[0], "height": size[1]}
    with running(app, Where()) as port, contextlib.ExitStack() as stack:
        made = chromium.new_context(base_url=f"http://127.0.0.1:{port}", viewport=viewport, **context)
        stack.callback(made.close)
        made.set_default_timeout(120_000)  # ms; on a busy machine videos are decoded slowly
        opened, errors = made.new_page(), []
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        opened.goto(f"/enter?key={app.state.site.sessions.new_link(name, *role.split(','))}")
        try:
            yield opened
        except BaseException:  # pytest shows what a failed test has printed
            sys.stdout.write("\n".join([opened.url, *errors, opened.inner_text("body")]))
            raise
        assert not [e for e in errors if not (refused and "a status of 4" in e)]
