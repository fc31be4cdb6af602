"""Access to the pages: one-time links, sessions, the token of each form, and the headers of every answer.

A request passes `Gate`, which finds its session, and then the right of its address (`address.Address`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hmac
import ipaddress
import re
import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label
from pbl_schemas.intake.phone_recordings import hashed

#: Hours after which a session ends in any case, and, where people sign in, hours without a request.
HOURS, IDLE_HOURS = 12.0, 1.0
#: Rights by role: a reader looks at visits and recordings, a reviewer also decides and enters; an operator sees queues,
#: errors and disks and retries, without any view of a person. Several roles add up.
RIGHTS: dict[str, frozenset[str]] = {
    "reader": frozenset({"look"}),
    "reviewer": frozenset({"look", "decide"}),
    "operator": frozenset({"operate"}),
}
#: Longest body of a form (byte).
BODY_BYTES = 65_536
#: Valid addresses: without characters to escape, numbers of rows in their shortest form.
_PATH = re.compile(r"/|(?:/(?:[A-Za-z_][A-Za-z0-9._-]*|[1-9][0-9]{0,8}(?:\.json)?))+")
#: Names of hosts in a Host header, as DNS has them.
_HOST = re.compile(r"(?!-)[a-z0-9_-]{1,63}(\.[a-z0-9_-]{1,63})*")
#: Searches that a session remembers.
_SEARCHES = 200

#: Everything comes from this server, and nothing is inline: scripts and styles in a label or the name of a recording
#: cannot run.
CONTENT_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        "media-src 'self'",
        "connect-src 'self'",
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    )
)
#: Of a report, which is one file with its own style and no script.
REPORT_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
HEADERS = {
    "content-security-policy": CONTENT_POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
}
#: Beside them where the browser reaches the page by TLS: it never tries without.
_BY_TLS = {"strict-transport-security": "max-age=31536000"}


@dataclasses.dataclass
class Session:
    """A person in front of a browser. token: what each of her forms has to bring back; name: what her decisions carry;
    searches: what she searched for, so that a person's code never stands in an address. seen: when the last request
    was; changed: when her account was, empty without one; looked: when her looks at recordings were last written."""

    name: str
    roles: tuple[str, ...]
    ends: float
    seen: float = 0.0
    changed: str = ""
    looked: dict[tuple[str, ...], float] = dataclasses.field(default_factory=dict)
    token: str = dataclasses.field(default_factory=lambda: secrets.token_urlsafe(24))
    searches: list[str] = dataclasses.field(default_factory=list)

    def may(self, right: str) -> bool:
        """Return whether one of the roles has a right of `RIGHTS`; any session has ""."""
        return not right or any(right in RIGHTS.get(role, frozenset()) for role in self.roles)

    @property
    def home(self) -> str:
        """The address of the first page that she may see."""
        return "/visits" if self.may("look") else "/operate"

    def search_number(self, text: str) -> int:
        """The number of a text that was searched for, from 1; 0 for none."""
        if not text:
            return 0
        if text not in self.searches:
            del self.searches[: max(0, len(self.searches) + 1 - _SEARCHES)]
            self.searches.append(text)
        return self.searches.index(text) + 1

    def search_text(self, number: int) -> str:
        """The text of a number, empty if there is none."""
        return self.searches[number - 1] if 0 < number <= len(self.searches) else ""


class Sessions:
    """Sessions and one-time links, in memory: a server that ends forgets them all.

    Only hashes are kept, so that a copy of the memory's contents opens nothing.

    idle_hours
        Hours without a request after which a session ends; None: it does not.
    still
        Whether the account of a session, by its name and when it was changed, is still as it was. Others end.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        idle_hours: float | None = None,
        still: Callable[[str, str], bool] | None = None,
    ) -> None:
        self._clock, self._idle, self._still = clock, idle_hours, still
        self._sessions: dict[str, Session] = {}
        self._links: dict[str, tuple[str, tuple[str, ...]]] = {}

    def new_link(self, name: str, *roles: str) -> str:
        """The key of a link that opens one session, once."""
        key = secrets.token_urlsafe(32)
        self._links[hashed(key)] = (name, roles)
        return key

    def enter(self, key: str) -> str | None:
        """A new session's cookie for the key of a link, which is used up; None for a key that opens nothing."""
        found = self._links.pop(hashed(key), None)
        return None if found is None else self.open(*found)

    def open(self, name: str, roles: tuple[str, ...], changed: str = "") -> str:
        """A new session's cookie. `changed`: of the account."""
        now = self._clock()
        self._sessions = {k: s for k, s in self._sessions.items() if self._lasts(s, now)}
        cookie = secrets.token_urlsafe(32)
        self._sessions[hashed(cookie)] = Session(name, roles, now + 3600 * HOURS, now, changed)
        return cookie

    def find(self, cookie: str) -> Session | None:
        """The session of a cookie, None if it ended or never was."""
        session, now = self._sessions.get(hashed(cookie)), self._clock()
        if session is None or not self._lasts(session, now):
            return None
        if self._still is not None and not self._still(session.name, session.changed):
            return None
        session.seen = now
        return session

    def _lasts(self, session: Session, now: float) -> bool:
        return session.ends > now and (self._idle is None or now - session.seen < 3600 * self._idle)

    def leave(self, cookie: str) -> None:
        self._sessions.pop(hashed(cookie), None)


