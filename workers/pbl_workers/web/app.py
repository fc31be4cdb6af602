"""The application: addresses with their pages, and the answers to errors."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator, Callable
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

from ..on_request import compute_visit
from ..process_queue import ProcessQueue
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
    phone,
    recordings,
    registration,
    reports,
    trend,
    visits,
)
from .accounts import Accounts, Attempts, SignIn
from .accounts import routes as sign_in_routes
from .address import OPEN, Address, own_address
from .computing import Target
from .pages import Pages
from .source import Source, TablesSource, Videos
from .tables import Asks, Files, Tables

log = logging.getLogger(__name__)

#: Status of an answer by the code of its error; 409 for the others: the present data do not allow it.
STATUS = {"DB_NOT_FOUND": 404, "VIDEO_MISSING": 404, "USAGE": 400, "DB_NOT_RUNNING": 503, "DB_REFUSED": 503} | {
    "PHONE_LINK": 403,
    "UPLOAD_REFUSED": 422,
    "FILE_UNWRITABLE": 507,
    "MACHINE_SHORT": 503,
}
#: Cache header of `vendor/`: its file names carry their versions.
_KEEP = "public, max-age=31536000, immutable"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the page. hosts: names in a Host header that are answered; name and roles: of the person who opens a
    link; on_entry: called when a link was used, with the key of the next one. accounts: of those who sign in, None
    if links open the page; secure: browsers reach it by TLS; folder: results that are shown instead of the tables;
    target: function that computes a visit in a process."""

    hosts: frozenset[str] = frozenset({"127.0.0.1", "localhost", "::1"})
    name: str = ""
    roles: tuple[str, ...] = ("reviewer", "operator")
    on_entry: Callable[[str], None] | None = None
    accounts: Accounts | None = None
    secure: bool = False
    folder: folder.ResultsFolder | None = None
    target: Target = compute_visit


def create_app(options: Options, sessions: access.Sessions | None = None) -> Starlette:
    """The page as an ASGI application. `sessions`: those of a test; `app.state.sessions` makes the first link."""
    accounts = options.accounts
    if sessions is None and accounts is not None:
        sessions = access.Sessions(idle_hours=access.IDLE_HOURS, still=accounts.current)
    sessions = sessions or access.Sessions()
    way = SignIn(sessions, access.Cookie(options.secure), accounts, Attempts())
    pages, tables, videos, making = Pages(accounts is not None), Tables(), Videos(), ProcessQueue(most=20, kept=8)
    visits_queue = ProcessQueue(most=50, kept=50)

    @contextlib.asynccontextmanager
    async def life(app: Starlette) -> AsyncIterator[None]:
        yield
        making.close()
        visits_queue.close()
        videos.close()
        tables.close()

    def link_used() -> None:
        if options.on_entry is not None:
            options.on_entry(sessions.new_link(options.name, *options.roles))

    async def home(request: Request) -> Response:
        session: access.Session | None = request.state.session
        return pages.refused(request, "session") if session is None else RedirectResponse(session.home, 303)

    async def language(request: Request) -> Response:
        fields = await access.form_of(request)
        response = RedirectResponse(own_address(fields.get("back", "")), 303)
        chosen = texts.language_of(fields.get("language"), "")
        response.set_cookie("pbl_language", chosen, httponly=True, samesite="strict", secure=options.secure)
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

    async def unforeseen(request: Request, error: Exception) -> Response:
        return pages.unforeseen(request)

    asks: Asks
    source: Source
    if options.folder is not None:
        asks, source, phones = Files(), options.folder, None
        parts = folder.routes(pages, asks, options.folder)
    else:
        asks, source, phones = tables, TablesSource(videos), phone.Phones(tables, options.secure)
        parts = [
            *visits.list_routes(pages, tables),
            *decide.routes(pages, tables),
            *corrections.routes(tables),
            *reports.routes(pages, tables, making),
            *computing.routes(pages, tables, visits_queue, options.target),
            *compare.routes(pages, tables, videos),
            *entry.routes(pages, tables),
            *registration.routes(pages, tables),
            *operate.routes(pages, tables),
            *trend.routes(pages, tables),
            *phone.routes(pages, tables, phones, visits_queue, options.target),
        ]
    routes: list[Address] = [
        Address("/", home, OPEN),
        *sign_in_routes(pages, way, link_used),
        Address("/language", language, "", methods=["POST"]),
        *parts,
        *visits.routes(pages, asks, source),
        *recordings.routes(pages, asks, source),
        *export.routes(asks, source),
        _files("static", "no-store"),
        _files("vendor", _KEEP),
    ]
    app = Starlette(
        routes=routes,
        exception_handlers={
            access.Refused: refused,
            PblError: coded,
            HTTPException: missing,
            Exception: unforeseen,
        },
        middleware=[
            Middleware(
                access.Gate,
                sessions=sessions,
                hosts=options.hosts,
                refuse=pages.refused,
                cookie=way.cookie,
            ),
            Middleware(GZipMiddleware, minimum_size=1000),
        ],
        lifespan=life,
    )
    app.state.sessions, app.state.sign_in = sessions, way
    app.state.computing, app.state.phones = visits_queue, phones
    app.state.looks = audit.Looks(tables) if settings.audit_looks() and options.folder is None else None
    app.router.default, app.router.redirect_slashes = unknown, False
    return app


def _files(folder: str, kept: str) -> Address:
    """The files of a folder beside this module. `kept`: what browsers are told about keeping them."""
    files = StaticFiles(directory=Path(__file__).parent / folder)

    async def file(request: Request) -> Response:
        response = await files.get_response(request.path_params["file"], request.scope)
        response.headers["cache-control"] = kept
        return response

    return Address(f"/{folder}/{{file}}", file, OPEN)
