"""The page of a recording: its video, the fitted body, curves and events on one time line."""

from __future__ import annotations

import asyncio
import collections
from collections.abc import Hashable

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from pbl_pipeline.errors import PblError
from pbl_pipeline.visit import Recording

from .address import Address, number_of, page
from .computing import told as told_of
from .movement import Movement
from .pages import Pages
from .source import Source
from .tables import Asks

#: Recordings whose movement is kept in memory at a time: some hundred kB each.
_KEPT = 8
#: Media types by ending; other files are offered as MP4, and a browser reports one that it cannot play.
_KINDS = {".webm": "video/webm", ".mkv": "video/x-matroska", ".mov": "video/mp4", ".mp4": "video/mp4"}


def routes(pages: Pages, asks: Asks, source: Source) -> list[Address]:
    async def recording(request: Request) -> Response:
        about = await asks.ask(source.recording, number_of(request))
        problem: PblError | None = None
        if about.pictures:
            try:
                await asks.ask(source.video, about.number)
            except PblError as error:
                problem = error
        people, seen = await asks.ask(source.people, about) if about.pictures else ([], [])
        judged = await asks.ask(source.judged, about.number)
        told = told_of(request, await asks.ask(source.progress, about.session_id))
        return pages.show(
            request, "recording.html", about=about, no_video=problem, people=people, seen=seen, judged=judged, told=told
        )

    async def video(request: Request) -> Response:
        path = await asks.ask(source.video, number_of(request))
        return FileResponse(path, media_type=_KINDS.get(path.suffix.lower(), "video/mp4"))

    kept: collections.OrderedDict[Hashable, asyncio.Future[Movement]] = collections.OrderedDict()

    async def prepared(request: Request) -> Movement:
        """Return the data of a recording's page, made once for concurrent requests."""
        number = number_of(request)
        key = await asks.ask(source.state, number)
        if key not in kept:
            kept[key] = asyncio.ensure_future(prepare(number))
            while len(kept) > _KEPT:
                kept.popitem(last=False)
        kept.move_to_end(key)
        try:
            return await asyncio.shield(kept[key])
        except Exception:
            kept.pop(key, None)  # it may be mended meanwhile
            raise

    async def prepare(number: int) -> Movement:
        return await asyncio.to_thread(Movement.of, await asks.ask(loaded, number))

    def loaded(number: int) -> Recording:
        """Load the arrays in the thread that may."""
        return source.recording(number).fitted().loaded()

    async def movement(request: Request) -> Response:
        return Response((await prepared(request)).movement, media_type="application/json")

    async def body(request: Request) -> Response:
        return Response((await prepared(request)).body, media_type="application/octet-stream")

    async def points(request: Request) -> Response:
        return Response((await prepared(request)).points, media_type="application/octet-stream")

    return [
        *page("/recordings/{video_id:int}", recording, "look", look="page"),
        Address("/recordings/{video_id:int}/video", video, "look", look="video"),
        Address("/recordings/{video_id:int}/movement", movement, "look", look="movement"),
        Address("/recordings/{video_id:int}/body", body, "look", look="body"),
        Address("/recordings/{video_id:int}/points", points, "look", look="points"),
    ]
