"""The review page as tests use it: signed in, over the tables of the test."""

import contextlib
import re
import socket
import threading
from collections.abc import Iterator
from typing import Any

import uvicorn
from starlette.testclient import TestClient

from schemas.connection import dj
from workers.web import Options, create_app
from workers.web.computing import Target, compute_visit

BASE = "http://127.0.0.1:8484"


def client(
    role: str = "reviewer", name: str = "R. Viewer", signed_in: bool = True, target: Target = compute_visit
) -> TestClient:
    """A browser of this machine, of a role or several ("reader,operator"); errors of the program are answers, as they
    are for a browser. target: what computes a visit."""
    app = create_app(Options(name=name, roles=tuple(role.split(",")), target=target))
    browser = TestClient(app, base_url=BASE, raise_server_exceptions=False, headers={"accept-language": "en"})
    if signed_in:
        key = app.state.sessions.new_link(name, *role.split(","))
        found = browser.get("/enter", params={"key": key}, follow_redirects=False)
        assert found.status_code == 303, found.text
    return browser


def token(browser: TestClient) -> str:
    """The token of the session's forms."""
    found = re.search(r'name="token" value="([^"]+)"', browser.get("/visits").text)
    assert found
    return found[1]


def post(browser: TestClient, path: str, **fields: object):
    """Send a form of the page; the answer as it is, without going where it leads."""
    return browser.post(path, data={"token": token(browser), **fields}, follow_redirects=False)


@contextlib.contextmanager
def one_query_at_a_time() -> Iterator[None]:
    """The page's thread and the test's share DataJoint's connection, as no two threads do outside tests."""
    connection, waiting = dj.conn(), threading.RLock()
    execute = connection._execute_query

    def alone(*args: Any) -> None:
        with waiting:
            execute(*args)

    connection._execute_query = alone
    try:
        yield
    finally:
        del connection._execute_query


@contextlib.contextmanager
def shown(
    chromium: Any, role: str = "reviewer", size: tuple[int, int] = (390, 800), name: str = "R. Viewer",
    refused: bool = False, target: Target = compute_visit, **context: Any
) -> Iterator[Any]:  # fmt: skip
    """A page of the browser `chromium`, signed in; an error of a script or an answer that failed fails the test, but
    with `refused` an answer that says why something is not done or not there (4xx)."""
    app = create_app(Options(name=name, roles=tuple(role.split(",")), target=target))
    listening = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(app, log_level="error"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    base = f"http://127.0.0.1:{listening.getsockname()[1]}"
    viewport = {"width": size[0], "height": size[1]}
    made = chromium.new_context(base_url=base, viewport=viewport, **context)
    try:
        opened, errors = made.new_page(), []
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        opened.goto(f"/enter?key={app.state.sessions.new_link(name, *role.split(','))}")
        with one_query_at_a_time():
            yield opened
        assert not [e for e in errors if not (refused and "a status of 4" in e)]
    finally:
        made.close()
        server.should_exit = True
        thread.join(10)
