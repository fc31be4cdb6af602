"""The review page as tests use it: signed in, over the tables of the test."""

from __future__ import annotations

import re

from starlette.testclient import TestClient

from workers.web import Options, create_app

BASE = "http://127.0.0.1:8484"


def client(role: str = "reviewer", name: str = "R. Viewer", signed_in: bool = True) -> TestClient:
    """A browser of this machine; errors of the program are answers, as they are for a browser."""
    app = create_app(Options(name=name, role=role))
    browser = TestClient(app, base_url=BASE, raise_server_exceptions=False, headers={"accept-language": "en"})
    if signed_in:
        found = browser.get("/enter", params={"key": app.state.sessions.new_link(name, role)}, follow_redirects=False)
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
