"""Enter: the role of a visit, its clinical scores, and custom instruments. Each change is a row of Decision."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline import texts
from pbl_pipeline.errors import PblError
from pbl_schemas.studies import study_sheets, visit_forms

from . import pages, site
from .access import form_of, sender
from .address import Address, number_of
from .pages import NOTHING, in_field, reader_language

#: Prefix of the names of the fields: an instrument may have the name of another field of the form.
_FIELD = "value:"


async def form(
    request: Request, values: Mapping[str, str] = NOTHING, errors: Mapping[str, PblError] = NOTHING
) -> Response:
    entry, language = await site.ask(request, visit_forms.scores_form, number_of(request)), reader_language(request)
    scores = {name: in_field(language, entry.values[name]) for name in entry.instruments}
    role = {visit_forms.ROLE: texts.coded(language, visit_forms.ROLE, entry.values[visit_forms.ROLE])}
    values = {**entry.values, **scores, **role, **values}
    more = {"field": _FIELD, "role": visit_forms.ROLE, "usual_roles": visit_forms.USUAL_ROLES}
    return pages.show(request, "scores.html", entry=entry, values=values, errors=errors, **more)


async def send(request: Request) -> Response:
    fields = await form_of(request)
    number = number_of(request)
    values = {name.removeprefix(_FIELD): text for name, text in fields.items() if name.startswith(_FIELD)}
    reason = fields.get("reason", "").strip()
    _, errors = await site.ask(
        request, visit_forms.enter_scores, number, values, sender(request), fields.get("seen", ""), reason
    )
    if errors:
        return await form(request, values, errors)
    return RedirectResponse(f"/visits/{number}#entered", 303)


async def add_instrument(request: Request) -> Response:
    fields = await form_of(request)
    errors = await site.ask(request, study_sheets.add_instrument, fields, sender(request))
    if errors:
        return await instruments(request, fields, errors)
    return RedirectResponse("/instruments", 303)


async def instruments(
    request: Request, values: Mapping[str, str] = NOTHING, errors: Mapping[str, PblError] = NOTHING
) -> Response:
    rows = await site.ask(request, visit_forms.instruments)
    fields = {"texts": study_sheets.TEXTS, "numbers": study_sheets.NUMBERS, "flags": study_sheets.FLAGS}
    known = {name: values.get(name, "") for names in fields.values() for name in names}
    return pages.show(request, "instruments.html", instruments=rows, values=known, errors=errors, **fields)


ROUTES = [
    Address("/instruments", instruments, "look"),
    Address("/instruments", add_instrument, "decide", methods=["POST"]),
    Address("/visits/{session_id:int}/enter", form, "look"),
    Address("/visits/{session_id:int}/enter", send, "decide", methods=["POST"]),
]
