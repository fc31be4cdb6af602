"""The people of a recording over its time line, for choosing one of them in the video itself."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import numpy as np
from starlette.requests import Request
from starlette.responses import Response

from schemas import reading, video
from schemas.decisions import candidates

from .address import Address, number_of, whole_number
from .pages import Pages
from .tables import Tables

if TYPE_CHECKING:
    from pbl_pipeline.tracking import Tracking


def routes(pages: Pages, tables: Tables) -> list[Address]:
    """The addresses of this part."""

    async def boxes(request: Request) -> Response:
        number, which = number_of(request), whole_number(request.query_params.get("method", "0"))

        def load() -> Tracking:
            found = candidates.candidates(number)
            if which is None or which >= len(found):
                raise video.unknown_video(number)
            return reading.load_tracking(found[which].key)

        tracked = await tables.ask(load)
        return Response(await asyncio.to_thread(boxes_json, tracked), media_type="application/json")

    return [Address("/recordings/{video_id:int}/boxes", boxes, "look", look="boxes")]


def boxes_json(tracked: Tracking) -> bytes:
    """Boxes of everybody as JSON.

    `size`: width, height of the upright video (px); `time`: (T) s; `people`: number of a person and `boxes`: for each
    frame x0, y0, x1, y1 (px) and whether somebody was detected there (1) or the box is carried over a gap (0); null in
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
