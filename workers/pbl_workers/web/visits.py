"""The list of visits with its filters, and the page of a visit with its curves."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

import numpy as np
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from pbl_pipeline import settings, texts
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    SIDED,
    THREE_ANGLES,
    AdultRanges,
    NormalBands,
    adult_ranges,
    far_leg_of,
    leg_length_m,
    normal_bands,
)
from pbl_pipeline.kinetics import GRAVITY, Kinetics
from pbl_pipeline.names import normalised_label, whole_number
from pbl_pipeline.render import overlay_frames, report_indices
from pbl_pipeline.report import Picture, picture
from pbl_pipeline.report.curves import CycleCurve, Ranges, cycle_curves
from pbl_pipeline.report.forces import force_charts
from pbl_pipeline.visit import Visit
from pbl_pipeline.words import ANGLES, KINETICS
from pbl_schemas.reading import visit_list
from pbl_schemas.reading.shown import Pooled, ShownVisit
from pbl_schemas.subject_codes import day_of

from . import pages, site
from .access import Session, form_of
from .address import Address, interval, number_of, page, shown_of
from .computing import told as told_of
from .pages import as_json, plain, reader_language
from .phone import usual_words, verdict

#: Angles of the first screen.
SHOWN = (*THREE_ANGLES, "ankle_dorsiflexion")
#: Recordings in the overview of a letter, and the longer side of its pictures (px).
_OVERVIEW, _OVERVIEW_PX = 2, 240


@dataclasses.dataclass(frozen=True)
class Curves:
    """The angles of a visit. far: the leg that was behind the other, empty if both were seen alike. adults: ranges
    of adults beside the children's bands."""

    angles: tuple[CycleCurve, ...]
    bands: NormalBands
    far: str
    adults: AdultRanges


def curves_of(about: ShownVisit, found: Pooled, language: str) -> Curves | None:
    """Return the curves of the cycles that count, None without any."""
    if not any(c.used and c.curves for c in found.cycles):
        return None

    def label(title: str, _: Ranges) -> str:
        return texts.text(language, "curves.chart", name=texts.library_words(language, title))

    leg_m = None if found.scale is None else leg_length_m(found.scale)
    bands = normal_bands({name: measure for name, (measure, _) in about.measures.items()}, leg_m)
    drawn = cycle_curves(found.cycles, bands, {name: ANGLES[name] for name in SHOWN}, label)
    return Curves(tuple(drawn), bands, far_leg_of(found.cycles), adult_ranges())


def forces_of(kinetics: Kinetics, language: str) -> dict[str, Any]:
    """Return forces (without their trials) with their charts and the body weight (N)."""

    def label(title: str, unit: str, n: int) -> str:
        return texts.text(language, "forces.chart", name=texts.library_words(language, title), unit=unit, n=n)

    found = dataclasses.replace(kinetics, trials=())
    weight_n = None if found.mass_kg is None else GRAVITY * found.mass_kg
    drawn = [{**c, "svg": texts.in_chart(language, c["svg"])} for c in force_charts(kinetics, label)]
    return {"found": found, "words": KINETICS, "weight_n": weight_n, "charts": drawn}


def overview(visit: Visit) -> list[dict[str, Any]]:
    """Return pictures of the fitted body on white, of the first recordings that have a camera: name, `pictures`."""
    found = []
    for r in visit.fitted[:_OVERVIEW]:
        fit = r.fit
        if fit is None or not np.isfinite(fit.camera.matrix).all() or not (indices := report_indices(fit)):
            continue
        drawn = overlay_frames(None, fit, indices, max_side_px=_OVERVIEW_PX, crop_to_body=True)
        frames = [Picture(i, float(fit.time_s[i]), image) for i, image in zip(indices, drawn, strict=True)]
        found.append({"name": r.name, "pictures": [picture(r.name, p) | {"time_s": p.time_s} for p in frames]})
    return found


_FIELDS = ("cohort", "role", "quality", "state", "first_day", "last_day")


async def visit(request: Request) -> Response:
    about = await site.ask(request, site.of(request).source.visit, number_of(request), shown_of(request))
    told = told_of(request, await site.ask(request, site.of(request).source.progress, about.row.session_id))
    values = {"about": about, "told": told, **await site.ask(request, site.of(request).source.around, about)}
    values |= await site.ask(request, _drawn, about, reader_language(request))
    if as_json(request):  # loads arrays, which not every thread may
        values = await site.ask(request, plain, values)
    shown = {"interval": interval, "sided": SIDED, "verdict": verdict, "usual_words": usual_words}
    return pages.show(request, "visit.html", **shown, **values)


