"""Files that people name on the command line: read, or refused with a code before any work is done."""

from __future__ import annotations

import functools
import hashlib
import math
import os
import secrets
import shutil
import time
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.bounded import npz_fields, read_npz
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.names import is_plain

#: A shape; None stands for any length.
Shape = tuple[int | None, ...]
#: Endings of recordings.
VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi", ".3gp")
#: Largest width or height (px) of a picture that a file names.
_WIDEST_PX = 100_000
#: Free space (MB) below which no work is begun; the results of the demo take 3.
_ROOM_MB = 50
_unwritable = functools.partial(PblError, "FILE_UNWRITABLE", next_step="pass another place with --out")
_bad_field = functools.partial(PblError, "FILE_FORMAT", next_step="write the field as docs/files.md describes it")


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file as 64 hex digits, computed in pieces. Raises OSError."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def zipped(folder: Path, copy: Path, names: Iterable[str], how: int = zipfile.ZIP_STORED) -> Path:
    """Write files of a folder as a zip whose bytes depend on their names and contents only (packed: also on zlib).
    Raises OSError; `PblError` FILE_FORMAT for a name that is not UTF-8."""
    try:
        with zipfile.ZipFile(copy, "w") as archive:
            for name in sorted(names):
                member = zipfile.ZipInfo(name)
                member.compress_type = how
                with (folder / name).open("rb") as source, archive.open(member, "w") as target:
                    shutil.copyfileobj(source, target)
    except UnicodeEncodeError as error:
        found = f"a file named {ascii(error.object)[:80]}"
        raise PblError("FILE_FORMAT", found, "names of files in UTF-8", "rename it", folder) from error
    return copy


def load_npz(
    path: str | Path,
    fields: Collection[str] = (),
    needed: Collection[str] = (),
    next_step: str = "write the fields as docs/files.md describes them",
) -> dict[str, Any]:
    """Those of `fields` that an .npz file has, and all of `needed`. Reads no other array and never unpickles.

    Raises `PblError` FILE_MISSING: no such file, or it cannot be read. FILE_FORMAT: not an .npz, damaged, with pickled
    objects, more than `bounded.MAX_ARRAYS`, or without a field of `needed` (advice: `next_step`).
    """
    with _coded(path):
        data = read_npz(path, {*fields, *needed})
    if missing := [k for k in needed if k not in data]:
        expected = f"the fields {', '.join(needed)}"
        raise PblError("FILE_FORMAT", f"no {', '.join(missing)}", expected, next_step, path)
    return data


def fields_of(path: str | Path) -> frozenset[str]:
    """Names of the arrays of an .npz file; no array is read. Raises as `load_npz`."""
    with _coded(path):
        return frozenset(npz_fields(path))


