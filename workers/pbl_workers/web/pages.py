"""Templates to answers, as pages or as JSON."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from pbl_pipeline import texts
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import load_norm, norm_names
from pbl_pipeline.visit import Recording, Visit, recording_facts, visit_facts
from pbl_pipeline.words import ANGLES, MEASURES, STAGES, TASKS, capital, check_words, number, significant, without_unit
from pbl_schemas.intake.sheets import with_point
from pbl_schemas.reading.shown import ShownVisit
from pbl_schemas.rows import moment
from pbl_schemas.session import UNLABELLED

from . import site
from .access import HEADERS, HOURS, Session
from .address import JSON
from .remedies import remedies, remedies_of_path

#: Fields of a form that no one has filled in, and their errors.
NOTHING: Mapping[str, Any] = MappingProxyType({})
#: The folders of an absolute path in a text.
_FOLDERS = re.compile(r"(?<![\w:/.])/(?:[^\s/'\"]+/)+(?=[^\s/'\"])")
_unforeseen = functools.partial(
    PblError,
    "INTERNAL",
    found="an unforeseen error of the page",
    expected="an answer",
    next_step="report the text in the terminal of `pbl web`",
)
_refusal = functools.partial(
    PblError, "WEB_REFUSED", expected="a request of a person who is signed in and has the right"
)
_not_there = functools.partial(
    PblError,
    "DB_NOT_FOUND",
    found="no page at this address",
    expected="/visits.json, /visits/NUMBER.json, /recordings/NUMBER.json or /compare.json",
    next_step="take the numbers from /visits.json",
)


def plain(value: Any) -> Any:
    """Return a value of a template as plain JSON.

    A visit is what its session.json and metrics.json hold, which may load its arrays; a recording is its facts and
    events; a frame is a list of its rows. Numbers that are not finite are null. Of a path, alone or in a text, only the
    file's name is kept. Arrays are left out.
    """
    if isinstance(value, Visit):
        judged = value.judged
        return plain({**visit_facts(value), "metrics": None if judged is None else judged.to_dict()})
    if isinstance(value, Recording):
        events = [] if value.events is None else [dataclasses.asdict(e) for e in value.events.events]
        return plain({**recording_facts(value), "events": events})
    if isinstance(value, PblError):
        return plain({k: str(getattr(value, k) or "") for k in ("code", "found", "expected", "next_step", "key")})
    if isinstance(value, pd.DataFrame):
        return plain(value.to_dict("records"))
    if isinstance(value, ShownVisit):
        own = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if not f.name.startswith("load_")}
        return plain({**own, "visit": value.visit})
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return _FOLDERS.sub("", value)
    if value is None or isinstance(value, int | bool):
        return value
    return value.name if isinstance(value, Path) else None


#: Status of the answer to a request that may not pass, by its reason.
_REFUSED = {"session": 401, "host": 400, "token": 403, "right": 403, "size": 413, "form": 415}


def as_json(request: Request) -> bool:
    """Return whether the page is asked for as JSON."""
    return request.scope["path"].endswith(JSON)


def reader_language(request: Request) -> str:
    """Return the language in which a page is asked for."""
    return texts.language_of(request.cookies.get("pbl_language"), request.headers.get("accept-language", ""))


@functools.cache
def _environment() -> jinja2.Environment:
    """The templates of this folder: escaped, a name that is missing is an error."""
    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.globals.update(
        number=number,
        remedies=remedies,
        remedies_of_path=remedies_of_path,
        has_text=lambda name: name in texts.catalogue(),
        significant=significant,
        check_words=check_words,
        stage_words=STAGES,
        codes=texts.codes,
        measure_words=MEASURES | TASKS,
        moment=moment,
        angle_words=[title for title, _ in ANGLES.values()],
    )
    found.filters |= {"capital": capital, "norm_people": norm_people, "without_unit": without_unit}
    return found


def show(
    request: Request, template: str, status: int = 200, headers: Mapping[str, str] | None = None, **values: Any
) -> Response:
    """Return a page, or its values as JSON if the address ends so. `values`: variables of its template."""
    if as_json(request):
        shown = {name: plain(value) for name, value in values.items() if not callable(value)}
        return JSONResponse(shown, status, dict(headers or {}))
    language = reader_language(request)
    session: Session | None = getattr(request.state, "session", None)
    own: dict[str, Any] = {
        "t": functools.partial(texts.text, language),
        "said": functools.partial(texts.on_page, language),
        "coded": functools.partial(texts.coded, language),
        "named": functools.partial(visit_name, language),
        "language": language,
        "other_language": next(name for name in texts.LANGUAGES if name != language),
        "session": session,
        "path": request.scope["path"],
        "number": lambda *args: texts.decimals(language, number(*args)),
        "significant": lambda *args: texts.decimals(language, significant(*args)),
        "decimals": functools.partial(texts.decimals, language),
    }
    page = _environment().get_template(template).render({**own, **values})
    return HTMLResponse(page, status, dict(headers or {}))


def refused(request: Request, reason: str) -> Response:
    """Return the answer to a request that may not pass."""
    if reason == "address":
        return missing(request, 404)
    name = "enter.title" if reason == "session" else f"enter.{reason}_title"
    text = "enter.text" if reason == "session" else f"enter.{reason}"
    if as_json(request):
        coded = _refusal(found=texts.text("en", name), next_step=texts.text("en", text))
        return error(request, coded, _REFUSED[reason])
    if reason == "session" and site.of(request).options.accounts is not None:
        return show(request, "sign_in.html", _REFUSED[reason], problem="", wait=0, name="")
    return show(request, "refused.html", _REFUSED[reason], title=name, text=text, hours=f"{HOURS:g}")


def error(request: Request, error: PblError, status: int) -> Response:
    if as_json(request) and getattr(request.state, "phone", None) is not None:  # its page shows these words
        said = functools.partial(texts.on_page, reader_language(request))
        found, expected, next_step = (said(part).striptags() for part in (error.found, error.expected, error.next_step))
        error = PblError(error.code, found, expected, next_step, error.key)
    return show(request, "error.html", status, error=error)


def missing(request: Request, status: int, headers: Mapping[str, str] | None = None) -> Response:
    """Return the answer to an unknown address."""
    if as_json(request):
        return error(request, _not_there(), status)
    return show(request, "missing.html", status, headers)


async def unforeseen(request: Request, error: Exception) -> Response:
    """Return the answer to a failure of the program; the traceback is in the terminal."""
    if as_json(request):
        return JSONResponse({"error": plain(_unforeseen())}, 500, HEADERS)
    return show(request, "unforeseen.html", 500, HEADERS)


def norm_people(norm: str) -> int | None:
    """Return how many typically developing children a set of the index that ships is of, by its name in tables or
    files; None for other sets."""
    name = re.sub(r"-v\d+$", "", norm)
    return load_norm(name).n if name in norm_names() else None


def visit_name(language: str, label: str) -> str:
    """Return the label of a visit; of one that got none, the words for that in a language."""
    return texts.text(language, "visits.unlabelled") if label == UNLABELLED else label


def in_field(language: str, number: str) -> str:
    """Return a stored number as a field shows it: with the decimals of a language, where that is read as the same."""
    own = texts.decimals(language, number)
    return own if with_point(own) == number else number
