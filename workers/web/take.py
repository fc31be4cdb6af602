"""Take along: a visit's movement as files of other programs."""

from __future__ import annotations

import asyncio
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from pbl_pipeline.errors import PblError

from .find import number_of, shown_of
from .pages import Pages
from .tables import Tables

if TYPE_CHECKING:
    from pbl_pipeline.export import ExportSession
    from schemas.visit_page import VisitPage

#: Formats of the archive: those that need no further package.
FORMATS = ("csv", "trc", "mot")


def result_of(session_id: int, shown: int) -> VisitPage:
    """A visit that has a result. Raises `PblError` DB_NOT_FOUND for an unknown one and for one that has none."""
    from schemas.visit_page import visit_about

    about = visit_about(session_id, shown)
    if about.shown is None:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no result of session_id {session_id}",
            expected="a visit that was computed",
            next_step="`pbl populate`; `pbl status` says what stops it",
        )
    return about


def routes(pages: Pages, tables: Tables) -> list[Route]:
    """The addresses of this part."""

    async def export(request: Request) -> Response:
        from schemas.export import session_of_tables

        number, shown = number_of(request), shown_of(request)

        def load():
            about = result_of(number, shown)
            wanted = {"session_id": number, **about.key, "fit_set_kind": about.results[shown].kind}
            return session_of_tables(wanted, sensors=False)

        session = await tables.ask(load)
        return await archive_of(session, f"visit_{number}.zip")

    return [Route("/visits/{number:int}/export", export)]


async def archive_of(session: ExportSession, name: str) -> Response:
    """A visit's movement as an archive of that name, in the formats of `FORMATS`."""
    folder = tempfile.TemporaryDirectory()

    def write() -> Path:
        from pbl_pipeline.export import ExportOptions, write_export

        # As a reviewer sees it: what failed a check says so in its files.
        options = ExportOptions(number_trials=True, allow_failed=True)
        out, archive = Path(folder.name) / "files", Path(folder.name) / "visit.zip"
        paths = write_export(session, FORMATS, out, options)
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
            for path in paths:
                file.write(path, path.relative_to(out))
        return archive

    try:
        archive = await asyncio.to_thread(write)
    except BaseException:
        folder.cleanup()
        raise
    return FileResponse(archive, media_type="application/zip", filename=name, background=BackgroundTask(folder.cleanup))
