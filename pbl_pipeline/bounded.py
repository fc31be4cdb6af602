"""Bounded reading of untrusted files, whatever size they claim to have.

A small file can unpack to gigabytes, and a few bytes of text become large objects. Any file that is read here takes
less than 1 GiB of memory; `MAX_ARRAYS` takes the most, because callers copy the numbers once or twice.

All functions raise OSError if a file cannot be opened or read, and ValueError, with a message, if its content is
refused. The reader of each format adds the error code.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import io
import itertools
import json
import lzma
import math
import os
import re
import stat
import tomllib
import zipfile
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pbl_pipeline.errors import PblError, causes

MIB = 1 << 20
#: Bytes of a text (JSON, CSV, TRC, MOT), unpacked: an hour of a sensor at 100 Hz.
MAX_TEXT = 32 * MIB
#: Rows of a table: 83 minutes at 100 Hz. A row of one letter takes a hundred times its bytes.
MAX_ROWS = 500_000
#: Columns of a table, as many as a sheet of a workbook can have; and its cells, empty ones included.
MAX_COLUMNS, MAX_CELLS = 16_384, 2_000_000
#: From the first to the last time stamp of a recording (s), which is resampled to even grids.
MAX_SECONDS = 3600.0
#: Bytes of a TOML file, a hundred cameras: its reader takes the square of the number of a key's parts.
MAX_TOML = MIB // 32
#: Lists and objects of a JSON text, and how deeply they are nested.
MAX_CONTAINERS, MAX_DEPTH = 1_000_000, 32
#: Bytes of the arrays that are read from one .npz, each number counted as 8: 87 markers and 40 joints for 16 minutes at
#: 60 Hz.
MAX_ARRAYS = 256 * MIB
#: Least bytes of a text in an array as a Python object.
_STRING = 128
#: Bytes of an archive's directory: some ten thousand members.
_MAX_DIRECTORY = MIB
#: Bytes of an array's header, as NumPy's own limit.
_MAX_HEADER = 10_000
#: Digits of a number: all integers of 308 are finite floats.
_LONG_NUMBER = re.compile(r"\d{309}")
_LARGEST_INT = 10**308
#: A text in JSON, also one that does not end; brackets outside of such.
_JSON_TEXT, _BRACKETS = re.compile(r'"(?:[^"\\]|\\.?)*+"?', re.DOTALL), re.compile(r"[][{}]")
_HALF_LETTER = re.compile(r"\\u[dD][89a-fA-F]")

#: Numbers of errors in reading that say nothing about the file: a disk, a network or a limit of this machine failed.
_OF_MACHINE = (errno.EIO, errno.ESTALE, errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.ENOTCONN, errno.ETIMEDOUT)
#: Errors that readers of packed files raise for damaged ones; RuntimeError: for one with a password.
DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, RuntimeError, EOFError, gzip.BadGzipFile)


def read_bytes(path: str | Path, at_most: int) -> bytes:
    """The content of a regular file of up to `at_most` bytes, gzipped or not."""
    with _opened(path) as file:
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        least = at_most if packed else min(at_most, os.fstat(file.fileno()).st_size)
        try:
            data = (gzip.GzipFile(fileobj=file) if packed else file).read(least + 1)
        except DAMAGED as error:
            raise ValueError(f"damaged: {error}") from error
    if len(data) > at_most:
        raise ValueError(f"more than {_size(at_most)}")
    return data


def read_start(path: str | Path, n: int) -> bytes:
    """The first `n` bytes of a regular file, fewer of a shorter one."""
    with _opened(path) as file:
        return file.read(n)


def read_text(path: str | Path, at_most: int = MAX_TEXT) -> str:
    """The UTF-8 text of a file as `read_bytes` reads it."""
    return read_bytes(path, at_most).decode("utf-8-sig")


def read_json(path: str | Path) -> Any:
    """The content of a JSON file, as `parse_json` takes it."""
    return parse_json(read_text(path))


def read_toml(path: str | Path) -> dict[str, Any]:
    """The content of a TOML file of up to `MAX_TOML`; not nested beyond `MAX_DEPTH`, all integers fit a float."""
    try:
        content = tomllib.loads(read_text(path, MAX_TOML))
    except RecursionError as error:
        raise ValueError(f"nested more than {MAX_DEPTH} deep") from error
    for values in _levels(content):
        if any(isinstance(value, int) and abs(value) >= _LARGEST_INT for value in values):
            raise ValueError("a number of more than 308 digits")
    return content


def parse_json(text: str) -> Any:
    """The content of a JSON text; not nested beyond `MAX_DEPTH`, all integers fit a float, all texts are Unicode."""
    containers = text.count("[") + text.count("{")
    if containers > MAX_CONTAINERS:
        raise ValueError(f"more than {MAX_CONTAINERS:,} lists and objects")
    if _LONG_NUMBER.search(text):
        raise ValueError("a number of more than 308 digits")
    # Before the parser, which would nest its own calls to Python's limit, where the destructor of any object fails.
    if containers > MAX_DEPTH and _depth(text) > MAX_DEPTH:
        raise ValueError(f"nested more than {MAX_DEPTH} deep")
    content = json.loads(text)
    halves = _HALF_LETTER.search(text) is not None
    for values in _levels(content):
        if halves:
            for value in values:
                if isinstance(value, str) and not value.isascii():
                    value.encode()  # halves of a letter of UTF-16, which no file can hold: a ValueError
    return content


def _depth(text: str) -> int:
    """Return how deeply the lists and objects of a JSON text are nested."""
    brackets = _BRACKETS.findall(_JSON_TEXT.sub("", text))
    return max(itertools.accumulate(1 if b in "[{" else -1 for b in brackets), default=0)


def _levels(content: Any) -> Iterator[Iterator[Any]]:
    """Yield keys and values of each depth of nesting, one after the other. Raises ValueError beyond `MAX_DEPTH`."""
    level: list[Any] = [[content]]
    for _ in range(MAX_DEPTH + 1):
        if not level:
            return
        yield itertools.chain.from_iterable([*v, *v.values()] if isinstance(v, dict) else v for v in level)
        inner = (v.values() if isinstance(v, dict) else v for v in level)
        level = [v for values in inner for v in values if isinstance(v, (dict, list))]
    if level:
        raise ValueError(f"nested more than {MAX_DEPTH} deep")


def span_s(time_s: np.ndarray) -> float:
    """From the earliest to the latest of these time stamps that are finite (s), to compare with `MAX_SECONDS`."""
    known = np.asarray(time_s, np.float64)
    known = known[np.isfinite(known)]
    return float(np.ptp(known)) if known.size else 0.0


def count_rows(n: int) -> None:
    """Refuse a table of more than `MAX_ROWS` rows."""
    if n > MAX_ROWS:
        raise ValueError(f"more than {MAX_ROWS:,} rows")


def count_cells(n: int, columns: int = 0) -> None:
    """Refuse a table of more than `MAX_CELLS` cells or `MAX_COLUMNS` columns."""
    if columns > MAX_COLUMNS:
        raise ValueError(f"more than {MAX_COLUMNS:,} columns")
    if n > MAX_CELLS:
        raise ValueError(f"more than {MAX_CELLS:,} cells")


@contextlib.contextmanager
def opened_zip(path: str | Path, directory: int = _MAX_DIRECTORY) -> Iterator[zipfile.ZipFile]:
    """A zip archive to read members of (`read_member`), whose directory is small: of up to this many bytes."""
    with _opened(path) as file:
        _check_directory(file, directory)
        try:
            with zipfile.ZipFile(file) as archive:
                yield archive
        except (*DAMAGED, OSError) as error:  # OSError: places that no file has
            for seen in causes(error):  # `zipfile` hides one
                if getattr(seen, "errno", None) in _OF_MACHINE:
                    raise seen from None
            raise ValueError(f"no readable archive: {error}") from error


def read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, at_most: int) -> bytearray:
    """The content of a member of up to `at_most` bytes; call it within `opened_zip`."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename} is packed in another way than by deflate")
    if member.file_size > at_most:
        raise ValueError(f"{member.filename} has {_size(member.file_size)}, at most {_size(at_most)} are read")
    data = bytearray()
    with of_machine(archive.filename), archive.open(member) as file:
        while piece := file.read(MIB):
            data += piece
    if len(data) != member.file_size:
        raise ValueError(f"{member.filename} has {len(data)} bytes, the directory names {member.file_size}")
    return data


