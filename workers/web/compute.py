"""Compute a visit on request, and how far it is."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from schemas.reading.visit_progress import visit_progress

from ..process_queue import ProcessQueue
from .access import Refused, form_of
from .address import Address, number_of
from .computing import Target, begin, told
from .pages import Pages
from .recordings import own_address
from .tables import Tables


def routes(pages: Pages, tables: Tables, computing: ProcessQueue, target: Target) -> list[Address]:
    """The addresses of this part."""

    async def compute(request: Request) -> Response:
        fields = await form_of(request)
        number = number_of(request)
        if fields.get("again") not in ("yes", "no"):
            raise Refused("form")
        await tables.ask(_must_be_there, number)
        begin(computing, target, number, fields["again"] == "yes")
        return RedirectResponse(own_address(fields.get("back", f"/visits/{number}")), 303)

    async def progress(request: Request) -> Response:
        number = number_of(request)
        await tables.ask(_must_be_there, number)
        return pages.show(request, "progress.html", told=told(request, await tables.ask(visit_progress, number)))

    return [
        Address("/visits/{session_id:int}/compute", compute, "decide", methods=["POST"]),
        Address("/visits/{session_id:int}/progress", progress, "look", look="progress"),
    ]


def _must_be_there(session_id: int) -> None:
    from schemas import session

    if not session.Session & {"session_id": session_id}:
        raise session.unknown_visit(session_id)
