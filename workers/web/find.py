"""Find a visit: the list with its filters, and the visit's own page."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from schemas import decide, visit_list
from schemas.studies.visit_entry import entry
from schemas.visit_progress import visit_progress

from .access import Session, form_of
from .computing import told as told_of
from .pages import Pages
from .tables import Tables

#: Numbers of rows: DataJoint's int32.
LARGEST = 2**31 - 1
_AFTER = re.compile(r"(\d{4}-\d{2}-\d{2})~(\d{1,10})")
_FIELDS = ("cohort", "role", "quality", "state", "first_day", "last_day")


def routes(pages: Pages, tables: Tables) -> list[Route]:
    """The addresses of this part."""

    async def visits(request: Request) -> Response:
        if request.method == "POST":
            fields = await form_of(request, "look")
            return RedirectResponse(_address(request.state.session, fields), 303)
        session: Session = request.state.session
        asked = dict(request.query_params)
        wanted, bad = _filter(asked, session)
        choices = await tables.ask(visit_list.choices)
        for name in ("cohort", "role"):
            bad = bad or (bool(getattr(wanted, name)) and getattr(wanted, name) not in choices[name])
        after = _after(asked.get("after", ""))
        page = await tables.ask(visit_list.visit_page, wanted, after)
        kept = {k: asked[k] for k in ("q", *_FIELDS) if asked.get(k)}
        older = urlencode({**kept, "after": f"{page.after[0]}~{page.after[1]}"}) if page.after else ""
        return pages.show(
            request,
            "visits.html",
            page=page,
            wanted=wanted,
            choices={**choices, "quality": visit_list.OUTCOMES, "state": visit_list.STATES},
            bad=bad,
            older=older,
            newest=urlencode(kept),
            is_first=after is None,
            interval=interval,
        )

    async def visit(request: Request) -> Response:
        from schemas.visit_page import visit_about

        about = await tables.ask(visit_about, number_of(request), shown_of(request))
        decided = await tables.ask(decide.decisions, about.visit.session_id)
        accepted = await tables.ask(decide.accepted, about.key) if about.key else {}
        entered = await tables.ask(entry, about.visit.session_id)
        told = told_of(request, await tables.ask(visit_progress, about.visit.session_id))
        return pages.show(
            request,
            "visit.html",
            about=about,
            decisions=decided,
            accepted=accepted,
            entry=entered,
            interval=interval,
            told=told,
        )

    return [
        Route("/visits", visits, methods=["GET", "POST"]),
        Route("/visits/{number:int}", visit),
    ]


def number_of(request: Request) -> int:
    """The number in the address; one that no row can have becomes 0, which none has."""
    number = int(request.path_params["number"])
    return number if number <= LARGEST else 0


def shown_of(request: Request) -> int:
    """Which result of a visit is asked for; one that none can be becomes `LARGEST`, which none has."""
    asked = request.query_params.get("result", "0")
    return int(asked) if asked.isdecimal() and len(asked) < 4 else LARGEST


def interval(result: visit_list.Result) -> str:
    """ "78 to 87" as numbers; empty where the error of the index is not known."""
    from pbl_pipeline.gait import interval_90

    bounds = interval_90(result.index, result.sd)
    return "" if bounds is None else f"{bounds[0]:.0f}\N{EN DASH}{bounds[1]:.0f}"


def _address(session: Session, fields: Mapping[str, str]) -> str:
    """The list's address for a filled-in form. What was searched for is a number in it: a code is no part of one."""
    search = fields.get("search", "").strip()[:100]
    asked: dict[str, Any] = {"q": session.search_number(search)} if search else {}
    asked |= {name: fields[name][:64] for name in _FIELDS if fields.get(name)}
    return "/visits" + (f"?{urlencode(asked)}" if asked else "")


def _filter(asked: Mapping[str, str], session: Session) -> tuple[visit_list.Filter, bool]:
    """What is asked for, and whether a part of it was left out because it cannot be asked for."""
    bad = False
    values: dict[str, Any] = {}
    for name, allowed in (("quality", visit_list.OUTCOMES), ("state", visit_list.STATES)):
        if asked.get(name) in allowed:
            values[name] = asked[name]
        bad = bad or (bool(asked.get(name)) and name not in values)
    for name in ("first_day", "last_day"):
        if asked.get(name):
            try:
                values[name] = datetime.date.fromisoformat(asked[name])
            except ValueError:
                bad = True
    if (number := asked.get("q", "")).isdecimal() and len(number) < 9:
        values["search"] = session.search_text(int(number))
        bad = bad or not values["search"]
    for name in ("cohort", "role"):
        values[name] = asked.get(name, "")[:64]
    return visit_list.Filter(**values), bad


def _after(text: str) -> tuple[str, int] | None:
    found = _AFTER.fullmatch(text)
    if not found or int(found[2]) > LARGEST:
        return None
    try:
        datetime.date.fromisoformat(found[1])
    except ValueError:
        return None
    return found[1], int(found[2])
