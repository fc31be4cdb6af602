"""Marks of recordings as not usable, and corrected events. Each decision is a row (`pbl_schemas.decisions`)."""

from __future__ import annotations

import dataclasses
import re

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline.words import UNUSABLE
from pbl_schemas import fit
from pbl_schemas.decisions import event_corrections, not_usable, review_decisions

from ..refresh import queue_visit_of
from .access import Refused, form_of, sender
from .address import Address, number_of
from .tables import Tables

_EVENT = re.compile(r"(\d{1,5}(?:\.\d{1,6})?)([lr])([du])", re.ASCII)
_EVENTS = {"d": "foot_down", "u": "foot_up"}


@dataclasses.dataclass(frozen=True)
class Judged:
    """Decisions about a recording, and the state in which the page shows it. views: videos of its trial, which are
    marked together; events: those that count, None if none were searched."""

    mark: not_usable.Unusable | None
    usable_state: str
    views: int
    events: event_corrections.ShownEvents | None
    reasons: tuple[str, ...] = tuple(UNUSABLE)


def judged(video_id: int) -> Judged:
    """Return the decisions about a registered recording. Reads tables."""
    views = fit.videos_of(fit.trial_of(video_id))
    mark = not_usable.unusable([video_id]).get(video_id)
    return Judged(mark, review_decisions.usable_state(video_id), len(views), event_corrections.shown_events(video_id))


def routes(tables: Tables) -> list[Address]:
    async def usable_or_not(request: Request) -> Response:
        fields = await form_of(request)
        number, seen = number_of(request), fields.get("seen", "")
        if fields.get("usable") == "yes":
            await tables.ask(review_decisions.take_back, number, sender(request), seen)
        elif fields.get("usable") == "no":
            reason, note = fields.get("reason", ""), fields.get("note", "")
            await tables.ask(review_decisions.mark_not_usable, number, reason, note, sender(request), seen)
        else:
            raise Refused("form")
        await tables.ask(queue_visit_of, number)
        return RedirectResponse(f"/recordings/{number}", 303)

    async def events(request: Request) -> Response:
        fields = await form_of(request)
        number, seen = number_of(request), fields.get("seen", "")
        if fields.get("back") == "automatic":
            await tables.ask(event_corrections.take_back, number, sender(request), seen)
        else:
            found = _events(fields.get("events", ""))
            await tables.ask(event_corrections.save, number, found, sender(request), seen)
        await tables.ask(queue_visit_of, number)
        return RedirectResponse(f"/recordings/{number}", 303)

    return [
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
