"""Registered models of this machine: a folder with the name of each, in `settings.models_dir()`.

A method of the tables stores the name of a model and the SHA-256 of its graph and of its spec, so a folder that changed
is refused.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import http.client
import os
import shutil
import tarfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from pbl_pipeline import progress, settings
from pbl_pipeline.bounded import DAMAGED, opened_zip
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.temporary import new_folder

from .onnx_model import OnnxModel, check_graph_file
from .spec import GRAPH_FILE, SPEC_FILE, ModelSpec, load_spec, model_invalid

_TIMEOUT_S = 60.0
_CHUNK = 1 << 20
#: Files of a model that are kept; the graph has at most the size of one ONNX file.
_MEMBERS = (GRAPH_FILE, SPEC_FILE, "LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "NOTICE", "README.md")
_LARGEST = 2 << 30
_missing = functools.partial(
    PblError, "MODEL_MISSING", expected=f"a folder or archive with {GRAPH_FILE} and {SPEC_FILE}"
)


@contextlib.contextmanager
def unpacked(source: str | Path, sha256: str | None) -> Iterator[Path]:
    """Folder of a model; a temporary one if `source` is an archive or an address. Raises as `add`."""
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
        raise _missing(
            "PBL_OFFLINE forbids fetching", next_step="copy the archive here and add it as a file", key=address
        )
    path = into / "archive"
    try:
        request = urllib.request.Request(address, headers={"User-Agent": "pbl-pipeline"})  # noqa: S310 - http(s) only
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer, path.open("wb") as file:  # noqa: S310
            total = int(answer.headers.get("Content-Length") or 0)
            with progress.bar("fetching the model", total=round(total / 1e6), unit="MB") as update:
                _copy(answer, file, address, update)
    except (OSError, urllib.error.URLError, http.client.HTTPException, ValueError) as error:
        raise _missing(
            str(getattr(error, "reason", error)), next_step="check the address and the connection", key=address
        ) from error
    return path


def _copy(answer: IO[bytes], file: IO[bytes], address: str, update) -> None:
    come = drawn = 0
    while chunk := answer.read(_CHUNK):
        file.write(chunk)
        come += len(chunk)
        if come > _LARGEST:
            raise _missing("more than 2 GB", next_step="check the address: a model's archive is smaller", key=address)
        update(round(come / 1e6) - drawn)
        drawn = round(come / 1e6)


def _check(archive: Path, sha256: str | None, source: str) -> None:
    try:
        with archive.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise _missing(error.strerror or str(error), next_step="check the path", key=source) from error
    if sha256 and found != sha256.strip().lower():
        raise PblError(
            "MODEL_CHECKSUM",
            found=f"SHA-256 {found}",
            expected=f"SHA-256 {sha256.strip().lower()}",
            next_step="fetch it again; if it stays so, it is not the file whose checksum you have",
            key=source,
        )


def _extract(archive: Path, folder: Path, source: str) -> None:
    """Extract the model's files, which are all in one folder of the archive."""
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
                raise model_invalid(f"{len(specs)} files {SPEC_FILE} in the archive", "one", key=source)
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
            f"not a readable archive ({what})", f"a folder with {SPEC_FILE}, or its archive", key=source
        ) from error


@dataclasses.dataclass(frozen=True)
class ModelStatus:
    """A registered model, with its `spec` or the `error` of a damaged one."""

    name: str
    folder: Path
    spec: ModelSpec | None
    error: PblError | None


def registered() -> list[ModelStatus]:
    """List the registered models by name, with their errors; checks the bytes of the graphs."""
    folder = settings.models_dir()
    if not os.path.isdir(folder):  # `Path.is_dir` raises where a parent may not be entered
        return []
    names = sorted(p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    return [_status(name, folder / name) for name in names]


def is_registered(name: str) -> bool:
    """True if a model of that name is registered here, damaged or not."""
    return "/" not in name and not name.startswith(".") and os.path.isfile(settings.models_dir() / name / SPEC_FILE)


def find(name: str) -> Path:
    """Folder of a registered model. Raises `PblError` MODEL_MISSING."""
    if not is_registered(name):
        there = [m.name for m in registered()]
        raise PblError(
            "MODEL_MISSING",
            found=f"no registered model {name!r}",
            expected=f"one of {', '.join(there)}" if there else "a registered model; none is registered here",
            next_step="`pbl models add FOLDER_OR_URL` on this machine, or set PBL_MODELS to the folder that holds it",
            key=name,
        )
    return settings.models_dir() / name


def add(source: str | Path, sha256: str | None = None, *, replace: bool = False) -> tuple[ModelSpec, OnnxModel]:
    """Register a model from its folder, or from an archive (.zip, .tar, .tar.gz) in a file or at an http(s) address.

    `sha256` is that of the archive, and must be given for an address. The model is loaded and run once on the CPU
    before anything is stored. Registering the same bytes again changes nothing.

    Raises `PblError` MODEL_MISSING (also if it cannot be fetched), MODEL_INVALID, MODEL_CHECKSUM, MARKER_SET_UNKNOWN;
    USAGE if another model has the name and `replace` is not set, or an address is given without `sha256`;
    FILE_UNWRITABLE.
    """
    with unpacked(source, sha256) as folder:
        model = OnnxModel(folder, "cpu")
        spec = model.spec
        there = settings.models_dir() / spec.name
        if there.exists() and not _same(there, spec) and not replace:
            raise PblError(
                "USAGE",
                found=f"another model is registered as {spec.name}",
                expected="a different name for each model",
                next_step="change the name in the new one's model.json, or pass --replace: results made with the old "
                "one stay, but methods that use it fail until it is added again",
                key=str(source),
            )
        with os_errors_as(
            "FILE_UNWRITABLE",
            f"a folder of models that you may write to ({there.parent})",
            "set PBL_MODELS to one of your folders",
            there,
        ):
            there.parent.mkdir(parents=True, exist_ok=True)
            with _scratch(there.parent) as new:
                for name in _MEMBERS:
                    if (folder / name).is_file():
                        shutil.copyfile(folder / name, new / name)
                with _scratch(there.parent) as old:
                    if there.exists():  # moved in one step, so that no process reads half of it
                        os.replace(there, old / "model")
                    os.replace(new, there)
    return load_spec(there), model


def remove(name: str) -> Path:
    """Delete a registered model's folder and return its path. Raises `PblError` MODEL_MISSING, FILE_UNWRITABLE."""
    folder = find(name)
    with os_errors_as(
        "FILE_UNWRITABLE", "a folder of models that you may change", "ask the owner of the folder", folder
    ):
        shutil.rmtree(folder)
    return folder


def _status(name: str, folder: Path) -> ModelStatus:
    try:
        spec = load_spec(folder)
        check_graph_file(folder, spec)
    except PblError as error:
        return ModelStatus(name, folder, None, error)
    return ModelStatus(name, folder, spec, None)


def _same(folder: Path, spec: ModelSpec) -> bool:
    try:
        known = load_spec(folder)
    except PblError:
        return False
    return (known.sha256, known.spec_sha256) == (spec.sha256, spec.spec_sha256)


@contextlib.contextmanager
def _scratch(beside: Path) -> Iterator[Path]:
    """A folder on the same disk, so that the finished one appears whole or not at all."""
    with new_folder(beside) as folder:
        folder.chmod(0o755)  # readable for the account a worker runs under
        yield folder
