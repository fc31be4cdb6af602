"""Folders whose content only their account may read; JSON files that are never half written; passwords from files."""

from __future__ import annotations

import contextlib
import json
import os
import struct
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError


def write_json(path: Path, content: dict[str, Any], mode: int = 0o600) -> None:
    """Write a JSON file as `write_text` does."""
    write_text(path, json.dumps(content, indent=1), mode)


def write_text(path: Path, text: str, mode: int = 0o600) -> None:
    """Write a file with these permissions: aside and renamed, so that no reader and no power cut leaves half of it.

    Raises
    ------
    OSError
        It cannot be written; the file that was there is unchanged.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with os.fdopen(os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "w", encoding="utf-8") as out:
            if hasattr(os, "fchmod"):  # not on Windows before Python 3.13
                os.fchmod(out.fileno(), mode)
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        aside.replace(path)
    except OSError:
        aside.unlink(missing_ok=True)
        raise


def secret(name: str) -> str | None:
    """Return the content of the file that `<name>_FILE` names, else of the variable `name`, else None.

    The file wins, and one line break at its end does not count. The secret appears in no error.

    Raises `PblError` FILE_MISSING when the file cannot be read; USAGE when it is empty.
    """
    file = os.environ.get(f"{name}_FILE")
    if not file:
        return os.environ.get(name)
    try:
        text = Path(file).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        # An OSError names the file; what is wrong with the bytes of another is not repeated, they are the secret.
        said = (error.strerror or "it cannot be read") if isinstance(error, OSError) else "it is not text in UTF-8"
        raise PblError(
            "FILE_MISSING",
            key=f"{name}_FILE={file}",
            found=said,
            expected="a file with the secret in it, readable by this account",
            next_step="mount the secret there, or correct the variable",
        ) from None
    text = text.removesuffix("\n").removesuffix("\r")
    if not text:
        raise PblError(
            "USAGE",
            key=f"{name}_FILE={file}",
            found="an empty file",
            expected="a file with the secret in it",
            next_step="write the secret into it",
        )
    return text


#: POSIX access control list (version 2, then tag, rights and no id of each entry) by which whatever is made in a folder
#: belongs to its owner alone: owner rwx, group and others nothing.
_OWNER_ONLY = struct.pack("<I", 2) + b"".join(
    struct.pack("<HHI", tag, rights, 0xFFFFFFFF) for tag, rights in ((0x01, 7), (0x04, 0), (0x20, 0))
)


def private_folder(path: Path) -> Path:
    """Make a folder (0700) as far as it is missing, in which new files are 0600 and new folders 0700 under any umask.

    A folder that is there is not changed: who made it decided who may read it.

    Raises
    ------
    OSError
        It cannot be made.
    """
    if not path.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        make_private(path)
    return path


def make_private(path: Path) -> None:
    """Make a folder 0700, and by default 0600 and 0700 what is made in it later.

    A default access control list, which takes the umask's place, does the latter on the file systems of Linux that
    have them; on others the folder's own mode keeps all others out.
    """
    path.chmod(0o700)
    if hasattr(os, "setxattr"):
        with contextlib.suppress(OSError):  # a file system without such lists
            os.setxattr(path, "system.posix_acl_default", _OWNER_ONLY)


def sync_folders(path: Path, root: Path) -> None:
    """Have the names in a folder, and in those above it up to `root`, on disk when this returns."""
    for folder in (path, *(p for p in path.parents if p.is_relative_to(root))):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_empty(folder: Path, levels: int) -> None:
    """Remove this folder and at most `levels - 1` above it, as far as they are empty."""
    for _ in range(max(levels, 0)):
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent
