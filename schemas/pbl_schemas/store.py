"""The store of arrays: a folder, or a bucket of an object store (S3, MinIO)."""

from __future__ import annotations

import errno
import hashlib
import importlib.util
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError

from .datajoint_setup import full_path
from .job_errors import store_full
from .operations.folders import private_folder, secret

#: Folder of the bucket under which everything of ours lies; the phones' uploads may have another one beside it.
LOCATION = "arrays"
#: Packages whose errors are those of an object store, beside OSError.
CLIENTS = ("botocore", "aiobotocore", "aiohttp")


def is_remote() -> bool:
    """True when PBL_S3_ENDPOINT names an object store."""
    return bool(os.environ.get("PBL_S3_ENDPOINT"))


def describe() -> str:
    """Return the place of the arrays in words, without any secret."""
    if is_remote():
        return f"{os.environ['PBL_S3_ENDPOINT']}, bucket {bucket()}"
    return str(settings.store_dir())


def bucket() -> str:
    """Name of the bucket (PBL_S3_BUCKET, default `pbl`)."""
    return os.environ.get("PBL_S3_BUCKET") or "pbl"


def store_spec() -> dict[str, Any]:
    """Return the store for DataJoint's configuration. Makes the folder; asks no object store yet (`check_store` does).

    Raises `PblError` DB_REFUSED for a folder that cannot be used, USAGE for settings of an object store that cannot
    work, STORE_UNAVAILABLE if the package for object stores is missing.
    """
    if is_remote():
        return _bucket_spec()
    folder = settings.store_dir()
    try:
        private_folder(folder)
    except OSError as error:
        raise _folder_error(folder, str(error)) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise _folder_error(folder, "it exists, and you may not write to it")
    return {"protocol": "file", "location": str(folder), "subfolding": [2, 2]}


def _bucket_spec() -> dict[str, Any]:
    endpoint = os.environ["PBL_S3_ENDPOINT"].rstrip("/")
    key, password = secret("PBL_S3_KEY"), secret("PBL_S3_SECRET")
    if not endpoint.startswith(("http://", "https://")) or "@" in endpoint:
        raise PblError(
            "USAGE",
            key="PBL_S3_ENDPOINT",  # its value may hold a password: user:password@host
            found="an address without http:// or https://, or with a user in it",
            expected="such as https://minio.lab.example:9000",
            next_step="correct the variable; key and secret go into PBL_S3_KEY_FILE and PBL_S3_SECRET_FILE",
        )
    if bool(key) != bool(password):
        raise PblError(
            "USAGE",
            key=f"PBL_S3_ENDPOINT={endpoint}",
            found="only one of key and secret is set",
            expected="both, or neither where the machine itself has an identity",
            next_step="set PBL_S3_KEY_FILE and PBL_S3_SECRET_FILE (or PBL_S3_KEY and PBL_S3_SECRET)",
        )
    if importlib.util.find_spec("s3fs") is None:
        raise PblError(
            "STORE_UNAVAILABLE",
            key=f"PBL_S3_ENDPOINT={endpoint}",
            found="the package s3fs is not installed",
            expected="the extra `s3` of pbl-pipeline",
            next_step="pip install 'pbl-pipeline[s3]', or unset PBL_S3_ENDPOINT to keep arrays in a folder",
        )
    spec = {"protocol": "s3", "endpoint": endpoint, "bucket": bucket(), "location": LOCATION, "subfolding": [2, 2]}
    login = {"access_key": key, "secret_key": password} if key and password else {}
    return {**spec, "secure": endpoint.startswith("https://"), **login}


def further_stores(taken: str) -> dict[str, Any]:
    """Return the stores that DJ_STORES describes (JSON, as DataJoint reads it), for a lab's custom tables.

    Raises `PblError` USAGE where it is not a JSON object of stores, or describes the store `taken`, which other
    variables decide.
    """
    raw = os.environ.get("DJ_STORES")
    if not raw:
        return {}
    try:
        found = json.loads(raw)
    except ValueError:
        found = None
    if not isinstance(found, dict) or taken in found:
        # The value is not repeated: it may hold a key.
        raise PblError(
            "USAGE",
            key="DJ_STORES",
            found=f"it describes the store {taken!r}" if isinstance(found, dict) else "it is not a JSON object",
            expected='stores of your own, such as {"raw": {"protocol": "file", "location": "/data/raw"}}; '
            f"PBL_STORE and PBL_S3_* describe {taken!r}",
            next_step="correct the variable, or unset it",
        )
    return found


