"""Leaves a row for each look at a recording, before it is shown, where PBL_AUDIT_LOOKS asks for it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from pbl_pipeline.errors import PblError
from schemas.decisions.viewing_log import record_viewing

from .access import Session
from .address import LARGEST
from .tables import Tables

#: Seconds in which what a page asks for again and again (ranges of a video) is one look.
AGAIN_S = 600.0
#: A recording with all that belongs to it; and files of a visit. Its page has measures, no pictures of a person.
_OF = (
    ("video_id", re.compile(r"/recordings/(\d{1,10})(?:\.json|/([a-z_]+).*)?")),
    ("session_id", re.compile(r"/visits/(\d{1,10})/(?!enter)([a-z_]+).*")),
)


class Looks:
    """Behind `Gate`: whoever comes here has a session. What cannot be written down is not shown.

    failed
        Makes the answer for an error of the tables.
    """

    def __init__(
        self, app: ASGIApp, tables: Tables, failed: Callable[[Request, PblError], Any], clock: Callable = time.monotonic
    ) -> None:
        self._app, self._tables, self._failed, self._clock = app, tables, failed, clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] in ("GET", "HEAD"):
            request = Request(scope, receive)
            session: Session | None = request.state.session
            for of, pattern in _OF:
                found = pattern.fullmatch(scope["path"])
                if session is None or found is None or int(found[1]) > LARGEST:
                    continue
                try:
                    await self._look(session, of, int(found[1]), found[2] or "page")
                except PblError as error:
                    await self._failed(request, error)(scope, receive, send)
                    return
        await self._app(scope, receive, send)

    async def _look(self, session: Session, of: str, number: int, what: str) -> None:
        key, now = (of, str(number), what), self._clock()
        if what != "page" and now - session.looked.get(key, -AGAIN_S) < AGAIN_S:
            return
        await self._tables.ask(record_viewing, of, number, what, session.name)
        session.looked[key] = now
