"""The rows of a test's database: register videos, see every row, remove all that a test can have added."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import schemas
from schemas import _dump, connection, lab, worker
from schemas.ingest import Visit, ingest


def register(*paths: Path, **visit) -> list[int]:
    """Ingest videos that are all new, of P001 where nothing else is said; their `video_id`s."""
    results = ingest(paths, Visit(subject=visit.pop("subject", "P001"), **visit))
    assert [r.status for r in results] == ["registered"] * len(paths), results
    return [r.video_id or 0 for r in results]


def everything() -> dict[str, list[tuple]]:
    """Every row of every table, as the server prints it."""
    with closing(connection.plain_connection(conv={})) as server:
        found = {}
        for schema, table in _dump.tables_of(server, connection.prefix()):
            columns = _dump.columns_of(server, schema, table)
            found[f"{schema}.{table}"] = sorted(_dump.rows_of(server, schema, table, columns), key=str)
        return found


def remove_all() -> None:
    """Leave the tables as `schemas.activate` makes them: no person, camera or project, no job, no worker.

    The rows of a person go by the foreign keys from `lab.Subject`: a result that does not go with them fails here,
    after everything else was removed.
    """
    lab.Subject.delete(prompt=False, part_integrity="cascade")
    lab.CameraCalibration.delete(prompt=False)
    lab.Device.delete(prompt=False)
    lab.Project.delete(prompt=False)
    kept = {table.__name__: len(table()) for table in schemas.computed_tables()}
    for table in schemas.computed_tables():
        table.jobs.delete_quick()
    for table in (worker.Throughput, worker.Crash, worker.Worker):
        table.delete_quick()
    assert not any(kept.values()), kept
