"""The rows of a test's database: register videos, see every row, insert too late, remove all that a test can
have added."""

import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from pbl_pipeline import settings
from pbl_schemas import connection, fit
from pbl_schemas.intake import Registered, VisitRecord, ingest
from pbl_schemas.intake.records import session_ids
from pbl_schemas.operations import backup_files, catalog
from pbl_schemas.rows import InputChanged
from pbl_schemas.transactions import in_transaction


def outcomes(results: Iterable[Registered]) -> list[str]:
    """The outcome of each file: "registered", "known", ..., or the code of the error with which it was refused."""
    results = list(results)
    assert all((r.error is None) == (r.status != "refused") for r in results), results
    return [r.error.code if r.error else r.status for r in results]


def register(*paths: Path, **visit) -> list[int]:
    """Ingest videos that are all new, of P001 where nothing else is said; their `video_id`s."""
    results = ingest(paths, VisitRecord(subject=visit.pop("subject", "P001"), **visit))
    assert outcomes(results) == ["registered"] * len(paths), results
    return [r.video_id or 0 for r in results]


@contextmanager
def one_query_at_a_time() -> Iterator[None]:
    """The test's thread and one of the program share DataJoint's connection, as no two threads do outside tests."""
    execute = connection.dj.Connection._execute_query

    def alone(connected: Any, *args: Any) -> None:
        with vars(connected).setdefault("_waiting", threading.RLock()):
            execute(connected, *args)

    with mock.patch.object(connection.dj.Connection, "_execute_query", alone):
        yield


def new_visit(label: str, subject: str = "P001") -> int:
    """Register a visit without recordings; its `session_id`."""
    (number,) = in_transaction(lambda: session_ids([VisitRecord(subject, label)])).values()
    return number


def everything() -> dict[str, list[tuple]]:
    """Every row of every table, as the server prints it."""
    with closing(connection.plain_connection(conv={})) as server:
        return {
            f"{schema}.{table}": sorted(backup_files.rows_of(server, schema, table, columns), key=str)
            for (schema, table), columns in catalog.tables().items()
        }


def everything_but_refreshes() -> dict[str, list[tuple]]:
    """`everything` without what is nobody's: the last refresh, which every populate writes, and the numbers given."""
    nobodys = ("_worker.look", "_lab.numbered")
    return {name: rows for name, rows in everything().items() if not name.endswith(nobodys)}


class Saved:
    """Rows, their arrays and the videos of a folder, to have the same again after `remove_all`."""

    def __init__(self, folder: Path, copy: Path) -> None:
        """Save all rows but the methods, and the folder as `copy`."""
        self.folder, self.copy = folder, copy
        with closing(connection.plain_connection(conv={})) as server:
            self.statements = [
                f"INSERT INTO {catalog.quote(*table)} ({names}) VALUES ({','.join(map(backup_files.literal, row))})"
                for table, columns in catalog.tables().items()
                if _of_tests(table[1])
                for names in [", ".join(catalog.quote(c.name) for c in columns)]
                for row in backup_files.rows_of(server, *table, columns)
            ]
        shutil.copytree(folder, copy / "videos")
        shutil.copytree(_store(), copy / "store", copy_function=_link)

    def put_back(self) -> None:
        """Insert the rows into tables that have none."""
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            for statement in (*backup_files.HEADER, "START TRANSACTION", *self.statements, "COMMIT"):
                cursor.execute(statement)
        shutil.rmtree(self.folder)
        shutil.copytree(self.copy / "videos", self.folder)
        shutil.copytree(self.copy / "store", _store(), copy_function=_link, dirs_exist_ok=True)


def _store() -> Path:
    return Path(connection.store_backend().spec["location"])


def _link(path: str, link: str) -> None:
    if not os.path.exists(link):
        os.link(path, link)


def _of_tests(table: str) -> bool:
    """True for a table whose rows a test makes: results, decisions and jobs, no methods."""
    return not table.startswith("#") and (not table.startswith("~") or table.startswith("~~"))


def remove_all() -> None:
    """Leave the tables as `pbl_schemas.activate` makes them: every row and every job goes but the methods (`#`), and so
    do the lists of what was removed of whom (`forget.manifest_path`), by which a person is forgotten again.

    In one transaction of plain statements: what depends on what was deleted is not looked up, which takes DataJoint
    seconds. That results go with their person is a test of its own (test_validation.py).
    """
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        names = [catalog.quote(schema, table) for schema, table in catalog.names() if _of_tests(table)]
        has_rows = (f"SELECT '{name}' FROM DUAL WHERE EXISTS (SELECT 1 FROM {name})" for name in names)
        cursor.execute(" UNION ALL ".join(has_rows) or "DO 0")  # one question for all of them
        filled = [name for (name,) in cursor.fetchall()]
        cursor.execute("SET foreign_key_checks = 0")
        server.begin()
        for name in filled:
            cursor.execute(f"DELETE FROM {name}")
        server.commit()
    shutil.rmtree(settings.home_dir() / "forgotten", ignore_errors=True)


def copies(video_id: int, n: int, first: int = 0) -> None:
    """Give n further videos, with numbers from `first` + 1 on behind that of the video, its rows in every table that
    names it, its jobs and its phone recording."""
    own = {
        "video_id": "t.video_id + more.n",
        "video_sha256": "SHA2(CONCAT(t.video_sha256, more.n), 256)",
        "phone_recording": "t.phone_recording + more.n",
        "phone_sha256": "SHA2(CONCAT(t.phone_sha256, more.n), 256)",
    }
    counted = f"WITH RECURSIVE more (n) AS (SELECT {first + 1} UNION ALL SELECT n + 1 FROM more WHERE n < {first + n})"
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SET foreign_key_checks = 0")
        for table, columns in catalog.tables().items():
            names = [c.name for c in columns]
            if "video_id" not in names:
                continue
            values = ", ".join(own.get(name, f"t.{catalog.quote(name)}") for name in names)
            cursor.execute(
                f"INSERT IGNORE INTO {catalog.quote(*table)} ({', '.join(map(catalog.quote, names))}) "
                f"{counted} SELECT {values} FROM {catalog.quote(*table)} AS t, more WHERE t.video_id = {video_id}"
            )


def remove_copy(video_id: int) -> None:
    """Remove a video of `copies` with its rows in every table that names it."""
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SET foreign_key_checks = 0")
        for table, columns in catalog.tables().items():
            if "video_id" in [c.name for c in columns]:
                cursor.execute(f"DELETE FROM {catalog.quote(*table)} WHERE video_id = {video_id}")
        server.commit()


def late_fit(removed: Any, match: str) -> None:
    """Compute the only fit again; its files in this table are removed before its insert, which is refused."""
    table = fit.SessionFit()
    key = table.fetch1("KEY")
    result = table.make_compute(key, *table.make_fetch(key))
    table.delete(prompt=False, part_integrity="cascade")
    with table.connection.transaction:
        with closing(connection.plain_connection()) as other:
            other.cursor().execute(f"DELETE FROM {removed.full_table_name}")
        assert len(removed()) == 1  # as this transaction sees it until its end
        with connection.inserting(table), pytest.raises(InputChanged, match=match):
            table.make_insert(key, *result)
    assert len(table) == 0
