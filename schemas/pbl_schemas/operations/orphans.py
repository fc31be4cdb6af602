"""Files of the store without a row, and rows without their file: remains of killed computations and full disks."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Iterator
from contextlib import closing

from pymysql.cursors import SSCursor

from pbl_schemas import connection
from pbl_schemas.store import files_below

from .catalog import quote, tables

#: A file younger than this may belong to a row that is about to be written (s).
YOUNG_S = 3600.0


@dataclasses.dataclass(frozen=True)
class StoredFile:
    """A file of the store."""

    path: str  # in the store
    size: int  # (byte)
    age_s: float


@dataclasses.dataclass(frozen=True)
class Report:
    """Comparison of the store with the rows."""

    n_files: int  # all of the store
    n_bytes: int
    orphans: list[StoredFile]  # without a row, older than `YOUNG_S`
    lost: list[str]  # named by a row, but absent


def orphans(young_s: float = YOUNG_S) -> Report:
    """Compare the store with the rows, which are read after the files.

    A file is written before its row and never changes: one without a row that is older than any insert takes is an
    orphan.
    """
    files = {f.path: f for f in _files()}
    named = set(_named())
    root = connection.store_root() + "/"
    loose = [f for path, f in files.items() if path.startswith(root) and not _is_named(path, named)]
    there = {"/".join(path.split("/")[:i]) for path in files for i in range(1, path.count("/") + 2)}
    lost = sorted(named - there)
    old = sorted((f for f in loose if f.age_s >= young_s), key=lambda f: f.path)
    return Report(len(files), sum(f.size for f in files.values()), old, lost)


#: Ending of a file that DataJoint is writing; a killed process leaves it, and no row ever names it.
WRITING = ".saving"


def remove(found: Report, older_than_s: float, ending: str = "") -> int:
    """Delete orphans of that age (with that ending) that are still without a row; return how many."""
    store, n = connection.store_backend(), 0
    named = set(_named())
    for file in found.orphans:
        if file.path.endswith(ending) and file.age_s >= older_than_s and not _is_named(file.path, named):
            store.remove(file.path)
            n += 1
    return n


def _is_named(path: str, named: set[str]) -> bool:
    """Return True if a row names the file or a folder that contains it."""
    parts = path.split("/")
    return any("/".join(parts[:i]) in named for i in range(len(parts), 0, -1))


def _files() -> Iterator[StoredFile]:
    now = datetime.datetime.now(datetime.UTC)
    for path, about in files_below(connection.store_backend()).items():
        changed = about.get("mtime") or about.get("LastModified")
        if isinstance(changed, int | float):
            changed = datetime.datetime.fromtimestamp(changed, datetime.UTC)
        age = (now - changed).total_seconds() if changed else 0.0
        yield StoredFile(path, int(about.get("size") or 0), age)


def _named() -> Iterator[str]:
    """Yield the paths of the store that rows name, streamed through a separate connection."""
    with closing(connection.plain_connection()) as server:
        for (schema, table), columns in tables().items():
            for column in (quote(c.name) for c in columns if c.names_files):
                with server.cursor(SSCursor) as cursor:
                    cursor.execute(f"SELECT {column} FROM {quote(schema, table)} WHERE {column} IS NOT NULL")  # noqa: S608
                    for (value,) in cursor:
                        yield json.loads(value)["path"]
