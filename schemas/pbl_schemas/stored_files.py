"""Files that a row keeps in the object store."""

from __future__ import annotations

import contextlib
import functools
import glob
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.temporary import new_folder

from . import connection
from .datajoint_setup import backend_of, build_object_path, full_path

T = TypeVar("T")

_unusable = functools.partial(
    PblError,
    "FILE_FORMAT",
    next_step="restore the object store from the backup, or delete the row so that it is computed again",
)


@contextmanager
def stored_file(ref: Mapping[str, Any]) -> Iterator[Path]:
    """Path to read an object of the store, from the dict that `file_ref` took from a row. Touches no database.

    For a store in a folder it is the file itself, for a remote one a copy that is removed afterwards.

    Raises `PblError` FILE_FORMAT if the store has no such file, another size of it, or what reads it cannot.
    """
    backend = backend_of(ref.get("store") or connection.STORE)
    if backend.protocol == "file":
        path = Path(full_path(backend, ref["path"]))
        if not path.is_file():
            raise _lost(ref)
        with _readable(path, ref):
            yield path
        return
    with new_folder() as folder:
        path = folder / Path(ref["path"]).name
        if not backend.exists(ref["path"]):
            raise _lost(ref)
        backend.get_file(ref["path"], path)
        with _readable(path, ref):
            yield path


def read_stored(ref: Mapping[str, Any], read: Callable[[Path], T]) -> T:
    """Return what a function reads from an object of the store. Raises what `stored_file` does."""
    with stored_file(ref) as path:
        return read(path)


@contextmanager
def _readable(path: Path, ref: Mapping[str, Any]) -> Iterator[None]:
    """Turn errors in reading a file of the store into FILE_FORMAT, which names the file."""
    size = path.stat().st_size
    if ref.get("size") not in (None, size):
        raise _damaged(ref, f"{size} bytes where its row says {ref['size']}")
    try:
        yield
    except (
        *(ValueError, KeyError, OverflowError, EOFError, OSError, zipfile.BadZipFile, zlib.error),
        NotImplementedError,  # packed in a way that zipfile does not read
    ) as error:
        if isinstance(error, OSError) and error.filename not in (None, str(path)):
            raise  # it is about another file, such as one that is written
        raise _damaged(ref, f"{type(error).__name__}: {error}") from error


def remove_left_over(table: Any, key: Mapping[str, Any], since_s: float) -> None:
    """Remove the files of the store that attempts to insert this key into a table (instance) left since a time of the
    clock. Call it while no other worker may insert the key.

    Only in a store that is a folder: a worker may not delete from a bucket (`pbl cron disk` finds them there). Older
    files belong to a row that was deleted, which a backup that is being made may name.
    """
    backend = backend_of(connection.STORE)
    if backend.protocol != "file":
        return
    ordered, name = {n: key[n] for n in table.primary_key}, table.table_name
    path, _ = build_object_path(table.database, name, "", ordered, None, schema_prefix=connection.store_root())
    schema = Path(full_path(backend, f"{connection.store_root()}/{table.database}"))
    of_key = Path(full_path(backend, path)).parent.relative_to(schema / name)
    folders = [schema / name / of_key, *schema.glob(f"{name}__*/{glob.escape(str(of_key))}")]  # parts as well
    left = [f for folder in folders for f in folder.rglob("*") if f.is_file() and f.stat().st_mtime >= since_s]
    # FOR UPDATE: a populate without reservations that is inserting the key is waited for.
    if not left or table.connection.query(f"{(table & ordered).proj().make_sql()} FOR UPDATE").fetchone():
        return
    for file in left:
        file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            file.parent.rmdir()


def file_ref(value: Any) -> dict[str, Any]:
    """A fetched `<object@...>` or `<npy@...>` value as a small dict, which `make_fetch` may hand on. size: bytes, None
    for an array, whose row does not know how long its file is."""
    return {"path": value.path, "store": value.store, "size": None if hasattr(value, "dtype") else value.size}


def _damaged(ref: Mapping[str, Any], found: str) -> PblError:
    return _unusable(found, "the file that was stored", key=f"{ref['path']} in the object store")


def _lost(ref: Mapping[str, Any]) -> PblError:
    return _unusable(f"the object store has no {ref['path']}", "every file that a row of the database names")
