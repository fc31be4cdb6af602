"""Addresses of the page: each declares its right, and the look at a person that it records."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from starlette.requests import Request
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from pbl_pipeline.names import whole_number
from pbl_schemas.intake.phone_recordings import phone_of

from . import site
from .access import Refused, Session

if TYPE_CHECKING:
    from pbl_pipeline.change import Result

#: Right of an address that is open without a session; the others are those of `access.RIGHTS`, and "" for any session.
OPEN = "open"
#: Right of an address that answers phones alone, which opened the link of a visit.
FILM = "film"
#: Ending of the address of a page as JSON.
JSON = ".json"
_OWN = re.compile(r"/(visits|recordings)(/[0-9]{1,9}(/enter)?)?|/operate")


class Address(Route):
    """An address of the page, which answers those who have its right.

    right
        Of `access.RIGHTS`; "" for any session, `OPEN` without one, `FILM` for phones.
    look
        What is looked at of the recording (`{video_id:int}` in the path) or visit (`{session_id:int}`), such as
        "video": a row of `pbl_schemas.review.Viewing` before it is shown. Empty if no person is looked at.
    """

    def __init__(
        self, path: str, answer: Callable[..., Any], right: str, *, look: str = "", methods: Sequence[str] = ("GET",)
    ) -> None:
        super().__init__(path, answer, methods=methods)
        self.right, self.look = right, look

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request. Raises `Refused` for a sender without the right; `PblError` for a look without its
        row, PHONE_LINK for a phone whose link has ended."""
        request = Request(scope)
        session: Session | None = request.state.session
        if self.right == FILM:
            cookie = site.of(request).phone_cookie.of(request)
            request.state.phone = await site.ask(request, phone_of, cookie) if cookie else None
            if request.state.phone is None:
                raise Refused("session" if session is None else "right")
        elif self.right != OPEN:
            if session is None:
                raise Refused("session")
            if not session.may(self.right):
                raise Refused("right")
            looks = site.of(request).looks
            if self.look and looks is not None and scope["method"] in (self.methods or ()):
                ((of, number),) = request.path_params.items()
                await looks.record(session, of, number, self.look)
        await super().handle(scope, receive, send)


def page(path: str, answer: Callable[..., Any], right: str, *, look: str = "") -> list[Address]:
    """Return the addresses of a page: as JSON and as HTML."""
    return [Address(path + JSON, answer, right, look=look), Address(path, answer, right, look=look)]


def number_of(request: Request) -> int:
    (number,) = request.path_params.values()
    return number


def own_address(text: str) -> str:
    """Return an address of this page that a form names, else the first page."""
    return text if _OWN.fullmatch(text) else "/"


def shown_of(request: Request) -> int:
    """Return which result of a visit is asked for; -1, which none has, if that is not a number."""
    asked = whole_number(request.query_params.get("result", "0"))
    return -1 if asked is None else asked


def interval(result: Result) -> str:
    """Return the 90 % interval of an index as numbers, "78 to 87"; empty if its error is not known."""
    from pbl_pipeline.gait import interval_90

    bounds = interval_90(result.index, result.sd)
    return "" if bounds is None else f"{bounds[0]:.0f}\N{EN DASH}{bounds[1]:.0f}"
