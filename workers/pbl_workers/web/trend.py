"""Page of all visits of a person in time."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup
from starlette.requests import Request
from starlette.responses import Response

from pbl_pipeline import charts, texts
from pbl_pipeline.words import MEASURES, TASKS, capital
from pbl_schemas.reading.trend import INDEX, Point, trend_of

from . import pages, site
from .address import number_of, page
from .pages import as_json, plain, reader_language


async def trend(request: Request) -> Response:
    found = await site.ask(request, trend_of, number_of(request), request.query_params.get("measure", INDEX))
    if as_json(request):
        return pages.show(request, "", found=plain(found))
    language = reader_language(request)
    activity, _, name = found.measure.rpartition(".")
    words, unit, decimals = ("", "", 1) if found.measure == INDEX else (MEASURES | TASKS)[name]
    title = ": ".join(capital(texts.library_words(language, w)) for w in (activity, words) if w)
    title = title or texts.text(language, "visit.gdi")
    label = texts.text(language, "trend.chart", name=title, n=len(found.points))
    picture = _chart(label, found.points, found.measure == INDEX)
    return pages.show(
        request,
        "trend.html",
        here=number_of(request),
        found=found,
        title=title,
        unit=unit,
        decimals=decimals,
        picture=picture and texts.in_chart(language, picture),
        index=INDEX,
    )


ROUTES = page("/visits/{session_id:int}/trend", trend, "look", look="trend")


def _chart(label: str, points: Sequence[Point], is_index: bool) -> Markup | None:
    """Return the values over the days of their visits; None if fewer than two days with a value are known."""
    known = [(p.day, p.value, p) for p in points if p.day is not None and p.value is not None]
    if len(known) < 2:
        return None
    days = [(day - known[0][0]).days for day, _, _ in known]
    values = [
        (value, p.bounds, {s: v for s, v in (("left", p.left), ("right", p.right)) if v is not None})
        for _, value, p in known
    ]
    names = [day.isoformat() for day, _, _ in known]
    return charts.trend_chart(label, days, names, values, (90.0, 110.0) if is_index else None)