def check_store(backend: Any, create: bool = False) -> None:
    """Write, read and compare a small object in the store.

    Raises `PblError` as `store_errors`.

    `backend`: DataJoint's storage backend of the store `arrays` (`pbl_schemas.connection.store_backend()`). `create`:
    make the bucket where it is missing.
    """
    # In a bucket always the same object, because a worker's key may not delete; in a folder a separate file that is
    # removed. Several processes may write that object at once: it holds some bytes and their hash whoever wrote it.
    name = secrets.token_bytes(16)
    content = name + hashlib.sha256(name).digest()
    probe = f"probe-{name.hex()}" if backend.protocol == "file" else "probe/written-by-pbl-db-init"
    with store_errors():
        if create and backend.protocol == "s3" and not backend.fs.exists(bucket()):
            backend.fs.mkdir(bucket())
        backend.put_buffer(content, probe)
        found = backend.get_buffer(probe)
        if backend.protocol == "file":
            backend.remove(probe)
    if len(found) != len(content) or hashlib.sha256(found[:16]).digest() != found[16:]:
        raise store_error(OSError("an object came back with other bytes than were written"))


def files_below(backend: Any, folder: str = "") -> dict[str, dict[str, Any]]:
    """Return the files below a folder of the store (a path in it; default: all) with what the store knows of each.
    Raises `PblError` as `store_errors`."""
    with store_errors():
        base = full_path(backend, "")
        found = backend.fs.find(full_path(backend, folder), detail=True)
    return {str(path).removeprefix(base).lstrip("/"): about for path, about in found.items()}


def purge(fs: Any, folder: str) -> None:
    """Remove everything below a folder of a bucket (`bucket/path`), including older versions and unfinished uploads.
    Raises `PblError` as `store_errors`."""
    name, _, path = folder.partition("/")
    where = {"Bucket": name, "Prefix": f"{path.strip('/')}/"}
    with store_errors():
        while found := _kept(fs, where):
            for command, item in found:
                fs.call_s3(command, Bucket=name, **item)


def _kept(fs: Any, where: dict[str, str]) -> list[tuple[str, dict[str, str]]]:
    """Return the commands that remove the next thousand versions and the next thousand unfinished uploads."""
    versions = fs.call_s3("list_object_versions", **where)
    parts = fs.call_s3("list_multipart_uploads", **where)
    listed = [*versions.get("Versions", []), *versions.get("DeleteMarkers", [])]
    return [("delete_object", {k: item[k] for k in ("Key", "VersionId")}) for item in listed] + [
        ("abort_multipart_upload", {k: item[k] for k in ("Key", "UploadId")}) for item in parts.get("Uploads", [])
    ]


@contextmanager
def store_errors() -> Iterator[None]:
    """Raise errors of the store's client in the block as `PblError` STORE_UNAVAILABLE or STORE_FULL."""
    try:
        yield
    except PblError:
        raise
    except Exception as error:  # whatever layer of the client speaks, the reader needs the same advice
        raise store_error(error) from error


def unkept(error: OSError) -> PblError:
    """Return the coded error for a file that could not be read to be kept, or of which no copy could be written."""
    next_step = "check the path, and that you may read the file; else try again"
    of_path = error.errno in (errno.ENOENT, errno.EACCES, errno.ENOTDIR, errno.EISDIR)
    code, found = "FILE_MISSING" if of_path else "MACHINE_SHORT", error.strerror or str(error)
    return store_full(error) or PblError(code, found, "files to keep", next_step, error.filename)


def store_error(error: BaseException) -> PblError:
    """Return the coded error for an error of the store. The clients' messages hold no secret."""
    if (full := store_full(error)) is not None:
        return full.about(describe())
    return PblError(
        "STORE_UNAVAILABLE",
        key=describe(),
        found=f"{type(error).__name__}: {error}"[:500],
        expected="a store that keeps what is written to it",
        next_step="see that it runs and has space, and that PBL_S3_* name it, its bucket and a key that may write"
        if is_remote()
        else "see that its disk is there and works, and that you may write to the folder (PBL_STORE)",
    )


def _folder_error(folder: Path, found: str) -> PblError:
    about = f"the folder for arrays cannot be used: {found}", "a folder you may write to"
    return PblError("DB_REFUSED", *about, "set PBL_STORE (or PBL_HOME) to a folder of your own", key=folder)
