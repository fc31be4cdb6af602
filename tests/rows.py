"""The rows of a test's database: register videos, see every row, remove all that a test can have added."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

from pbl_pipeline import settings
from schemas import connection
from schemas.intake import VisitRecord, ingest
from schemas.operations import catalog, dump


def register(*paths: Path, **visit) -> list[int]:
    """Ingest videos that are all new, of P001 where nothing else is said; their `video_id`s."""
    results = ingest(paths, VisitRecord(subject=visit.pop("subject", "P001"), **visit))
    assert [r.status for r in results] == ["registered"] * len(paths), results
    return [r.video_id or 0 for r in results]


def everything() -> dict[str, list[tuple]]:
    """Every row of every table, as the server prints it."""
    with closing(connection.plain_connection(conv={})) as server:
        return {
            f"{schema}.{table}": sorted(dump.rows_of(server, schema, table, columns), key=str)
            for (schema, table), columns in catalog.tables().items()
        }


def everything_but_refreshes() -> dict[str, list[tuple]]:
    """`everything` without what is nobody's: the last refresh, which every populate writes, and the numbers given."""
    nobodys = ("_worker.look", "_lab.numbered")
    return {name: rows for name, rows in everything().items() if not name.endswith(nobodys)}


def remove_all() -> None:
    """Leave the tables as `schemas.activate` makes them: every row and every job goes but the methods (`#`), and so do
    the lists of what was removed of whom (`forget.manifest_path`), by which a person is forgotten again.

    In one transaction of plain statements: what depends on what was deleted is not looked up, which takes DataJoint
    seconds. That results go with their person is a test of its own (test_validation.py).
    """
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SET foreign_key_checks = 0")
        server.begin()
        for schema, table in catalog.tables():
            if not table.startswith("#") and (not table.startswith("~") or table.startswith("~~")):
                cursor.execute(f"DELETE FROM {catalog.quote(schema, table)}")
        server.commit()
    shutil.rmtree(settings.home_dir() / "forgotten", ignore_errors=True)
