"""Visits that are computed on request, and how far each is."""

from __future__ import annotations

import dataclasses
import functools

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline.errors import PblError
from pbl_schemas import session
from pbl_schemas.reading.visit_progress import Progress, visit_progress

from ..process_queue import Task
from . import pages, site
from .access import Refused, form_of
from .address import Address, number_of, own_address

#: Seconds that a process is given to put its job back when the page ends.
END_S = 15.0


def begin(request: Request, session_id: int, again: bool) -> None:
    """Have a visit computed; `again`: including what failed.

    A job that a worker has taken is not taken twice, and a process that ends leaves no partial result: all it does
    passes through the queues of the tables.

    Raises `PblError` USAGE where too many visits wait.
    """
    computing, target = site.of(request).computing, site.of(request).options.target
    for key in ((session_id, False), (session_id, True)):
        computing.drop(key)
    task = Task(target, (session_id, again), functools.partial(_broken, session_id), end_s=END_S)
    computing.begin((session_id, again), task)


def _broken(session_id: int, found: str) -> PblError:
    return PblError(
        "WORKER_CRASH",
        found=f"the computation of the visit broke off: {found}",
        expected="a process that computes it to its end",
        next_step="compute it again, which frees what it held; the terminal of `pbl web` has details",
        key=f"session_id={session_id}",
    )


@dataclasses.dataclass(frozen=True)
class Told:
    progress: Progress
    state: str  # "running" or "waiting" here, or "" if it was not asked for
    error: PblError | None  # what ended its last process before it was done

    @property
    def busy(self) -> bool:
        """True if it changes by itself: the page asks again."""
        return bool(self.state or self.progress.running)


def told(request: Request, progress: Progress) -> Told:
    """Return how far a visit is, for a page."""
    computing = site.of(request).computing
    works = [w for again in (False, True) if (w := computing.find((progress.session_id, again))) is not None]
    states, errors = [w.state for w in works], [w.error for w in works if w.error is not None]
    return Told(progress, next((s for s in ("running", "waiting") if s in states), ""), errors[0] if errors else None)


async def compute(request: Request) -> Response:
    fields = await form_of(request)
    number = number_of(request)
    if fields.get("again") not in ("yes", "no"):
        raise Refused("form")
    await site.ask(request, session.registered_visit, number)
    begin(request, number, fields["again"] == "yes")
    return RedirectResponse(own_address(fields.get("back", f"/visits/{number}")), 303)


async def progress(request: Request) -> Response:
    number = number_of(request)
    await site.ask(request, session.registered_visit, number)
    return pages.show(request, "progress.html", told=told(request, await site.ask(request, visit_progress, number)))


ROUTES = [
    Address("/visits/{session_id:int}/compute", compute, "decide", methods=["POST"]),
    Address("/visits/{session_id:int}/progress", progress, "look", look="progress"),
]
