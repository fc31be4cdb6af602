"""The page of a recording: its video, the fitted body, curves and events on one time line."""

from __future__ import annotations

import asyncio
import collections
from collections.abc import Hashable

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from pbl_pipeline.errors import PblError

from . import pages, site
from .address import Address, number_of, page
from .computing import told as told_of
from .movement import Movement

#: Recordings whose movement is kept in memory at a time: some hundred kB each.
_KEPT = 8
#: Media types by ending; other files are offered as MP4, and a browser reports one that it cannot play.
_KINDS = {".webm": "video/webm", ".mkv": "video/x-matroska", ".mov": "video/mp4", ".mp4": "video/mp4"}


async def recording(request: Request) -> Response:
    source = site.of(request).source
    about = await site.ask(request, source.recording, number_of(request))
    problem: PblError | None = None
    if about.pictures:
        try:
            await site.ask(request, source.video, about.number)
        except PblError as error:
            problem = error
    people, seen = await site.ask(request, source.people, about) if about.pictures else ([], [])
    judged = await site.ask(request, source.judged, about.number)
    told = told_of(request, await site.ask(request, source.progress, about.session_id))
    return pages.show(
        request, "recording.html", about=about, no_video=problem, people=people, seen=seen, judged=judged, told=told
    )


async def video(request: Request) -> Response:
    path = await site.ask(request, site.of(request).source.video, number_of(request))
    return FileResponse(path, media_type=_KINDS.get(path.suffix.lower(), "video/mp4"))


class Movements:
    """Views of the data of a recording's page, which are made once for concurrent requests."""

    def __init__(self) -> None:
        self._kept: collections.OrderedDict[Hashable, asyncio.Future[Movement]] = collections.OrderedDict()

    async def movement(self, request: Request) -> Response:
        return Response((await self._prepared(request)).movement, media_type="application/json")

    async def body(self, request: Request) -> Response:
        return Response((await self._prepared(request)).body, media_type="application/octet-stream")

    async def points(self, request: Request) -> Response:
        return Response((await self._prepared(request)).points, media_type="application/octet-stream")

    async def _prepared(self, request: Request) -> Movement:
        kept, key = self._kept, await site.ask(request, site.of(request).source.state, number_of(request))
        if key not in kept:
            kept[key] = asyncio.ensure_future(_prepare(request))
            while len(kept) > _KEPT:
                kept.popitem(last=False)
        kept.move_to_end(key)
        try:
            return await asyncio.shield(kept[key])
        except Exception:
            kept.pop(key, None)  # it may be mended meanwhile
            raise


async def _prepare(request: Request) -> Movement:
    source, number = site.of(request).source, number_of(request)
    # Arrays are loaded in the thread that may.
    found = await site.ask(request, lambda: source.recording(number).fitted().loaded())
    return await asyncio.to_thread(Movement.of, found)


def routes() -> list[Address]:
    made = Movements()
    return [
        *page("/recordings/{video_id:int}", recording, "look", look="page"),
        Address("/recordings/{video_id:int}/video", video, "look", look="video"),
        Address("/recordings/{video_id:int}/movement", made.movement, "look", look="movement"),
        Address("/recordings/{video_id:int}/body", made.body, "look", look="body"),
        Address("/recordings/{video_id:int}/points", made.points, "look", look="points"),
    ]
