"""Marks of recordings as not usable, and corrected events. Each decision is a row (`pbl_schemas.decisions`)."""

from __future__ import annotations

import re

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_schemas.decisions import event_corrections, review_decisions

from . import site
from .access import Refused, form_of, sender
from .address import Address, number_of

_EVENT = re.compile(r"(\d{1,5}(?:\.\d{1,6})?)([lr])([du])", re.ASCII)
_EVENTS = {"d": "foot_down", "u": "foot_up"}


async def usable_or_not(request: Request) -> Response:
    fields = await form_of(request)
    number, seen = number_of(request), fields.get("seen", "")
    if fields.get("usable") == "yes":
        await site.ask(request, review_decisions.take_back, number, sender(request), seen)
    elif fields.get("usable") == "no":
        reason, note = fields.get("reason", ""), fields.get("note", "")
        await site.ask(request, review_decisions.mark_not_usable, number, reason, note, sender(request), seen)
    else:
        raise Refused("form")
    return RedirectResponse(f"/recordings/{number}", 303)


async def events(request: Request) -> Response:
    fields = await form_of(request)
    number, seen = number_of(request), fields.get("seen", "")
    if fields.get("back") == "automatic":
        await site.ask(request, event_corrections.take_back, number, sender(request), seen)
    else:
        found = _events(fields.get("events", ""))
        await site.ask(request, event_corrections.save, number, found, sender(request), seen)
    return RedirectResponse(f"/recordings/{number}", 303)


ROUTES = [
    Address("/recordings/{video_id:int}/usable", usable_or_not, "decide", methods=["POST"]),
    Address("/recordings/{video_id:int}/events", events, "decide", methods=["POST"]),
]


def _events(text: str) -> list[tuple[float, str, str]]:
    """Events as the page sends them: `1.2345ld` is the left initial contact at 1.2345 s."""
    out = []
    for word in text.split():
        found = _EVENT.fullmatch(word)
        if not found:
            raise Refused("form")
        out.append((float(found[1]), {"l": "left", "r": "right"}[found[2]], _EVENTS[found[3]]))
    return out
