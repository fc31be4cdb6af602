"""Folders with private content, JSON files that are written completely or not at all, passwords from files."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import struct
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError


def write_json(path: Path, content: dict[str, Any], mode: int = 0o600) -> None:
    """Write a JSON file as `write_text` does."""
    write_text(path, json.dumps(content, indent=1), mode)


def write_text(path: Path, content: str | bytes, mode: int = 0o600) -> None:
    """Write a file with these permissions, atomically: no reader, and no power cut, leaves half of it. Raises OSError
    if it cannot be written; the file that was there is unchanged."""
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")  # of this call: threads write the same file
    try:
        with os.fdopen(os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as out:
            if hasattr(os, "fchmod"):  # not on Windows before Python 3.13
                os.fchmod(out.fileno(), mode)
            out.write(content.encode() if isinstance(content, str) else content)
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
        # An OSError names the file; the bytes of an undecodable file are the secret and are not repeated.
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


#: POSIX access control list (version 2, then tag, rights and no id of each entry) that gives the owner alone access to
#: new content of a folder: owner rwx, group and others nothing.
_OWNER_ONLY = struct.pack("<I", 2) + b"".join(
    struct.pack("<HHI", tag, rights, 0xFFFFFFFF) for tag, rights in ((0x01, 7), (0x04, 0), (0x20, 0))
)


def private_folder(path: Path) -> Path:
    """Make a missing folder (0700), in which new files are 0600 and new folders 0700 under any umask.

    An existing folder is not changed: its maker decided who may read it.

    Raises OSError if it cannot be made.
    """
    if not path.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700, exist_ok=True)
        make_private(path)
    return path


def make_private(path: Path) -> None:
    """Make a folder 0700, and by default its later files 0600 and folders 0700.

    A default access control list, which replaces the umask, does the latter on Linux file systems that support it; on
    others the folder's own mode keeps all others out.
    """
    path.chmod(0o700)
    if hasattr(os, "setxattr"):
        with contextlib.suppress(OSError):  # a file system without such lists
            os.setxattr(path, "system.posix_acl_default", _OWNER_ONLY)


def sync_folders(path: Path, root: Path) -> None:
    """Flush the names in a folder, and in those above it up to `root`, to disk."""
    for folder in (path, *(p for p in path.parents if p.is_relative_to(root))):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_empty(folder: Path, levels: int) -> None:
    """Remove this folder and at most `levels - 1` above it while they are empty."""
    for _ in range(max(levels, 0)):
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent
