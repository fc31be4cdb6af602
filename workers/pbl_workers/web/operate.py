"""Operate: queues, what is being computed, errors with their next step and another try, database and disks."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Sequence
from typing import Any

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline.bounded import parse_json
from pbl_pipeline.names import whole_number
from pbl_schemas import fit
from pbl_schemas.decisions import review_decisions
from pbl_schemas.operations.server_status import database_status
from pbl_schemas.reading.status import ErrorRow, pipeline_status, running, span
from pbl_schemas.rows import grouped
from pbl_schemas.transactions import in_transaction

from ..requeue import retry
from . import pages, site
from .access import Refused, form_of, sender
from .address import Address

#: Errors, jobs and waiting recordings that are listed, of each table.
MOST = 100


@dataclasses.dataclass(frozen=True)
class Group:
    table: str
    code: str
    errors: tuple[ErrorRow, ...]


async def show(request: Request) -> Response:
    state, jobs, server = await site.ask(
        request, lambda: (pipeline_status(most=MOST), running(MOST), database_status())
    )
    shown = {"state": state, "jobs": jobs, "server": server, "groups": groups_of(state.errors)}
    return pages.show(
        request,
        "operate.html",
        **shown,
        n_errors=sum(t.error for t in state.tables),
        retried=whole_number(request.query_params.get("retried", "")),
        now=datetime.datetime.now(datetime.UTC),
        span=span,
        key_text=lambda key: json.dumps(key, default=str),
    )


async def again(request: Request) -> Response:
    fields = await form_of(request)
    table, code, key = fields.get("table", ""), fields.get("code", ""), _key(fields.get("key", ""))
    if not table or not code:
        raise Refused("form")
    n = await site.ask(request, _retry, table, code, key, sender(request))
    return RedirectResponse(f"/operate?retried={n}", 303)


ROUTES = [
    Address("/operate", show, "operate"),
    Address("/operate/retry", again, "operate", methods=["POST"]),
]


def groups_of(errors: Sequence[ErrorRow]) -> list[Group]:
    """Return errors by table and code, the most first."""
    found = grouped(((error.table, error.code), error) for error in errors)
    made = [Group(table, code, tuple(rows)) for (table, code), rows in found.items()]
    return sorted(made, key=lambda g: -len(g.errors))


def _retry(table: str, code: str, key: dict[str, Any] | None, by: str) -> int:
    """Put errors of a table and code back, all or that of one key, with a row of Decision; how many."""

    def work() -> int:
        n = sum(retry(code, table, key=key).values())
        if n:
            about = {"table": table, "code": code, **({"key": key} if key else {})}
            review_decisions.record("retry", by, about, {"errors": n}, {"errors": 0}, "", **_whose(key or {}))
        return n

    return in_transaction(work)


def _whose(key: dict[str, Any]) -> dict[str, int]:
    """Return the recording or visit of a job, so that the row is deleted with its person."""
    if "video_id" in key:
        return {"video_id": int(key["video_id"])}
    return {"session_id": fit.session_of_set({"fit_set": key["fit_set"]})} if "fit_set" in key else {}


def _key(text: str) -> dict[str, Any] | None:
    """The key of a job as a form names it; None for none. Raises `Refused` for an invalid key."""
    if not text:
        return None
    try:
        found = parse_json(text)
    except ValueError:
        raise Refused("form") from None
    named = isinstance(found, dict) and all(
        isinstance(v, str | int) and not isinstance(v, bool) and len(str(v)) <= 64 for v in found.values()
    )
    if not named:
        raise Refused("form")
    return found
