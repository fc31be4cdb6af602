"""Look at a recording: its video, the fitted body, curves and events on one time line."""

from __future__ import annotations

import asyncio
import re

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from pbl_pipeline.errors import PblError
from schemas import choose, decide, recording_page

from .find import number_of
from .movement import body_json, movement_json, points_bytes
from .pages import Pages
from .tables import Tables
from .videos import Videos

_OWN = re.compile(r"/(visits|recordings)(/\d{1,10}(/enter)?)?|/operate")
#: How browsers call a file by its ending; others are offered as MP4, and a browser that cannot play one says so.
_KINDS = {".webm": "video/webm", ".mkv": "video/x-matroska", ".mov": "video/mp4", ".mp4": "video/mp4"}


def routes(pages: Pages, tables: Tables, videos: Videos) -> list[Route]:
    """The addresses of this part."""

    async def recording(request: Request) -> Response:
        about = await tables.ask(recording_page.recording_about, number_of(request))
        problem: PblError | None = None
        if about.has_pictures:
            try:
                await tables.ask(videos.path, about.video_id)
            except PblError as error:
                problem = error
        people, seen = await tables.ask(_people, about) if about.has_pictures else ([], [])
        return pages.show(request, "recording.html", about=about, no_video=problem, people=people, seen=seen)

    async def video(request: Request) -> Response:
        path = await tables.ask(videos.path, number_of(request))
        return FileResponse(path, media_type=_KINDS.get(path.suffix.lower(), "video/mp4"))

    async def fitted(request: Request) -> recording_page.RecordingFit:
        about = await tables.ask(recording_page.recording_about, number_of(request))
        if about.key is None:
            raise PblError(
                "DB_NOT_FOUND",
                found=f"no fit of video_id {about.video_id}: {about.problem}",
                expected="a recording to which a body is fitted",
                next_step="`pbl populate`; `pbl why` says what stops it",
            )
        return await tables.ask(recording_page.recording_fit, about.key)

    async def movement(request: Request) -> Response:
        found = await fitted(request)
        return Response(await asyncio.to_thread(movement_json, found), media_type="application/json")

    async def body(request: Request) -> Response:
        found = await fitted(request)
        _, numbers = await asyncio.to_thread(body_json, found)
        return Response(numbers, media_type="application/octet-stream")

    async def points(request: Request) -> Response:
        found = await fitted(request)
        return Response(await asyncio.to_thread(points_bytes, found), media_type="application/octet-stream")

    return [
        Route("/recordings/{number:int}", recording),
        Route("/recordings/{number:int}/video", video),
        Route("/recordings/{number:int}/movement", movement),
        Route("/recordings/{number:int}/body", body),
        Route("/recordings/{number:int}/points", points),
    ]


def _people(about: recording_page.RecordingPage) -> tuple[list[choose.Candidates], list[str]]:
    """Who can be chosen, by tracking method, and the state in which that is shown. Empty before people are searched."""
    try:
        found = choose.candidates(about.video_id)
    except PblError as error:
        if error.code != "DB_NOT_FOUND":
            raise
        return [], []
    return found, [decide.person_state(about.video_id, c.key["tracking_method"]) for c in found]


def own_address(text: str) -> str:
    """An address of this page that a form names, else the first page."""
    return text if _OWN.fullmatch(text) else "/"
