"""The application: addresses with their pages, and the answers to errors."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send

from pbl_pipeline import settings, texts
from pbl_pipeline.errors import PblError

from .. import refresh  # noqa: F401  decisions queue by it what they made computable
from . import (
    access,
    audit,
    compare,
    computing,
    corrections,
    decide,
    entry,
    export,
    folder,
    operate,
    pages,
    phone,
    recordings,
    registration,
    reports,
    sign_in,
    site,
    trend,
    visits,
)
from .access import Sessions
from .address import OPEN, Address, own_address
from .site import Options
from .source import TablesSource
from .tables import Asks, Files, Tables

#: Status of an answer by the code of its error; 409 for the others: the present data do not allow it.
STATUS = {"DB_NOT_FOUND": 404, "VIDEO_MISSING": 404, "USAGE": 400, "DB_NOT_RUNNING": 503, "DB_REFUSED": 503} | {
    "PHONE_LINK": 403,
    "UPLOAD_REFUSED": 422,
    "FILE_UNWRITABLE": 507,
    "STORE_FULL": 507,
    "MACHINE_SHORT": 503,
    "NOT_QUEUED": 503,
}
#: Cache header of `vendor/`: its file names carry their versions.
_KEEP = "public, max-age=31536000, immutable"


def create_app(options: Options, sessions: Sessions | None = None) -> Starlette:
    """The page as an ASGI application. `sessions`: those of a test; `app.state.site.sessions` makes the first link."""
    if sessions is None and options.accounts is not None:
        sessions = Sessions(idle_hours=access.IDLE_HOURS, still=options.accounts.current)
    sessions = sessions or Sessions()
    asks: Asks
    if options.folder is not None:
        asks, source, looks = Files(), options.folder, None
        parts = folder.ROUTES
    else:
        asks, source = Tables(), TablesSource()
        looks = audit.Looks(asks) if settings.audit_looks() else None
        of_tables = (decide, corrections, reports, computing, compare, entry, registration, operate, trend)
        parts = [*visits.LIST_ROUTES, *(one for part in of_tables for one in part.ROUTES), *phone.routes()]
    cookie, phone_cookie = access.Cookie(options.secure), access.Cookie(options.secure, "pbl_phone")
    routes = [
        Address("/", home, OPEN),
        *(sign_in.BY_LINK if options.accounts is None else sign_in.BY_PASSWORD),
        *sign_in.ROUTES,
        Address("/language", language, "", methods=["POST"]),
        *parts,
        *visits.ROUTES,
        *recordings.routes(),
        *export.ROUTES,
        Address("/static/{file}", _Files("static", "no-store").file, OPEN),
        Address("/vendor/{file}", _Files("vendor", _KEEP).file, OPEN),
    ]
    app = Starlette(
        routes=routes,
        exception_handlers={
            access.Refused: refused,
            PblError: coded,
            HTTPException: missing,
            Exception: pages.unforeseen,
        },
        middleware=[
            Middleware(access.Gate, sessions=sessions, hosts=options.hosts, refuse=pages.refused, cookie=cookie),
            Middleware(GZipMiddleware, minimum_size=1000),
        ],
        lifespan=_life,
    )
    app.state.site = site.Site(options, sessions, cookie, phone_cookie, asks, source, looks)
    app.router.default, app.router.redirect_slashes = unknown, False
    return app


@contextlib.asynccontextmanager
async def _life(app: Starlette) -> AsyncIterator[None]:
    yield
    app.state.site.close()


async def home(request: Request) -> Response:
    session: access.Session | None = request.state.session
    return pages.refused(request, "session") if session is None else RedirectResponse(session.home, 303)


async def language(request: Request) -> Response:
    fields = await access.form_of(request)
    response = RedirectResponse(own_address(fields.get("back", "")), 303)
    chosen, secure = texts.language_of(fields.get("language"), ""), site.of(request).options.secure
    response.set_cookie("pbl_language", chosen, httponly=True, samesite="strict", secure=secure)
    return response


async def unknown(scope: Scope, receive: Receive, send: Send) -> None:
    raise access.Refused("session") if Request(scope).state.session is None else HTTPException(404)


async def refused(request: Request, error: Exception) -> Response:
    return pages.refused(request, str(error))


async def coded(request: Request, error: Exception) -> Response:
    assert isinstance(error, PblError)
    return pages.error(request, error, STATUS.get(error.code, 409))


async def missing(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return pages.missing(request, error.status_code, error.headers)


class _Files(StaticFiles):
    """The files of a folder beside this module. `kept`: what browsers are told about keeping them."""

    def __init__(self, folder: str, kept: str) -> None:
        super().__init__(directory=Path(__file__).parent / folder)
        self._kept = kept

    async def file(self, request: Request) -> Response:
        response = await self.get_response(request.path_params["file"], request.scope)
        response.headers["cache-control"] = self._kept
        return response