@contextmanager
def one_process(path: Path, timeout_s: float = math.inf) -> Iterator[None]:
    """Let one process in at a time, by a lock of the file `path`; without file locks (Windows), all.

    Raises
    ------
    TimeoutError
        Another process holds the lock for longer than `timeout_s`.
    OSError
        The file cannot be opened.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    deadline = time.monotonic() + timeout_s
    with open(path, "a", encoding="utf-8", opener=lambda p, flags: os.open(p, flags | os.O_NOFOLLOW, 0o660)) as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise TimeoutError(f"{path} was locked for {timeout_s:.0f} s") from None
            time.sleep(0.05)
        yield


@contextmanager
def _coded(path: str | Path) -> Iterator[None]:
    with os_errors_as("FILE_MISSING", "an .npz file", "check the path, and that you may read the file", path):
        try:
            yield
        except ValueError as error:
            raise PblError(
                "FILE_FORMAT",
                found=f"no readable .npz file ({error})",
                expected="an .npz file without pickled objects, as docs/files.md describes it",
                next_step="make one with `pbl detect` or `pbl fit`, or copy it again",
                key=path,
            ) from error


def check_numbers(path: str | Path, data: Mapping[str, np.ndarray], shapes: Mapping[str, Shape]) -> None:
    """Compare fields of a file with the shapes they must have; all must hold numbers.

    Raises `PblError` FILE_FORMAT.
    """
    for name, shape in shapes.items():
        array = data[name]
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=False))
        if fits and array.dtype.kind in "fiub":
            continue
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        found = f"{name} has shape {array.shape} and type {array.dtype}"
        raise _bad_field(found, f"numbers of shape {wanted}", key=path)


def text_of(path: str | Path, data: Mapping[str, np.ndarray], name: str) -> str:
    """A field of a file that is one text. Raises `PblError` FILE_FORMAT."""
    if data[name].ndim == 0:
        return _texts(path, data, name)[0]
    raise _bad_field(f"{name}: shape {data[name].shape}", "one text", key=path)


def texts_of(path: str | Path, data: Mapping[str, np.ndarray], name: str) -> tuple[str, ...]:
    """A field of a file that is a list of texts, such as names. Raises `PblError` FILE_FORMAT."""
    if data[name].ndim == 1:
        return _texts(path, data, name)
    raise _bad_field(f"{name}: shape {data[name].shape}", "texts of shape (any)", key=path)


def _texts(path: str | Path, data: Mapping[str, np.ndarray], name: str) -> tuple[str, ...]:
    if data[name].size and data[name].dtype.kind != "U":
        raise _bad_field(f"{name}: type {data[name].dtype}", "text", key=path)
    texts = tuple(map(str, data[name].ravel()))
    if odd := next((t for t in texts if not is_plain(t)), None):
        expected = "texts of one line without control characters"
        raise _bad_field(f"{name}: {ascii(odd)[:80]}", expected, key=path)
    return texts


def picture_size(path: str | Path, size_px: np.ndarray) -> tuple[int, int]:
    """Width and height (px) of a picture from the field `image_size_px` of a file. Raises `PblError` FILE_FORMAT."""
    if np.all((size_px >= 1) & (size_px <= _WIDEST_PX)):  # False for NaN
        return int(size_px[0]), int(size_px[1])
    raise _bad_field(f"image_size_px {size_px.tolist()}", f"width and height in px, 1 to {_WIDEST_PX}", key=path)


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Yield a hidden name beside `path` to write to. The file appears as `path` when the block ends without error."""
    # Another thread may write the same file, and a name that can be guessed may be a link.
    part = path.with_name(f".part{secrets.token_hex(8)}-{path.name}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def check_no_link(top: Path, folder: Path) -> None:
    """Raise `PblError` FILE_UNWRITABLE if `folder` or one between it and `top` is a link, which leads elsewhere."""
    for path in (folder, *folder.parents):
        if path == top:
            return
        if path.is_symlink():
            raise _unwritable("a link", "a folder: nothing is written to where links lead", key=path)


def check_out_folder(path: Path, room_mb: int = _ROOM_MB) -> None:
    """Make sure that a folder for results exists or can be made, and has room; makes nothing. Raises `PblError`
    FILE_UNWRITABLE."""
    _check_place(path, path, room_mb)


def check_out_file(path: Path) -> None:
    """Make sure that a result can be written to `path`, and make its folder. Raises `PblError` FILE_UNWRITABLE."""
    if path.is_dir():
        raise _unwritable("a folder of that name", "the name of a file", key=path)
    if path.exists() and not os.access(path, os.W_OK):
        raise _unwritable("a file that you may not change", "a file you may write", key=path)
    _check_place(path.parent, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(error.strerror or str(error), "a folder you may write to", key=path) from error


def _check_place(folder: Path, about: Path, room_mb: int = _ROOM_MB) -> None:
    there = folder.absolute()
    while not os.path.exists(there) and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise _unwritable(f"{there} is not a folder", "a folder", key=about)
    if not os.access(there, os.W_OK | os.X_OK):
        raise _unwritable(f"you may not write to {there}", "a folder you may write to", key=about)
    if (free_mb := shutil.disk_usage(there).free / 1e6) < room_mb:
        raise _unwritable(f"{free_mb:.0f} MB are free on this disk", f"at least {room_mb} MB", key=about)