def _check_directory(file: BinaryIO, at_most: int) -> None:
    """The end of a zip archive (APPNOTE 4.3.16) names a small directory, before anything reads that."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 65557))  # the record and the longest comment
    end = file.read(65557)
    file.seek(0)
    at = end.rfind(b"PK\5\6")
    if at < 0 or at + 22 > len(end):
        raise ValueError("no zip archive, or one that is cut off")
    length = int.from_bytes(end[at + 12 : at + 16], "little")
    if length > at_most or b"PK\6\7" in end[max(0, at - 20) : at]:
        raise ValueError(f"an archive whose directory has more than {_size(at_most)}")


def npz_fields(path: str | Path) -> tuple[str, ...]:
    """Names of the arrays of an .npz file; no array is read."""
    with opened_zip(path) as archive:
        return tuple(m.filename.removesuffix(".npy") for m in archive.infolist())


def read_npz(path: str | Path, fields: Collection[str]) -> dict[str, np.ndarray]:
    """Those of `fields` that an .npz file has, up to `MAX_ARRAYS` together. Others are not unpacked, and nothing is
    unpickled."""
    arrays, room = {}, MAX_ARRAYS
    with opened_zip(path) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in fields:
                try:
                    arrays[name] = _array(read_member(archive, member, room), room)
                except ValueError as error:
                    raise ValueError(f"{name}: {error}") from error
                room -= _cost(arrays[name].size, arrays[name].dtype)
    return arrays


def _array(data: bytearray, room: int) -> np.ndarray:
    """An array of numbers or texts in the form of .npy, over `data`."""
    shape, fortran, dtype, start = _npy_header(data)
    count = math.prod(shape)
    if dtype.hasobject or dtype.kind not in "biufcSU" or not dtype.itemsize:
        raise ValueError(f"values of type {dtype}")
    if count * dtype.itemsize != len(data) - start:
        raise ValueError(f"{len(data) - start} bytes for shape {shape} of {dtype}")
    if _cost(count, dtype) > room:
        raise ValueError(f"shape {shape}: more than {_size(MAX_ARRAYS)} in all arrays of the file")
    return np.ndarray(shape, dtype, data, start, order="F" if fortran else "C")


def _npy_header(data: bytearray) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, order, type and the place where the values begin."""
    if data[:6] != b"\x93NUMPY" or data[6] not in (1, 2):
        raise ValueError("no array of .npy version 1 or 2")
    size = 2 if data[6] == 1 else 4
    start = 8 + size + int.from_bytes(data[8 : 8 + size], "little")
    if not 8 + size < start <= min(len(data), _MAX_HEADER):
        raise ValueError("a header that is cut off or too long")
    read = np.lib.format.read_array_header_1_0 if size == 2 else np.lib.format.read_array_header_2_0
    try:
        shape, fortran, dtype = read(io.BytesIO(bytes(data[8:start])))
    except Exception as error:  # NumPy parses it as Python source and raises anything
        raise ValueError(f"a header that makes no sense ({type(error).__name__})") from error
    if len(shape) > 8 or any(isinstance(n, bool) or n < 0 for n in shape) or max(shape, default=0) > MAX_ARRAYS:
        raise ValueError(f"shape {shape}"[:100])
    return shape, fortran, dtype, start


def _cost(count: int, dtype: np.dtype) -> int:
    """Bytes that so many values take once they are in use: numbers as float64, texts as Python's own."""
    return count * max(dtype.itemsize, 8 if dtype.kind in "biufc" else _STRING)


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[BinaryIO]:
    """A regular file; a pipe or device is refused and not waited for. Raises as `of_machine`."""
    opener = lambda p, flags: os.open(p, flags | getattr(os, "O_NONBLOCK", 0))  # noqa: E731
    with of_machine(path), open(path, "rb", opener=opener) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        yield file


@contextlib.contextmanager
def of_machine(path: str | Path | None) -> Iterator[None]:
    """Raise `PblError` FILE_MISSING for an error of the block that says nothing about the file."""
    try:
        yield
    except OSError as error:
        if error.errno not in _OF_MACHINE:
            raise
        found, next_step = error.strerror or str(error), "check disk, network and limits of this machine, and try again"
        raise PblError("FILE_MISSING", found, "a file that can be read to its end", next_step, path) from error


def _size(n: int) -> str:
    return f"{n / MIB:.3g} MiB"
