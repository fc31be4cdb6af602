"""Enter: the role of a visit and its clinical scores. Each change is a row (`schemas.studies.visit_entry`)."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline.errors import PblError
from schemas.studies import visit_entry as enter

from .access import Session, form_of
from .address import Address, number_of
from .pages import Pages
from .tables import Tables

#: What the names of the fields begin with: an instrument may be called as another field of the form.
_FIELD = "value:"


def routes(pages: Pages, tables: Tables) -> list[Address]:
    """The addresses of this part."""

    def page(
        request: Request, entry: enter.Entry, values: Mapping[str, str], errors: Mapping[str, PblError]
    ) -> Response:
        return pages.show(
            request,
            "enter.html",
            entry=entry,
            values={**entry.values, **values},
            errors=errors,
            field=_FIELD,
            role=enter.ROLE,
            usual_roles=enter.USUAL_ROLES,
        )

    async def form(request: Request) -> Response:
        return page(request, await tables.ask(enter.entry, number_of(request)), {}, {})

    async def send(request: Request) -> Response:
        fields = await form_of(request)
        session: Session = request.state.session
        number = number_of(request)
        values = {name.removeprefix(_FIELD): text for name, text in fields.items() if name.startswith(_FIELD)}
        reason = fields.get("reason", "").strip()
        done = await tables.ask(enter.enter, number, values, session.name, fields.get("seen", ""), reason)
        if done.errors:
            return page(request, await tables.ask(enter.entry, number), values, done.errors)
        return RedirectResponse(f"/visits/{number}#entered", 303)

    return [
        Address("/visits/{session_id:int}/enter", form, "look"),
        Address("/visits/{session_id:int}/enter", send, "decide", methods=["POST"]),
    ]
