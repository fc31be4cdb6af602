"""The overlay video of a recording and the report of a visit, drawn on request."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError, joined, said
from pbl_schemas import privacy, video
from pbl_schemas.reading import shown as reading
from pbl_schemas.reading.visit_state import results_state

from .. import on_request
from ..process_queue import Task, Work
from . import pages, site
from .access import REPORT_POLICY
from .address import Address, number_of, shown_of
from .pages import reader_language

#: Time (s) and memory (byte) that one file may take: a minute of 4K video is drawn in a few minutes.
SECONDS, N_BYTES = 3600.0, 8 * 2**30


async def work_of(request: Request, key: Callable[..., Any], load: Callable[..., Task], *args: Any) -> Work:
    """The work that a request is about, begun where it was not. Raises what stopped it, once."""
    making, wanted = site.of(request).making, await site.ask(request, key, *args)
    work = making.find(wanted)
    if work is None:
        work = making.begin(wanted, await site.ask(request, load, *args))
    if work.error is not None:
        making.drop(wanted)
        raise work.error
    return work


async def overlay(request: Request) -> Response:
    number = number_of(request)
    about = await site.ask(request, reading.shown_recording, number)
    work = await work_of(request, overlay_key, load_overlay, number)
    return pages.show(request, "overlay.html", about=about, work=work)


async def overlay_file(request: Request) -> Response:
    number = number_of(request)
    work = site.of(request).making.find(await site.ask(request, overlay_key, number))
    if work is None or work.path is None:
        return RedirectResponse(f"/recordings/{number}/overlay", 303)
    return FileResponse(work.path, media_type="video/mp4", filename=f"recording_{number}_overlay.mp4",
                        content_disposition_type="inline")  # fmt: skip


async def report(request: Request) -> Response:
    number, shown = number_of(request), shown_of(request)
    work = await work_of(request, report_key, load_report, number, shown, reader_language(request))
    if work.path is None:
        return pages.show(request, "report_made.html", number=number, shown=shown, work=work)
    headers = {"content-security-policy": REPORT_POLICY}
    return FileResponse(work.path, media_type="text/html; charset=utf-8", headers=headers)


async def overlay_state(request: Request) -> Response:
    return state(site.of(request).making.find(await site.ask(request, overlay_key, number_of(request))))


async def report_state(request: Request) -> Response:
    key = await site.ask(request, report_key, number_of(request), shown_of(request), reader_language(request))
    return state(site.of(request).making.find(key))


ROUTES = [
    Address("/recordings/{video_id:int}/overlay", overlay, "look", look="overlay"),
    Address("/recordings/{video_id:int}/overlay/file", overlay_file, "look", look="overlay"),
    Address("/recordings/{video_id:int}/overlay/state", overlay_state, "look", look="overlay"),
    Address("/visits/{session_id:int}/report", report, "look", look="report"),
    Address("/visits/{session_id:int}/report/state", report_state, "look", look="report"),
]


def state(work: Work | None) -> Response:
    """Return the progress of a work for the script of a page that waits for it."""
    return JSONResponse({"ended": work is None or work.ended, "share": 0.0 if work is None else round(work.share, 3)})


# ------------------------------------------------------------------------------------ asked in the thread of the tables
def overlay_key(video_id: int) -> tuple[Any, ...]:
    """Return the dependencies of the overlay of a recording, which change with new results and with hidden heads.
    Raises `PblError` DB_NOT_FOUND for a recording without pictures or a fit."""
    about = reading.shown_recording(video_id)
    if not about.recording.fitted or about.recording.path is None:
        found = joined([said("no pictures with a fit of recording {n}.", n=video_id), about.recording.problem], " ")
        expected = "a recording to which a body is fitted"
        raise PblError("DB_NOT_FOUND", found, expected, "`pbl populate`; `pbl why` says what stops it")
    return ("overlay", video_id, *reading.computations(video_id), about.hidden_heads, privacy.copy_of(video_id))


def load_overlay(video_id: int) -> Task:
    """Return how the overlay of a recording is drawn."""
    found = reading.shown_recording(video_id).fitted().loaded()
    with contextlib.ExitStack() as stack:
        path = stack.enter_context(privacy.shown(video_id)) or video.present_file(video_id)
        return _task("overlay.mp4", on_request.draw_overlay, stack.pop_all(), dataclasses.replace(found, shown=path))


def report_key(session_id: int, shown: int, language: str) -> tuple[Any, ...]:
    """Return the dependencies of the report of a result of a visit in a language."""
    about = reading.computed_visit(session_id, shown)
    named = (about.row.subject, about.row.label, about.row.day)
    listed = [(r.name, r.condition, r.problem, about.marks.get(r.number or 0)) for r in about.recordings]
    results = (*about.key.values(), *results_state(session_id))
    return ("report", session_id, language, *named, *listed, *results, settings.deidentify_how())


def load_report(session_id: int, shown: int, language: str) -> Task:
    """Return how the report of a result of a visit is written in a language."""
    from pbl_schemas.reading.visits import to_show

    about = reading.computed_visit(session_id, shown)
    assert about.visit is not None
    with contextlib.ExitStack() as stack:
        visit = to_show(about.visit, stack).loaded()
        return _task("report.html", on_request.write_report, stack.pop_all(), visit, language)


def _task(file: str, function: Callable[..., None], open_files: contextlib.ExitStack, *args: Any) -> Task:
    """A file that is made by `function(path, *args)`, within limits."""
    return Task(function, args, _not_made, file, open_files, SECONDS, N_BYTES)


def _not_made(found: str) -> PblError:
    return PblError(
        "WEB_NOT_MADE",
        found=found,
        expected="a file that is written to its end",
        next_step="load the page again to have it made again; `pbl report` writes it without limits",
    )
