"""Files that a row keeps in the object store."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError

from . import connection
from ._datajoint import backend_of, full_path


@contextmanager
def new_folder() -> Iterator[Path]:
    """A folder for a file that is about to enter the object store; gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="pbl-") as folder:
        yield Path(folder)


@contextmanager
def stored_file(table: Any, ref: Mapping[str, Any]) -> Iterator[Path]:
    """Path to read an object of the store, from the dict that `file_ref` took from a row. Touches no database.

    A store in a folder gives the file itself; a remote one a copy that is removed afterwards.
    """
    backend = backend_of(ref.get("store") or connection.STORE)
    if backend.protocol == "file":
        path = Path(full_path(backend, ref["path"]))
        if not path.is_file():
            raise _lost(ref)
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="pbl-") as folder:
        path = Path(folder) / Path(ref["path"]).name
        if not backend.exists(ref["path"]):
            raise _lost(ref)
        backend.get_file(ref["path"], path)
        yield path


def file_ref(value: Any) -> dict[str, Any]:
    """A fetched `<object@...>` value as a small dict: what `make_fetch` may hand on (its fetch is hashed twice)."""
    return {"path": value.path, "store": value.store, "size": value.size}


def _lost(ref: Mapping[str, Any]) -> PblError:
    return PblError(
        "FILE_FORMAT",
        found=f"the object store has no {ref['path']}",
        expected="every file that a row of the database names",
        next_step="restore the object store from the backup, or delete the row so that it is computed again",
    )
