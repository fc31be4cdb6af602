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

from . import site
from .address import Address, number_of, shown_of

#: Formats of the archive: those that need no further package.
FORMATS = ("csv", "trc", "mot")


async def export(request: Request) -> Response:
    number, result = number_of(request), shown_of(request)
    visit = await site.ask(request, lambda: site.of(request).source.to_export(number, result).loaded())
    folder = new_folder()
    try:
        archive = await asyncio.to_thread(_archive, visit, folder.path)
    except BaseException:
        folder.cleanup()
        raise
    done = BackgroundTask(folder.cleanup)
    return FileResponse(archive, media_type="application/zip", filename=f"visit_{number}.zip", background=done)


ROUTES = [Address("/visits/{session_id:int}/export", export, "look", look="export")]


def _archive(visit: Visit, folder: Path) -> Path:
    """Write a visit's movement into an archive in a folder, in the formats of `FORMATS`."""
    from pbl_pipeline.export import ExportOptions, write_export

    # As a reviewer sees it: the files state failed checks.
    options = ExportOptions(number_trials=True, allow_failed=True)
    out, archive = folder / "files", folder / "visit.zip"
    paths = write_export(visit, FORMATS, out, options)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path in paths:
            file.write(path, path.relative_to(out))
    return archive