async def letter(request: Request) -> Response:
    about = await site.ask(request, site.of(request).source.visit, number_of(request), shown_of(request))
    values = {"about": about, **await site.ask(request, site.of(request).source.around, about)}
    values |= await site.ask(request, _drawn, about, reader_language(request))
    values["pictures"] = [] if about.visit is None else await site.ask(request, overview, about.visit)
    more = {"interval": interval, "sided": SIDED, "version": code_version(), "head": settings.letter_head()}
    more["now"] = datetime.datetime.now(datetime.UTC)
    return pages.show(request, "letter.html", **values, **more)


#: Of a visit and of its letter for the record, which tables and folder have.
ROUTES = [
    *page("/visits/{session_id:int}", visit, "look"),
    Address("/visits/{session_id:int}/letter", letter, "look", look="letter"),
]


def _drawn(about: ShownVisit, language: str) -> dict[str, Any]:
    """Return the curves and forces of a visit, or why they cannot be shown."""
    try:
        found = about.load_pooled()
        curves = None if found is None else curves_of(about, found, language)
    except PblError as error:  # such as a file of the store that is gone: the rest of the page is in rows
        return {"curves": None, "no_curves": error, "forces": None}
    forces = None if found is None or found.kinetics is None else forces_of(found.kinetics, language)
    return {"curves": curves, "no_curves": None, "forces": forces}


async def visits(request: Request) -> Response:
    session: Session = request.state.session
    asked = dict(request.query_params)
    wanted, bad = _filter(asked, session)
    choices = await site.ask(request, visit_list.choices)
    for name in ("cohort", "role"):
        bad = bad or (bool(getattr(wanted, name)) and getattr(wanted, name) not in choices[name])
    after = _after(asked.get("after", ""))
    listed = await site.ask(request, visit_list.visit_page, wanted, after)
    kept = {k: asked[k] for k in ("q", *_FIELDS) if asked.get(k)}
    older = urlencode({**kept, "after": f"{listed.after[0]}~{listed.after[1]}"}) if listed.after else ""
    choices |= {"quality": visit_list.OUTCOMES, "state": visit_list.STATES}
    more = {"older": older, "newest": urlencode(kept), "is_first": after is None, "interval": interval}
    return pages.show(request, "visits.html", page=listed, wanted=wanted, choices=choices, bad=bad, **more)


async def search(request: Request) -> Response:
    return RedirectResponse(_address(request.state.session, await form_of(request)), 303)


LIST_ROUTES = [*page("/visits", visits, "look"), Address("/visits", search, "look", methods=["POST"])]


def _address(session: Session, fields: Mapping[str, str]) -> str:
    """The list's address for a filled-in form. The search text is a number in it, so that no code is part of an
    address."""
    search = normalised_label(fields.get("search", ""))[:100]
    asked: dict[str, Any] = {"q": session.search_number(search)} if search else {}
    asked |= {name: fields[name][:64] for name in _FIELDS if fields.get(name)}
    return "/visits" + (f"?{urlencode(asked)}" if asked else "")


def _filter(asked: Mapping[str, str], session: Session) -> tuple[visit_list.Filter, bool]:
    """Return the filter of a request, and whether an invalid part of it was left out."""
    bad = False
    values: dict[str, Any] = {}
    for name, allowed in (("quality", visit_list.OUTCOMES), ("state", visit_list.STATES)):
        if asked.get(name) in allowed:
            values[name] = asked[name]
        bad = bad or (bool(asked.get(name)) and name not in values)
    for name in ("first_day", "last_day"):
        if asked.get(name):
            values[name] = _day(asked[name])
            bad = bad or values[name] is None
    if (number := whole_number(asked.get("q", ""))) is not None:
        values["search"] = session.search_text(number)
        bad = bad or not values["search"]
    for name in ("cohort", "role"):
        values[name] = asked.get(name, "")[:64]
    return visit_list.Filter(**values), bad


def _after(text: str) -> tuple[str, int] | None:
    day, _, visit = text.partition("~")
    number = whole_number(visit)
    return None if number is None or _day(day) is None else (day, number)


def _day(text: str) -> datetime.date | None:
    return day_of(text) if len(text) == len("2026-01-10") else None
