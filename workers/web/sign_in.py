"""The way in and out: one-time links of this machine, or a name with a password."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from .access import HOURS, Cookie, Sessions, form_of, read_form
from .accounts import Accounts, Attempts
from .address import OPEN, Address, whole_number
from .pages import Pages

log = logging.getLogger(__name__)

#: Passwords that are compared at a time (each takes 128 MiB). As many may wait for it as there are connections: a limit
#: of those would let a flood of wrong ones refuse the right one.
AT_ONCE = 2


@dataclasses.dataclass(frozen=True)
class WayIn:
    """Who may come in. accounts: None where links open the page."""

    sessions: Sessions
    cookie: Cookie
    accounts: Accounts | None
    attempts: Attempts


def routes(pages: Pages, way: WayIn, used: object = None) -> list[Address]:
    """The addresses of this part. `used`: called after a link was used."""
    turn = asyncio.Semaphore(AT_ONCE)

    def opened(request: Request, value: str, to: str) -> Response:
        # The browser never chooses its session, and the one that it had ends.
        way.sessions.leave(way.cookie.of(request))
        response = RedirectResponse(to, 303)
        way.cookie.set(response, value, int(3600 * HOURS))
        return response

    async def by_link(request: Request) -> Response:
        value = way.sessions.enter(request.query_params.get("key", ""))
        if value is None:
            return pages.refused(request, "session")
        to = request.query_params.get("to", "")
        response = opened(request, value, to if to.startswith("/visits/") and whole_number(to[8:]) else "/")
        if callable(used):
            used()
        return response

    async def ask(request: Request) -> Response:
        return pages.show(request, "sign_in.html", problem="", wait=0)

    async def sign_in(request: Request) -> Response:
        assert way.accounts is not None
        fields = await read_form(request)
        name, password = fields.get("name", "").strip(), fields.get("password", "")
        address = request.client.host if request.client else ""
        wait = way.attempts.wait_s(name, address)
        if wait > 0:
            seconds = math.ceil(wait)
            headers = {"retry-after": str(seconds)}
            return pages.show(request, "sign_in.html", 429, headers, problem="sign_in.wait", wait=seconds)
        way.attempts.failed(name, address)
        async with turn:
            account = await asyncio.to_thread(way.accounts.check, name, password)
        if account is None:
            # No name: people write their password into the wrong field.
            log.warning("a failed sign-in from %s", address)
            return pages.show(request, "sign_in.html", 401, problem="sign_in.wrong", wait=0)
        way.attempts.succeeded(name, address)
        return opened(request, way.sessions.open(account.name, account.roles, account.changed), "/")

    async def leave(request: Request) -> Response:
        await form_of(request)
        way.sessions.leave(way.cookie.of(request))
        response = RedirectResponse("/", 303)
        way.cookie.forget(response)
        return response

    if way.accounts is None:
        entries = [Address("/enter", by_link, OPEN)]
    else:
        entries = [Address("/enter", ask, OPEN), Address("/enter", sign_in, OPEN, methods=["POST"])]
    return [*entries, Address("/leave", leave, "", methods=["POST"])]