@dataclasses.dataclass(frozen=True)
class Cookie:
    """A cookie, by default the session's. secure: sent by TLS alone, and by its name (`__Host-`) bound to this very
    host."""

    secure: bool = False
    called: str = "pbl_session"

    @property
    def name(self) -> str:
        return f"__Host-{self.called}" if self.secure else self.called

    def of(self, request: Request) -> str:
        """Its value in a request, empty for none."""
        return request.cookies.get(self.name, "")

    def set(self, response: Response, value: str, seconds: int) -> None:
        """Give it to a browser: no script reads it, and no other page makes a browser send it."""
        response.set_cookie(
            self.name, value, max_age=seconds, path="/", httponly=True, samesite="strict", secure=self.secure
        )

    def forget(self, response: Response) -> None:
        response.delete_cookie(self.name, path="/", httponly=True, samesite="strict", secure=self.secure)


class Gate:
    """Finds the session of each request, refuses what no page answers, and sets the headers of every answer. The right
    that an address needs is its own (`address.Address`).

    refuse
        Makes the answer for a request that may not pass, from its reason: "host", "address", "token".
    """

    def __init__(
        self,
        app: ASGIApp,
        sessions: Sessions,
        hosts: frozenset[str],
        refuse: Callable[[Request, str], Any],
        cookie: Cookie,
    ) -> None:
        self._app, self._sessions, self._hosts, self._refuse = app, sessions, hosts, refuse
        self._cookie = cookie
        self._headers = {**HEADERS, **(_BY_TLS if cookie.secure else {})}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        request = Request(scope, receive)
        reason = self._reason(request)
        if reason:
            await self._refuse(request, reason)(scope, receive, with_headers)
        else:
            await self._app(scope, receive, with_headers)

    def _reason(self, request: Request) -> str:
        headers = request.headers
        request.state.session = None
        # Another name that leads to 127.0.0.1 (DNS rebinding) would make its page one of this server.
        if len(headers.getlist("host")) != 1 or host_of(headers["host"]) not in self._hosts:
            return "host"
        request.state.session = self._sessions.find(self._cookie.of(request))
        if not _PATH.fullmatch(request.scope["path"]):
            return "address"
        return "" if request.method in ("GET", "HEAD") or _from_here(headers) else "token"


def host_name(stated: str) -> str:
    """Return a name or address as a browser sends it in a Host header: lower case, other letters than a to z as DNS
    has them (IDNA), addresses in their short form. Raises `PblError` USAGE for what is neither."""
    text = stated.strip().rstrip(".").removeprefix("[").removesuffix("]")
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(text))
    try:
        name = text.encode("idna").decode().lower()
    except UnicodeError:
        name = ""
    if not _HOST.fullmatch(name):
        found = f"the name of a host {ascii(stated)[:100]}"
        expected = "a name such as gait.example.org, or an address, without https:// and port"
        raise PblError("USAGE", found, expected, "correct --hostname, or the name of this machine")
    return name


def host_of(header: str) -> str:
    """Name or address in a Host header, without the port; empty for what is none."""
    try:
        return (urlsplit(f"//{header}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def _from_here(headers: Headers) -> bool:
    """Return whether a changing request was sent from a page of this server, as far as the browser tells."""
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != headers.get("host"):
        return False
    return headers.get("sec-fetch-site", "same-origin") in ("same-origin", "none")


class Refused(Exception):
    """A request that may not be answered: "session", "right", "token", "size" or "form"."""


async def form_of(request: Request) -> Mapping[str, str]:
    """The fields of a form whose token is that of its sender's session. Raises Refused: another token or none, a body
    that is too long, broken off or no form; `PblError` USAGE for a text with control or invisible characters."""
    fields = await read_form(request)
    check_token(request, fields.pop("token", "") or request.headers.get("x-token", ""))
    check_fields(fields)
    return fields


def sender(request: Request) -> str:
    """Return the name that decisions of who sent a request carry; it has a session."""
    return request.state.session.name


def check_token(request: Request, sent: str) -> None:
    """Raise `Refused` for another token than that of the session."""
    session: Session | None = request.state.session
    if session is None or not hmac.compare_digest(sent.encode(errors="replace"), session.token.encode()):
        raise Refused("token")


def check_fields(fields: Mapping[str, str]) -> None:
    """Raise `PblError` USAGE for a text with control or invisible characters."""
    for name, text in fields.items():
        one_line = re.sub(r"[\r\n\t]", " ", name + text)  # as a text that is pasted may have them
        check_label(f"field {ascii(name)[:80]}", one_line, BODY_BYTES)


async def read_body(request: Request, most: int) -> bytes:
    """Return the body of a request. Raises `Refused` for one of more bytes than `most`, or that is broken off."""
    body = bytearray()
    try:
        async for piece in request.stream():
            body += piece
            if len(body) > most:
                raise Refused("size")
    except ClientDisconnect:
        raise Refused("form") from None
    return bytes(body)


async def read_form(request: Request) -> dict[str, str]:
    """Return the fields of a form of any sender. Raises `Refused` for a body that is too long, broken off or no
    form."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/x-www-form-urlencoded":
        raise Refused("form")
    body = await read_body(request, BODY_BYTES)
    try:
        return dict(parse_qsl(body.decode(), keep_blank_values=True, max_num_fields=100))
    except ValueError:
        raise Refused("form") from None
