"""Back up the database and its object store into one folder, and restore them.

    manifest.json        time, server, rows of every table, checksums; written last: it marks a complete backup
    database.sql.gz      every table and row, in the state of one moment
    store.sha256         SHA-256 and path of every file of `store/`, as `sha256sum -c` reads it
    store/               the files that rows of that moment name; files without a row are not kept
    recordings.sha256, recordings/    on request: the registered videos (`backup_files.py`)

The rows are read in one transaction, then the files they name are copied. A file never changes once its row is there,
so both are of the same moment while workers go on.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import gzip
import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pymysql

from pbl_pipeline import progress
from pbl_pipeline.bounded import read_json
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_schemas import connection
from pbl_schemas.operations.folders import make_private, private_folder, write_json
from pbl_schemas.store import check_store, store_error, store_errors

from . import backup_files, catalog
from .archive import archive_dir
from .backup_files import PARTS, is_own_file, listed, safe_path, unwritable
from .catalog import Column, quote

FORMAT = 1
#: Schema (after the prefix) that marks an unfinished restore.
_MARKER = "restoring"

Say = Callable[[str], None]
_refused = functools.partial(PblError, "DB_REFUSED")
_invalid = functools.partial(PblError, "BACKUP_INVALID", next_step="use another backup; nothing was changed")


@dataclasses.dataclass(frozen=True)
class Backup:
    """A backup that was made or restored."""

    folder: Path
    created: str  # ISO 8601, UTC
    rows: dict[str, int]  # `schema.table` -> number of rows
    n_files: int  # of the store
    n_bytes: int  # of files and recordings
    n_recordings: int = 0
    left: dict[str, str] = dataclasses.field(default_factory=dict)  # path of a recording left out -> reason


def backup(
    folder: Path,
    store: bool = True,
    say: Say = lambda _: None,
    with_recordings: bool = False,
    previous: Path | None = None,
) -> Backup:
    """Save the database and the store into a new folder, and the recordings on request.

    Raises `PblError` FILE_UNWRITABLE; BACKUP_INVALID if a file that a row names is lost (all are named);
    STORE_UNAVAILABLE; DB_REFUSED if a table was created or altered meanwhile.

    Parameters
    ----------
    folder
        Must not exist, or be empty.
    store
        False leaves the files out, for an object store that is saved by other means.
    with_recordings
        Also save the registered videos. One that is gone or changed is left out and named.
    previous
        An earlier backup: recordings that it holds are linked instead of copied.
    """
    _new_folder(folder)
    prefix = connection.prefix()
    connection.connect()
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    try:
        with closing(connection.plain_connection(conv={})) as server:
            version = _snapshot(server)
            tables = catalog.tables()
            if not tables:
                raise PblError(
                    "DB_NOT_FOUND",
                    found=f"no table under {prefix}_*",
                    expected="a database with tables",
                    next_step="check PBL_DB_PREFIX and DJ_HOST, or: pbl db init",
                )
            say(f"Saving {len(tables)} tables of {prefix}_* into {folder}")
            rows, files = _save_tables(server, tables, folder / "database.sql.gz")
            videos = _videos(server, prefix) if with_recordings else []
    except pymysql.err.Error as error:
        raise PblError(
            "DB_REFUSED",
            found=str(error.args[-1]),
            expected="tables that are not created or altered while they are saved",
            next_step="run it again; rows may be written meanwhile, but no table created or altered",
        ) from error
    n_bytes = 0
    if store:
        say(f"Saving {len(files)} files of the store")
        n_bytes = _save_files(sorted(files), folder)
    copied = backup_files.Recordings()
    if with_recordings:
        say(f"Saving {len(videos)} recordings")
        copied = backup_files.save_recordings(videos, folder, previous)
    listings = [f"{part}.sha256" for part in PARTS if (folder / f"{part}.sha256").exists()]
    manifest = {
        "format": FORMAT,
        "pbl_pipeline": code_version(),
        "created": created,
        "server": version,
        "prefix": prefix,
        "rows": rows,
        "store": store,
        "n_files": len(files) if store else 0,
        "n_bytes": n_bytes + copied.n_bytes,
        "n_recordings": len(copied.paths),
        "recordings_left": copied.left,
        "sha256": {name: sha256_of(folder / name) for name in ("database.sql.gz", *listings)},
    }
    with unwritable(folder):
        write_json(folder / "manifest.json", manifest)
    return Backup(folder, created, rows, manifest["n_files"], manifest["n_bytes"], len(copied.paths), copied.left)


#: Files of a backup that its manifest has the sums of.
_SUMMED = ("database.sql.gz", *(f"{part}.sha256" for part in PARTS))


def check(folder: Path, say: Say = lambda _: None) -> dict[str, Any]:
    """Compare every byte of a backup with its checksums; return the manifest. Raises `PblError` BACKUP_INVALID, which
    names the missing or changed files."""
    try:
        manifest = read_json(folder / "manifest.json")
        parts = dict(manifest["sha256"])
        manifest.setdefault("n_recordings", 0)  # a backup from before they were saved
        if manifest["format"] != FORMAT:
            raise _invalid(f"format {manifest['format']}", f"format {FORMAT}", key=folder)
        expected = int(manifest["n_files"]) + int(manifest["n_recordings"])
        if absent := {"created", "prefix", "rows", "store", "n_bytes"} - set(manifest):
            raise KeyError(*absent)
    except FileNotFoundError as error:
        found = "no manifest.json: this is not a backup, or an interrupted one"
        raise _invalid(found, "manifest.json, written last", key=folder) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise _invalid(
            f"manifest.json cannot be read ({error})", "the manifest that pbl db backup wrote", key=folder
        ) from error
    for name, sha in parts.items():
        if name not in _SUMMED or not is_own_file(folder, name) or sha256_of(folder / name) != sha:
            raise _invalid(f"{name} is missing or was changed", f"SHA-256 {sha}", key=folder)
    files = [(part, *file) for part in PARTS if f"{part}.sha256" in parts for file in listed(folder, part)]
    say(f"Checking {len(files)} files of the backup")
    wrong = []
    with progress.bar("check", total=len(files), unit="file") as update:
        for part, sha, path in files:
            file = folder / part / path
            if not is_own_file(folder / part, path) or sha256_of(file) != sha:
                wrong.append(f"{part}/{path}")
            update(1)
    if wrong or len(files) != expected:
        found = f"{len(wrong)} files are missing or were changed: {', '.join(wrong[:5])}"
        raise _invalid(
            found, f"{expected} files as listed in {', '.join(p for p in parts if p.endswith('256'))}", key=folder
        )
    return manifest


def restore(
    folder: Path, again: bool = False, say: Say = lambda _: None, below: Sequence[Path] | None = None
) -> Backup:
    """Restore a backup into an empty database and its store. Everything is checked before anything is written.

    `below`: folders in which recordings may be written; None: the archive of uploads alone.

    Raises `PblError` BACKUP_INVALID; STORE_UNAVAILABLE; DB_REFUSED if this prefix has tables already, PBL_DB_PREFIX
    differs from the backup's, or a file of the store from the backup's.

    `again`: after an interrupted restore: remove the tables it left, then start again.
    """
    manifest = check(folder, say)
    connection.connect(start=True)  # a new place has no server yet
    prefix = connection.prefix()
    if prefix != manifest["prefix"]:
        raise _refused(
            f"the backup holds {manifest['prefix']}_*, this database is {prefix}_*",
            "the same prefix",
            f"set PBL_DB_PREFIX={manifest['prefix']}",
        )
    try:
        with closing(connection.plain_connection()) as server, server.cursor() as cursor:
            _make_room(cursor, prefix, again)
            if manifest["store"]:
                check_store(connection.store_backend(), create=True)
                say(f"Bringing {manifest['n_files']} files back")
                _restore_files(folder)
            say(f"Bringing {len(manifest['rows'])} tables back")
            total = sum(manifest["rows"].values())
            with progress.bar("restore", total=total, unit="row") as update:
                for statement in backup_files.read_lines(folder / "database.sql.gz"):
                    n = cursor.execute(statement)
                    update(n if statement.startswith("INSERT") else 0)
            for name, expected in manifest["rows"].items():
                cursor.execute(f"SELECT COUNT(*) FROM {quote(*name.split('.', 1))}")  # noqa: S608
                if (found := cursor.fetchone()[0]) != expected:
                    said = f"{found} rows in {name} after the restore"
                    raise _refused(said, f"{expected}", "run the same with --again")
            cursor.execute(f"DROP DATABASE {quote(f'{prefix}_{_MARKER}')}")
        catalog.analyse()
    except pymysql.err.Error as error:
        raise _refused(
            str(error.args[-1]),
            "a server that takes the tables back",
            "correct the cause and run the same with --again, which first removes what was begun",
        ) from error
    say(f"Bringing {manifest['n_recordings']} recordings back to where they were registered")
    with closing(connection.plain_connection()) as server:
        registered = dict(_videos(server, prefix)) if manifest["n_recordings"] else {}
    copied = backup_files.restore_recordings(folder, registered, below or [archive_dir()])
    about = (manifest["created"], manifest["rows"], manifest["n_files"], manifest["n_bytes"])
    return Backup(folder, *about, len(copied.paths), copied.left)


# ----------------------------------------------------------------------------------------------------------- saving
def _snapshot(server: pymysql.Connection[Any]) -> str:
    """Begin a snapshot of all rows for this connection; return the version of the server."""
    with server.cursor() as cursor:
        cursor.execute("SELECT VERSION()")
        version = str((cursor.fetchone() or ("",))[0])
        cursor.execute("SET SESSION time_zone = '+00:00'")
        cursor.execute("SET SESSION TRANSACTION ISOLATION LEVEL REPEATABLE READ")
        cursor.execute("START TRANSACTION WITH CONSISTENT SNAPSHOT, READ ONLY")
    return version


def _videos(server: pymysql.Connection[Any], prefix: str) -> list[tuple[str, str]]:
    with server.cursor() as cursor:
        cursor.execute(f"SELECT video_path, video_sha256 FROM {quote(f'{prefix}_video', 'video')}")  # noqa: S608
        return [(str(path), str(sha)) for path, sha in cursor.fetchall()]


def _save_tables(
    server: pymysql.Connection[Any], tables: dict[tuple[str, str], list[Column]], path: Path
) -> tuple[dict[str, int], set[str]]:
    rows: dict[str, int] = {}
    files: set[str] = set()
    with (
        gzip.open(path, "wb", compresslevel=6) as out,
        progress.bar("tables", total=len(tables), unit="table") as update,
    ):
        for statement in backup_files.HEADER:
            backup_files.write_line(out, statement)
        for schema in dict.fromkeys(schema for schema, _ in tables):
            backup_files.write_line(out, f"CREATE DATABASE IF NOT EXISTS {quote(schema)}")
        for (schema, table), columns in tables.items():
            rows[f"{schema}.{table}"], named = backup_files.save_table(server, schema, table, columns, out)
            files |= named
            update(1)
    return rows, files


def _save_files(paths: list[str], folder: Path) -> int:
    store, lost, n_bytes = connection.store_backend(), [], 0
    with (
        (folder / "store.sha256").open("w", encoding="utf-8") as listing,
        progress.bar("store", total=len(paths), unit="file") as update,
    ):
        for path in paths:
            target = folder / "store" / safe_path(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            with unwritable(target):
                try:
                    store.get_file(path, target)
                    listing.write(f"{sha256_of(target)}  {path}\n")
                    n_bytes += target.stat().st_size
                except FileNotFoundError:
                    lost.append(path)
                except OSError:
                    raise
                except Exception as error:
                    raise store_error(error) from error
            update(1)
    if lost:
        raise PblError(
            "BACKUP_INVALID",
            key=folder,
            found=f"{len(lost)} files that rows name are not in the store: {', '.join(lost[:5])}",
            expected="every file that a row of the database names",
            next_step="restore them from an older backup, or delete the rows so that they are computed again; "
            "--database-only saves the tables as they are",
        )
    return n_bytes


# -------------------------------------------------------------------------------------------------------- restoring
def _make_room(cursor: Any, prefix: str, again: bool) -> None:
    """Refuse a database with tables, and set the marker; an existing marker is that of an interrupted restore."""
    marker = f"{prefix}_{_MARKER}"
    if marker in catalog.schemas():
        if not again:
            raise _refused(
                f"an interrupted restore left {len(catalog.tables())} tables",
                "an empty database",
                "run the same with --again: it removes these tables and starts again",
            )
        cursor.execute("SET SESSION foreign_key_checks = 0")  # the schemas refer to each other
        for schema in catalog.schemas():
            if schema != marker:
                cursor.execute(f"DROP DATABASE {quote(schema)}")
        return
    tables = catalog.tables()
    if tables:
        raise _refused(
            f"there are {len(tables)} tables under {prefix}_* already",
            "an empty database: nothing is ever restored over another",
            "start a new server (embedded: another PBL_HOME, then pbl db start) and restore there",
        )
    cursor.execute(f"CREATE DATABASE {quote(marker)}")


def _restore_files(folder: Path) -> None:
    store, files = connection.store_backend(), list(listed(folder, "store"))
    with progress.bar("store", total=len(files), unit="file") as update:
        for sha, path in files:
            with store_errors():
                if not store.exists(path):
                    store.put_file(folder / "store" / path, path)
                elif hashlib.sha256(store.get_buffer(path)).hexdigest() != sha:
                    raise _refused(
                        f"the store has another {path}", "no such file, or the same", "restore into an empty store"
                    )
            update(1)


# ------------------------------------------------------------------------------------------------------------ files
def _new_folder(folder: Path) -> None:
    with unwritable(folder):
        private_folder(folder)
        empty = not any(folder.iterdir())
        if empty:
            make_private(folder)
    if not empty:
        raise PblError(
            "FILE_UNWRITABLE",
            key=folder,
            found="a folder with something in it",
            expected="a new or empty folder: no backup is ever written over another",
            next_step="name another folder, such as one with today's date",
        )
