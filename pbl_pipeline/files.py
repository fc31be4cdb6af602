"""Files that people name on the command line: read, or refused with a code before any work is done."""

from __future__ import annotations

import lzma
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError

#: What the readers of zip archives raise for a damaged one; RuntimeError: one with a password, or packed in a way that
#: is not known.
DAMAGED_ZIP = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, RuntimeError)
#: A shape; None stands for any length.
Shape = tuple[int | None, ...]


def load_npz(path: str | Path) -> dict[str, Any]:
    """All arrays of an .npz file. Never unpickles.

    Raises
    ------
    PblError
        FILE_MISSING: no such file, or it cannot be read. FILE_FORMAT: not an .npz, damaged, or with pickled objects.
    """
    try:
        with np.load(path, allow_pickle=False) as f:
            return {k: f[k] for k in f.files}
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError) as error:
        raise PblError(
            "FILE_MISSING",
            found=error.strerror or str(error),
            expected="an .npz file",
            next_step="check the path, and that you may read the file",
            key=str(path),
        ) from error
    # A plain .npy gives an array, which is no context manager (TypeError); the rest is what damage looks like.
    except (OSError, ValueError, EOFError, TypeError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise PblError(
            "FILE_FORMAT",
            found=f"no readable .npz file ({type(error).__name__})",
            expected="an .npz file without pickled objects, as docs/files.md describes it",
            next_step="make one with `pbl detect` or `pbl fit`, or copy it again",
            key=str(path),
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
        raise PblError(
            "FILE_FORMAT",
            found=f"{name} has shape {array.shape} and type {array.dtype}",
            expected=f"numbers of shape {wanted}",
            next_step="write the field as docs/files.md describes it",
            key=str(path),
        )


def check_out_folder(path: Path) -> None:
    """Make sure that a folder for results exists or can be made; makes nothing. Raises `PblError` FILE_UNWRITABLE."""
    _check_place(path, path)


def check_out_file(path: Path) -> None:
    """Make sure that a result can be written to `path`, and make its folder. Raises `PblError` FILE_UNWRITABLE."""
    if path.is_dir():
        raise _unwritable(path, "a folder of that name", "the name of a file")
    if path.exists() and not os.access(path, os.W_OK):
        raise _unwritable(path, "a file that you may not change", "a file you may write")
    _check_place(path.parent, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error), "a folder you may write to") from error


def _check_place(folder: Path, about: Path) -> None:
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise _unwritable(about, f"{there} is not a folder", "a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise _unwritable(about, f"you may not write to {there}", "a folder you may write to")


def _unwritable(path: Path, found: str, expected: str) -> PblError:
    return PblError(
        "FILE_UNWRITABLE", found=found, expected=expected, next_step="pass another place with --out", key=str(path)
    )
