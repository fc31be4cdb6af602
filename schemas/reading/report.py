"""The report and files of a visit from the tables, with the pictures that may be shown."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import privacy
from .visits import fitted_visit

if TYPE_CHECKING:
    from pbl_pipeline.visit import Visit


def write_visit(restriction: Any, out: Path) -> list[Path]:
    """Write the files of `pbl_pipeline.pipeline.write_results` for one visit; nothing is computed anew.

    Raises `PblError` DB_NOT_FOUND when the visit is unknown or not computed yet, USAGE when several match; what
    `to_show` raises; VIDEO_MISSING when a recording is no longer where it was.
    """
    # The library's drawing half is heavy; commands that only look at rows do not pay for it.
    from pbl_pipeline.pipeline import write_results

    with contextlib.ExitStack() as open_files:
        return write_results(out, to_show(fitted_visit(restriction, whole=True), open_files))


def to_show(visit: Visit, open_files: contextlib.ExitStack) -> Visit:
    """Return a visit of the tables with the recordings whose pictures may be shown.

    `open_files` holds the de-identified copies where PBL_DEIDENTIFY is set: close it when all is drawn. Raises, where
    it is set, `PblError` DB_NOT_FOUND without a de-identified copy, HEAD_NOT_FOUND where nothing was covered in it.
    """
    recordings = tuple(
        dataclasses.replace(r, shown=open_files.enter_context(privacy.shown(r.number)))
        if r.fitted and r.path is not None and r.number is not None
        else r
        for r in visit.recordings
    )
    return dataclasses.replace(visit, recordings=recordings)
