"""Fills a database with the code of an older commit; what it leaves is `old_database.sql.gz` beside this file.

    git archive 28e5ab3 | tar -x -C OLD                       # the first commit with all tables of the chain
    export PBL_HOME=HOME
    (cd OLD && PYTHONPATH=OLD python tests/integration/data/old_rows.py)   # this file, copied there
    pbl db backup --database-only SAVED                       # the present code's backup, of the old tables
    cp SAVED/database.sql.gz tests/integration/data/old_database.sql.gz
    pbl db stop

One visit with two videos through the whole chain (stand-ins for the slow stages), one file that is no video.
"""

from __future__ import annotations

import platform
import tempfile
from pathlib import Path

import pytest

if __name__ == "__main__":
    import schemas
    from schemas import embedded
    from schemas.ingest import Visit, ingest
    from tests.integration import chain
    from workers.populate import populate

    embedded.start(print)
    schemas.activate()
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(platform, "node", lambda: "workstation")
        chain.install(patch)
        (Path(folder) / "notes.mp4").write_text("not a video")
        videos = [chain.small_video(Path(folder), "walk1"), chain.small_video(Path(folder), "walk2", n=210)]
        ingest([*videos, Path(folder) / "notes.mp4"], Visit(subject="P001", session_label="2026-03-01", project="old"))
        print(populate())  # noqa: T201
        for table in schemas.computed_tables():  # stacks name the folders of the machine this ran on
            for key in list(table.jobs.errors.keys()):
                table.jobs.update1({**key, "error_stack": None})
