"""Look at a recording: its video, the fitted body, curves and events on one time line."""

from __future__ import annotations

import asyncio
import collections
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Protocol

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from pbl_pipeline.errors import PblError
from schemas import choose, decide, recording_page
from schemas.visit_progress import Progress, visit_progress

from . import judge
from .computing import told as told_of
from .find import number_of
from .movement import Movement
from .pages import Pages
from .tables import Asks
from .videos import Videos

#: Recordings whose movement is kept in memory at a time: some hundred kB each.
_KEPT = 8
_OWN = re.compile(r"/(visits|recordings)(/\d{1,10}(/enter)?)?|/operate")
#: How browsers call a file by its ending; others are offered as MP4, and a browser that cannot play one says so.
_KINDS = {".webm": "video/webm", ".mkv": "video/x-matroska", ".mov": "video/mp4", ".mp4": "video/mp4"}


class Recordings(Protocol):
    """Where recordings come from: the tables, or a folder of results (`results_folder.ResultsFolder`)."""

    def about(self, number: int) -> recording_page.RecordingPage:
        """A recording by its number. Raises `PblError` DB_NOT_FOUND."""
        ...

    def path(self, number: int) -> Path:
        """The video that is shown of it. Raises `PblError` DB_NOT_FOUND, VIDEO_MISSING."""
        ...

    def state(self, number: int) -> Hashable:
        """What tells apart what was fitted to it. Raises `PblError` DB_NOT_FOUND where nothing was."""
        ...

    def load(self, number: int) -> recording_page.RecordingFit:
        """The fitted movement of it, where there is one. Raises `PblError` for files that cannot be read."""
        ...

    def people(self, about: recording_page.RecordingPage) -> tuple[list[choose.Candidates], list[str]]:
        """Who can be chosen, by tracking method, and the state in which that is shown."""
        ...

    def judged(self, number: int) -> judge.Judged:
        """What people decided about it."""
        ...

    def progress(self, session_id: int) -> Progress:
        """What is still to be computed of its visit."""
        ...


class OfTables:
    """The recordings of the tables."""

    def __init__(self, videos: Videos) -> None:
        self._videos = videos

    def about(self, number: int) -> recording_page.RecordingPage:
        return recording_page.recording_about(number)

    def path(self, number: int) -> Path:
        return self._videos.path(number)

    def state(self, number: int) -> Hashable:
        return recording_page.computed(recording_page.fitted_key(number))

    def load(self, number: int) -> recording_page.RecordingFit:
        return recording_page.recording_fit(recording_page.fitted_key(number))

    def people(self, about: recording_page.RecordingPage) -> tuple[list[choose.Candidates], list[str]]:
        return _people(about)

    def judged(self, number: int) -> judge.Judged:
        return judge.judged(number)

    def progress(self, session_id: int) -> Progress:
        return visit_progress(session_id)


def routes(pages: Pages, asks: Asks, recordings: Recordings) -> list[Route]:
    """The addresses of this part."""

    async def recording(request: Request) -> Response:
        about = await asks.ask(recordings.about, number_of(request))
        problem: PblError | None = None
        if about.has_pictures:
            try:
                await asks.ask(recordings.path, about.video_id)
            except PblError as error:
                problem = error
        people, seen = await asks.ask(recordings.people, about) if about.has_pictures else ([], [])
        judged = await asks.ask(recordings.judged, about.video_id)
        told = told_of(request, await asks.ask(recordings.progress, about.session_id))
        return pages.show(
            request, "recording.html", about=about, no_video=problem, people=people, seen=seen, judged=judged, told=told
        )

    async def video(request: Request) -> Response:
        path = await asks.ask(recordings.path, number_of(request))
        return FileResponse(path, media_type=_KINDS.get(path.suffix.lower(), "video/mp4"))

    kept: collections.OrderedDict[Hashable, asyncio.Future[Movement]] = collections.OrderedDict()

    async def prepared(request: Request) -> Movement:
        """What a recording's page asks for, made once for the requests of several."""
        number = number_of(request)
        key = await asks.ask(recordings.state, number)
        if key not in kept:
            kept[key] = asyncio.ensure_future(prepare(number))
            while len(kept) > _KEPT:
                kept.popitem(last=False)
        kept.move_to_end(key)
        try:
            return await asyncio.shield(kept[key])
        except Exception:
            kept.pop(key, None)  # what was wrong may be put right
            raise

    async def prepare(number: int) -> Movement:
        found = await asks.ask(recordings.load, number)
        return await asyncio.to_thread(Movement.of, found)

    async def movement(request: Request) -> Response:
        return Response((await prepared(request)).movement, media_type="application/json")

    async def body(request: Request) -> Response:
        return Response((await prepared(request)).body, media_type="application/octet-stream")

    async def points(request: Request) -> Response:
        return Response((await prepared(request)).points, media_type="application/octet-stream")

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
