"""A model's folder from wherever it comes: a folder, an archive, an address. Nothing of an archive is run."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import tarfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from pbl_pipeline import progress, settings
from pbl_pipeline.bounded import DAMAGED, opened_zip
from pbl_pipeline.errors import PblError
from pbl_pipeline.temporary import new_folder

from .spec import GRAPH_FILE, SPEC_FILE, model_invalid

_TIMEOUT_S = 60.0
_CHUNK = 1 << 20
#: Only these leave an archive; the graph is at most what one ONNX file may be.
_MEMBERS = (GRAPH_FILE, SPEC_FILE, "LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "NOTICE", "README.md")
_LARGEST = 2 << 30


@contextlib.contextmanager
def unpacked(source: str | Path, sha256: str | None) -> Iterator[Path]:
    """The folder of a model; a temporary one where `source` is an archive or an address. Raises as `add`."""
    text = str(source)
    address = text.lower().startswith(("http://", "https://"))
    if not address and Path(source).is_dir():
        yield Path(source)
        return
    if address and not sha256:
        raise PblError(
            "USAGE",
            found="an address without a checksum",
            expected="the SHA-256 of the archive, as its publisher states it",
            next_step="pass --sha256",
            key=text,
        )
    with new_folder() as temporary:
        archive = _download(text, temporary) if address else Path(source)
        _check(archive, sha256, text)
        folder = temporary / "model"
        folder.mkdir()
        _extract(archive, folder, text)
        yield folder


def _download(address: str, into: Path) -> Path:
    if settings.offline():
        raise _missing(address, "PBL_OFFLINE forbids fetching", "copy the archive here and add it as a file")
    path = into / "archive"
    try:
        request = urllib.request.Request(address, headers={"User-Agent": "pbl-pipeline"})  # noqa: S310 - http(s) only
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer, path.open("wb") as file:  # noqa: S310
            total = int(answer.headers.get("Content-Length") or 0)
            with progress.bar("fetching the model", total=round(total / 1e6), unit="MB") as update:
                _copy(answer, file, address, update)
    except (OSError, urllib.error.URLError, http.client.HTTPException, ValueError) as error:
        raise _missing(address, str(getattr(error, "reason", error)), "check the address and the connection") from error
    return path


def _copy(answer: IO[bytes], file: IO[bytes], address: str, update) -> None:
    come = drawn = 0
    while chunk := answer.read(_CHUNK):
        file.write(chunk)
        come += len(chunk)
        if come > _LARGEST:
            raise _missing(address, "more than 2 GB", "check the address: a model's archive is smaller")
        update(round(come / 1e6) - drawn)
        drawn = round(come / 1e6)


def _check(archive: Path, sha256: str | None, source: str) -> None:
    try:
        with archive.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise _missing(source, error.strerror or str(error), "check the path") from error
    if sha256 and found != sha256.strip().lower():
        raise PblError(
            "MODEL_CHECKSUM",
            found=f"SHA-256 {found}",
            expected=f"SHA-256 {sha256.strip().lower()}",
            next_step="fetch it again; if it stays so, it is not the file whose checksum you have",
            key=source,
        )


def _extract(archive: Path, folder: Path, source: str) -> None:
    """Take the model's files out, whatever folder they lie in; one folder only."""
    found: dict[str, tuple[str, int]] = {}
    try:
        with contextlib.ExitStack() as stack:
            if zipfile.is_zipfile(archive):
                packed = stack.enter_context(opened_zip(archive))
                members = [(i.filename, i.file_size) for i in packed.infolist() if not i.is_dir()]
                opened = packed.open
            else:
                tar = stack.enter_context(tarfile.open(archive))
                members = [(m.name, m.size) for m in tar.getmembers() if m.isfile()]
                opened = tar.extractfile
            specs = [n for n, _ in members if PurePosixPath(n).name == SPEC_FILE]
            if len(specs) != 1:
                raise model_invalid(source, f"{len(specs)} files {SPEC_FILE} in the archive", "one")
            home = PurePosixPath(specs[0]).parent
            for name, size in members:
                path = PurePosixPath(name)
                if path.parent == home and path.name in _MEMBERS and size <= _LARGEST:
                    found[path.name] = (name, size)
            for plain, (name, _) in found.items():
                data = opened(name)
                if data is not None:
                    with data, (folder / plain).open("wb") as file:
                        while chunk := data.read(_CHUNK):
                            file.write(chunk)
    except (*DAMAGED, tarfile.TarError, ValueError, OSError) as error:
        what = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise model_invalid(
            source, f"no readable archive ({what})", f"a folder with {SPEC_FILE}, or its archive"
        ) from error


def _missing(source: str, found: str, next_step: str) -> PblError:
    return PblError(
        "MODEL_MISSING",
        found=found,
        expected=f"a folder or archive with {GRAPH_FILE} and {SPEC_FILE}",
        next_step=next_step,
        key=source,
    )
