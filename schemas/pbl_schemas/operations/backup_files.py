"""Files of a backup: listings with checksums, rows as SQL statements, recordings below `recordings/` at their own path.

By hand instead of with mariadb-dump or mysqldump, for three reasons. A backup counts the rows and collects the files
that they name in the transaction that reads them; a dump program has a separate snapshot, so that a row deleted in
between would be restored without its file. mariadb-dump 10.11 writes the single-precision number 0.12345679 as
0.123457. And it is in none of the packages that the embedded server needs (Debian: mariadb-client, 63 MB with Perl),
nor in the workers' image.

The file is plain SQL: `zcat database.sql.gz | mariadb -h HOST -u USER -p` restores it without this module.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gzip
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import pymysql
from pymysql.converters import escape_string
from pymysql.cursors import SSCursor

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.files import complete_file, sha256_of

from .catalog import Column, quote

#: Length from which an INSERT statement is ended (characters); the server accepts far more.
STATEMENT = 1_000_000
_FETCH = 500
#: For a block that writes a backup to a path.
unwritable = functools.partial(
    os_errors_as,
    "FILE_UNWRITABLE",
    "a folder with room for the whole backup",
    "free space, remove what was begun, and run it again",
)
HEADER = (
    "SET NAMES utf8mb4",
    "SET SESSION time_zone = '+00:00'",
    "SET SESSION foreign_key_checks = 0",
    "SET SESSION unique_checks = 0",
    "SET SESSION sql_mode = 'STRICT_ALL_TABLES,NO_AUTO_VALUE_ON_ZERO'",
)


def create_statement(server: pymysql.Connection[Any], schema: str, table: str) -> str:
    """Return the CREATE statement of a table on one line (line breaks in comments are escaped already)."""
    with server.cursor() as cursor:
        cursor.execute(f"SHOW CREATE TABLE {quote(schema, table)}")
        row = cursor.fetchone()
    assert row is not None
    text = row[1].decode() if isinstance(row[1], bytes) else row[1]
    return re.sub(r"\n\s*", " ", text)


def rows_of(server: pymysql.Connection[Any], schema: str, table: str, columns: Sequence[Column]) -> Iterator[tuple]:
    """Yield the rows of a table, read from the server as they are needed.

    The connection must have been opened with `conv={}`: values are text as the server prints it, or bytes.
    """
    # A single-precision number is printed with six digits; as double precision it is printed to the last one.
    chosen = ", ".join(f"{quote(c.name)} + 0e0" if c.type == "float" else quote(c.name) for c in columns)
    with server.cursor(SSCursor) as cursor:
        cursor.execute(f"SELECT {chosen} FROM {quote(schema, table)}")  # noqa: S608  names of the server's own
        while rows := cursor.fetchmany(_FETCH):
            yield from rows


def save_table(
    server: pymysql.Connection[Any], schema: str, table: str, columns: Sequence[Column], out: gzip.GzipFile
) -> tuple[int, set[str]]:
    """Write the statements that create a table and insert its rows; return the number of rows and the files they
    name."""
    stored = [i for i, column in enumerate(columns) if column.names_files]
    write_line(out, f"USE {quote(schema)}")
    write_line(out, create_statement(server, schema, table))
    names = ", ".join(quote(c.name) for c in columns)
    head = f"INSERT INTO {quote(schema, table)} ({names}) VALUES "  # noqa: S608  values are escaped
    n, size, files = 0, 0, set()
    parts: list[str] = []
    for row in rows_of(server, schema, table, columns):
        n += 1
        files.update(json.loads(row[i])["path"] for i in stored if row[i] is not None)
        parts.append("(" + ",".join(map(literal, row)) + ")")
        size += len(parts[-1])
        if size > STATEMENT:
            write_line(out, head + ",".join(parts))
            parts, size = [], 0
    if parts:
        write_line(out, head + ",".join(parts))
    return n, files


def literal(value: str | bytes | None) -> str:
    """Return a value as an SQL literal."""
    if value is None:
        return "NULL"
    return f"X'{value.hex()}'" if isinstance(value, bytes) else f"'{escape_string(value)}'"


def write_line(out: gzip.GzipFile, statement: str) -> None:
    """Write one statement on one line. Raises ValueError for a statement with a line break."""
    if "\n" in statement or "\r" in statement:
        raise ValueError("a statement with a line break in it")
    out.write(statement.encode() + b";\n")


def read_lines(path: Path) -> Iterator[str]:
    """Yield the statements of a file that `write_line` wrote."""
    with gzip.open(path, "rb") as lines:
        for line in lines:
            yield line.decode().rstrip("\n").removesuffix(";")


#: Folders of a backup, each with a listing: files of the store, and registered videos.
RECORDINGS = "recordings"
PARTS = ("store", RECORDINGS)


def safe_path(path: str) -> PurePosixPath:
    """Return a path of the store if it stays inside and a disk can hold it. Raises BACKUP_INVALID."""
    parts = PurePosixPath(path)
    too_long = len(path) > 3000 or any(len(os.fsencode(part)) > 255 for part in parts.parts)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or "\n" in path or "\\" in path or too_long:
        raise PblError(
            "BACKUP_INVALID",
            key=repr(path)[:200],
            found="a path that leaves the store or is too long",
            expected="a relative path without .., of names of up to 255 bytes",
            next_step="the row was not written by this pipeline: find it and delete it",
        )
    return parts


def listed(folder: Path, part: str) -> Iterable[tuple[str, str]]:
    """Yield SHA-256 and path of the files of a part of a backup. Raises BACKUP_INVALID for a path that leaves it.

    A path that is not UTF-8 comes out as that of a missing file."""
    for line in (folder / f"{part}.sha256").read_text(encoding="utf-8", errors="replace").splitlines():
        sha, _, path = line.partition("  ")
        yield sha, str(safe_path(path))


def is_own_file(folder: Path, path: str) -> bool:
    """Return whether a path of a part of a backup is a file there, reached through no link."""
    file = folder / path
    return file.is_file() and not any(p.is_symlink() for p in (file, *file.parents) if p.is_relative_to(folder))


@dataclasses.dataclass
class Recordings:
    """Recordings that were copied."""

    paths: list[str] = dataclasses.field(default_factory=list)  # where they were registered
    n_bytes: int = 0
    left: dict[str, str] = dataclasses.field(default_factory=dict)  # path of one that was left out -> reason


def save_recordings(videos: Iterable[tuple[str, str]], folder: Path, previous: Path | None = None) -> Recordings:
    """Copy videos, given as (path, SHA-256), into a backup, and list them in `recordings.sha256`.

    Videos that an earlier backup holds are linked, which takes no space. Missing and changed ones are left out.

    Raises `PblError` FILE_UNWRITABLE: the backup.
    """
    done, before = Recordings(), set()
    if previous is not None and (previous / f"{RECORDINGS}.sha256").is_file():
        before = set(listed(previous, RECORDINGS))
    with (
        (folder / f"{RECORDINGS}.sha256").open("w", encoding="utf-8") as listing,
        progress.bar(RECORDINGS, unit="file") as update,
    ):
        for path, sha in videos:
            update(1)
            name = path.lstrip("/")
            target = folder / RECORDINGS / name
            old = previous / RECORDINGS / name if previous is not None and (sha, name) in before else None
            with unwritable(target):
                why = _save_recording(Path(path), sha, target, old)
            if why:
                done.left[path] = why
                continue
            listing.write(f"{sha}  {name}\n")
            done.paths.append(path)
            done.n_bytes += target.stat().st_size
    return done


def _save_recording(path: Path, sha: str, target: Path, old: Path | None) -> str:
    """Link or copy one recording; return the reason if it was left out, else ""."""
    try:
        safe_path(str(path).lstrip("/"))
        with path.open("rb"):
            pass
    except PblError as error:
        return error.found
    except OSError as error:
        return error.strerror or str(error)
    target.parent.mkdir(parents=True, exist_ok=True)
    if old is not None:
        with contextlib.suppress(OSError):  # another disk, or a file system without links
            os.link(old, target)
            return ""
    shutil.copyfile(path, target)
    if sha256_of(target) != sha:
        target.unlink()
        return "not the bytes that were registered"
    return ""


def restore_recordings(folder: Path, registered: Mapping[str, str], below: Sequence[Path]) -> Recordings:
    """Copy the recordings of a backup back to where they were registered. Existing files are never changed.

    Parameters
    ----------
    registered
        Path -> SHA-256 of the videos in the rows; what the backup lists besides is left out.
    below
        Folders in which files may be written; recordings elsewhere are left out.

    Raises `PblError` FILE_UNWRITABLE.
    """
    done = Recordings()
    if not (folder / f"{RECORDINGS}.sha256").exists():
        return done
    roots = [root.resolve() for root in below]
    for sha, name in listed(folder, RECORDINGS):
        path = Path("/") / name
        if registered.get(str(path)) != sha:
            done.left[str(path)] = "no row names this file with these bytes"
            continue
        if path.is_symlink() or not any(path.parent.resolve().is_relative_to(root) for root in roots):
            done.left[str(path)] = f"outside of {', '.join(map(str, below))} (--recordings-below FOLDER)"
            continue
        if path.exists():
            if sha256_of(path) != sha:
                done.left[str(path)] = "another file is there"
            continue
        with (
            os_errors_as(
                "FILE_UNWRITABLE",
                "the place where this recording was registered",
                "make it writable, with room, then copy recordings/ of the backup there by hand (cp -n -r)",
                path,
            ),
            _private(),
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
            with complete_file(path) as part:
                shutil.copyfile(folder / RECORDINGS / name, part)
        done.paths.append(str(path))
        done.n_bytes += path.stat().st_size
    return done


@contextlib.contextmanager
def _private() -> Iterator[None]:
    """Make new files and folders readable by their owner only."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)
