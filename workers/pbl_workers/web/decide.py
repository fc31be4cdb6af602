"""Choice of the measured person, and accepted warnings; each decision is a row (`pbl_schemas.decisions`)."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import whole_number
from pbl_pipeline.temporary import new_folder
from pbl_schemas import reading, video
from pbl_schemas.decisions import candidates, review_decisions

from . import site
from .access import Refused, form_of, sender
from .address import Address, number_of

if TYPE_CHECKING:
    from pbl_pipeline.tracking import Tracking


async def person(request: Request) -> Response:
    fields = await form_of(request)
    number = number_of(request)
    chosen = _number(fields.get("person", ""))
    method, seen = fields.get("method", ""), fields.get("seen", "")
    await site.ask(request, review_decisions.decide_person, number, chosen, method, sender(request), seen)
    return RedirectResponse(f"/recordings/{number}", 303)


async def accept(request: Request) -> Response:
    fields = await form_of(request)
    number, shown = number_of(request), _number(fields.get("result", ""))
    await site.ask(request, _accept, number, shown, fields, sender(request))
    return RedirectResponse(f"/visits/{number}?result={shown}", 303)


async def boxes(request: Request) -> Response:
    number, which = number_of(request), whole_number(request.query_params.get("method", "0"))
    tracked = await site.ask(request, lambda: reading.load_tracking(_candidates(number, which).key))
    return Response(await asyncio.to_thread(boxes_json, tracked), media_type="application/json")


async def people(request: Request) -> Response:
    number, which = number_of(request), _number(request.query_params.get("method", "0"))
    return Response(await site.ask(request, _picture, number, which), media_type="image/jpeg")


ROUTES = [
    Address("/recordings/{video_id:int}/person", person, "decide", methods=["POST"]),
    Address("/recordings/{video_id:int}/people", people, "look", look="people"),
    Address("/recordings/{video_id:int}/boxes", boxes, "look", look="boxes"),
    Address("/visits/{session_id:int}/accept", accept, "decide", methods=["POST"]),
]


def _accept(number: int, shown: int, fields: Mapping[str, str], by: str) -> None:
    """Accept the check of a visit that a form names. Raises `PblError` DECIDED_MEANWHILE for another computation."""
    from pbl_schemas.reading.shown import shown_visit

    about = shown_visit(number, shown)
    if not about.key or about.computed != fields.get("computed"):
        raise PblError(
            "DECIDED_MEANWHILE",
            found="the checks were computed anew since this page was loaded",
            expected="the checks that the page showed; nothing of yours was written",
            next_step="load the page again and look at them",
            key=f"session_id={number}",
        )
    review_decisions.accept_check(about.key, _number(fields.get("check", "")), by, fields.get("reason", ""))


def _picture(video_id: int, which: int) -> bytes:
    """The picture of the numbered people. It is of the original: none if heads are to be hidden."""
    if settings.deidentify_how():
        raise video.unknown_video(video_id)
    with new_folder() as folder:
        return candidates.write_sheet(_candidates(video_id, which), folder / "people.jpg").read_bytes()


def _candidates(video_id: int, which: int | None) -> candidates.Candidates:
    """Return the candidates of a recording by one of its tracking methods. Raises `PblError` DB_NOT_FOUND."""
    found = candidates.candidates(video_id)
    if which is None or which >= len(found):
        raise video.unknown_video(video_id)
    return found[which]


def _number(text: str) -> int:
    number = whole_number(text)
    if number is None:
        raise Refused("form")
    return number


def boxes_json(tracked: Tracking) -> bytes:
    """Return the boxes of all people as JSON.

    `size`: width, height of the upright video (px); `time`: (T) s; `people`: number of a person and `boxes`: for each
    frame x0, y0, x1, y1 (px) and whether a person was detected there (1) or the box is carried over a gap (0); null in
    frames without the person.
    """
    people: list[dict[str, Any]] = []
    for person in tracked.persons:
        known = np.asarray(np.isfinite(person.box_px).all(axis=1), bool)
        rows = [
            [*(round(float(v)) for v in box), int(seen)] if there else None
            for box, seen, there in zip(person.box_px, person.observed, known, strict=True)
        ]
        people.append({"number": int(person.person_id), "boxes": rows})
    out = {
        "size": [int(v) for v in tracked.image_size_px],
        "time": [round(float(t), 5) for t in tracked.time_s],
        "people": people,
    }
    return json.dumps(out, allow_nan=False, separators=(",", ":")).encode()
