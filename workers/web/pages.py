"""Templates to answers."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from pbl_pipeline.errors import PblError
from pbl_pipeline.words import ANGLES, MEASURES, STAGES, TASKS, check_words, number, significant

from . import texts
from .access import HEADERS, HOURS, Session
from .address import JSON
from .plain_values import plain

#: Status of the answer to a request that may not pass, by its reason.
_REFUSED = {"session": 401, "host": 400, "token": 403, "right": 403, "size": 413, "form": 415}


def as_json(request: Request) -> bool:
    """Return whether the page is asked for as JSON."""
    return request.scope["path"].endswith(JSON)


def reader_language(request: Request) -> str:
    """Return the language in which a page is asked for."""
    return texts.language_of(request.cookies.get("pbl_language"), request.headers.get("accept-language", ""))


class Pages:
    """Renders the templates of this folder: escaped, in the reader's language, a name that is missing is an error."""

    def __init__(self, sign_in: bool = False) -> None:
        """sign_in: whether people sign in with a password; else a link opens the page."""
        self._sign_in = sign_in
        self._environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._environment.globals.update(
            number=number,
            has_text=lambda name: name in texts.catalogue(),
            significant=significant,
            check_words=check_words,
            stage_words=STAGES,
            measure_words=MEASURES | TASKS,
            angle_words=[title for title, _ in ANGLES.values()],
        )

    def show(
        self,
        request: Request,
        template: str,
        status: int = 200,
        headers: Mapping[str, str] | None = None,
        **values: Any,
    ) -> Response:
        """Return a page, or what it shows as JSON where the address ends so. `values`: what its template names."""
        if as_json(request):
            shown = {name: plain(value) for name, value in values.items() if not callable(value)}
            return JSONResponse(shown, status, dict(headers or {}))
        language = reader_language(request)
        session: Session | None = getattr(request.state, "session", None)
        own: dict[str, Any] = {
            "t": functools.partial(texts.text, language),
            "said": functools.partial(texts.on_page, language),
            "language": language,
            "other_language": next(name for name in texts.LANGUAGES if name != language),
            "session": session,
            "path": request.scope["path"],
            "number": lambda *args: texts.decimals(language, number(*args)),
            "significant": lambda *args: texts.decimals(language, significant(*args)),
            "decimals": functools.partial(texts.decimals, language),
        }
        page = self._environment.get_template(template).render({**own, **values})
        return HTMLResponse(page, status, dict(headers or {}))

    def refused(self, request: Request, reason: str) -> Response:
        """The answer to a request that may not pass."""
        if reason == "address":
            return self.missing(request, 404)
        name = "enter.title" if reason == "session" else f"enter.{reason}_title"
        text = "enter.text" if reason == "session" else f"enter.{reason}"
        if as_json(request):
            return self.error(request, _refusal(texts.text("en", name), texts.text("en", text)), _REFUSED[reason])
        if reason == "session" and self._sign_in:
            return self.show(request, "sign_in.html", _REFUSED[reason], problem="", wait=0)
        return self.show(request, "refused.html", _REFUSED[reason], title=name, text=text, hours=f"{HOURS:g}")

    def error(self, request: Request, error: PblError, status: int) -> Response:
        """The answer that a coded error makes: what is known and what to do."""
        return self.show(request, "error.html", status, error=error)

    def missing(self, request: Request, status: int, headers: Mapping[str, str] | None = None) -> Response:
        """The answer for an address that there is not."""
        if as_json(request):
            return self.error(request, _not_there(), status)
        return self.show(request, "missing.html", status, headers)

    def unforeseen(self, request: Request) -> Response:
        """The answer where the program itself failed; the traceback is in the terminal."""
        if as_json(request):
            return JSONResponse({"error": plain(_unforeseen())}, 500, HEADERS)
        return self.show(request, "unforeseen.html", 500, HEADERS)


def _refusal(found: str, next_step: str) -> PblError:
    expected = "a request of somebody who is signed in and has the right"
    return PblError("WEB_REFUSED", found=found, expected=expected, next_step=next_step)


def _not_there() -> PblError:
    return PblError(
        "DB_NOT_FOUND",
        found="no page at this address",
        expected="/visits.json, /visits/NUMBER.json, /recordings/NUMBER.json or /compare.json",
        next_step="take the numbers from /visits.json",
    )


def _unforeseen() -> PblError:
    return PblError(
        "INTERNAL",
        found="an unforeseen error of the page",
        expected="an answer",
        next_step="report what the terminal of `pbl web` says",
    )
