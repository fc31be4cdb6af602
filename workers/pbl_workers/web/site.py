"""Options of the page, and the parts that its views share, which a view takes from its request (`of`)."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

from starlette.requests import Request

from ..on_request import compute_visit
from ..process_queue import ProcessQueue
from .access import Cookie, Sessions
from .accounts import AT_ONCE, Accounts, Attempts
from .audit import Looks
from .source import Source
from .tables import Asks

T = TypeVar("T")
#: Function that the process of a visit runs, of session_id and whether errors are tried again.
Target = Callable[[int, bool], None]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the page. hosts: names in a Host header that are answered; name and roles: of the person who opens a
    link; on_entry: called when a link was used, with the key of the next one. accounts: of those who sign in, None
    if links open the page; secure: browsers reach it by TLS; folder: results that are shown instead of the tables;
    target: function that computes a visit in a process."""

    hosts: frozenset[str] = frozenset({"127.0.0.1", "localhost", "::1"})
    name: str = ""
    roles: tuple[str, ...] = ("reviewer", "operator")
    on_entry: Callable[[str], None] | None = None
    accounts: Accounts | None = None
    secure: bool = False
    folder: Source | None = None
    target: Target = compute_visit


@dataclasses.dataclass(frozen=True)
class Site:
    """Parts that the views of an application share: `app.state.site`. looks: None if they are not recorded; comparing:
    turn of those whose password is compared; making: overlays and reports; computing: visits."""

    options: Options
    sessions: Sessions
    cookie: Cookie
    phone_cookie: Cookie
    asks: Asks
    source: Source
    looks: Looks | None
    attempts: Attempts = dataclasses.field(default_factory=Attempts)
    comparing: asyncio.Semaphore = dataclasses.field(default_factory=lambda: asyncio.Semaphore(AT_ONCE))
    making: ProcessQueue = dataclasses.field(default_factory=lambda: ProcessQueue(most=20, kept=8))
    computing: ProcessQueue = dataclasses.field(default_factory=lambda: ProcessQueue(most=50, kept=50))

    def close(self) -> None:
        for one in (self.making, self.computing, self.source, self.asks):
            one.close()


def of(request: Request) -> Site:
    """Return the parts that the views of an application share, from one of its requests."""
    return request.app.state.site


async def ask(request: Request, question: Callable[..., T], *args: Any) -> T:
    """Return the answer of a function that reads or writes tables or the folder of results (`Asks.ask`)."""
    return await of(request).asks.ask(question, *args)
