"""Ways to sign in: by a link that is used once, or with the password of an account."""

from __future__ import annotations

import asyncio
import logging
import math

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline.names import whole_number

from . import pages, site
from .access import HOURS, form_of, read_form
from .address import OPEN, Address

log = logging.getLogger(__name__)


def opened(request: Request, value: str, to: str) -> Response:
    # The browser never chooses its session, and the one that it had ends.
    here = site.of(request)
    here.sessions.leave(here.cookie.of(request))
    response = RedirectResponse(to, 303)
    here.cookie.set(response, value, int(3600 * HOURS))
    return response


async def by_link(request: Request) -> Response:
    here = site.of(request)
    value = here.sessions.enter(request.query_params.get("key", ""))
    if value is None:
        return pages.refused(request, "session")
    to = request.query_params.get("to", "")
    response = opened(request, value, to if to.startswith("/visits/") and whole_number(to[8:]) else "/")
    if here.options.on_entry is not None:
        here.options.on_entry(here.sessions.new_link(here.options.name, *here.options.roles))
    return response


async def ask(request: Request) -> Response:
    return pages.show(request, "sign_in.html", problem="", wait=0, name="")


async def sign_in(request: Request) -> Response:
    here, accounts = site.of(request), site.of(request).options.accounts
    assert accounts is not None
    fields = await read_form(request)
    name, password = fields.get("name", "").strip(), fields.get("password", "")
    address = request.client.host if request.client else ""
    wait = here.attempts.wait_s(name, address)
    if wait > 0:
        seconds = math.ceil(wait)
        headers = {"retry-after": str(seconds)}
        return pages.show(request, "sign_in.html", 429, headers, problem="sign_in.wait", wait=seconds, name=name)
    here.attempts.failed(name, address)
    async with here.comparing:
        account = await asyncio.to_thread(accounts.check, name, password)
    if account is None:
        # No name: people write their password into the wrong field.
        log.warning("a failed sign-in from %s", address)
        return pages.show(request, "sign_in.html", 401, problem="sign_in.wrong", wait=0, name=name)
    here.attempts.succeeded(name, address)
    return opened(request, here.sessions.open(account.name, account.roles, account.changed), "/")


async def leave(request: Request) -> Response:
    await form_of(request)
    here = site.of(request)
    here.sessions.leave(here.cookie.of(request))
    response = RedirectResponse("/", 303)
    here.cookie.forget(response)
    return response


#: Where links open the page, and where people sign in; and of both.
BY_LINK = [Address("/enter", by_link, OPEN)]
BY_PASSWORD = [Address("/enter", ask, OPEN), Address("/enter", sign_in, OPEN, methods=["POST"])]
ROUTES = [Address("/leave", leave, "", methods=["POST"])]
