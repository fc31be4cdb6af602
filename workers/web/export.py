"""The movement of a visit as files of other programs."""

from __future__ import annotations

import asyncio
import zipfile
from pathlib import Path

from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, Response

from pbl_pipeline.temporary import new_folder
from pbl_pipeline.visit import Visit

from .address import Address, number_of, shown_of
from .source import Source
from .tables import Asks

#: Formats of the archive: those that need no further package.
FORMATS = ("csv", "trc", "mot")


def routes(asks: Asks, source: Source) -> list[Address]:
    async def export(request: Request) -> Response:
        number, result = number_of(request), shown_of(request)

        def load() -> Visit:
            return source.to_export(number, result).loaded()

        return await archive_of(await asks.ask(load), f"visit_{number}.zip")

    return [Address("/visits/{session_id:int}/export", export, "look", look="export")]


async def archive_of(visit: Visit, name: str) -> Response:
    """A visit's movement as an archive of that name, in the formats of `FORMATS`."""
    folder = new_folder()

    def write() -> Path:
        from pbl_pipeline.export import ExportOptions, write_export

        # As a reviewer sees it: the files state failed checks.
        options = ExportOptions(number_trials=True, allow_failed=True)
        out, archive = folder.path / "files", folder.path / "visit.zip"
        paths = write_export(visit, FORMATS, out, options)
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
