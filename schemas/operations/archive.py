"""The archive of uploaded recordings: where everything lies in it, and what of a person.

    SUBJECT/SESSION/HASH-FILE    registered recordings, with the logs beside them
    _refused/SUBJECT/HASH-FILE   what could not be registered, with its reason in HASH-FILE.txt
    _phone/SUBJECT/NUMBER/       parts of a recording that a phone sends, until it is registered
    .incoming/SUBJECT/           copies that are being made; while no import runs, the remains of a killed one
    .incoming/seen.json          what lay in the drop folder when it was last listed

SUBJECT is `_` for what was uploaded under a name that is not a code.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from pbl_pipeline import settings

from ..subject_codes import SUBJECT_CODE
from .folders import private_folder, remove_empty, write_json

#: Name of the installation-wide lock that whoever changes the archive holds (`worker.alone`).
LOCK = "incoming"
REFUSED, COPIES, PHONE = "_refused", ".incoming", "_phone"
_SEEN = "seen.json"


def archive_dir() -> Path:
    """Where recordings are kept: PBL_ARCHIVE (default: recordings/ in PBL_HOME)."""
    return Path(os.environ.get("PBL_ARCHIVE") or settings.home_dir() / "recordings").absolute()


def folder_of(archive: Path, part: str, subject: str) -> Path:
    """The folder of a person in a part of the archive ("", `REFUSED`, `PHONE`, `COPIES`); made if missing.

    Raises
    ------
    OSError
        It cannot be made.
    """
    private_folder(archive)
    return private_folder(private_folder(archive / part) / (subject if SUBJECT_CODE.fullmatch(subject) else "_"))


def of_person(archive: Path, subject: str, parts: tuple[str, ...] = ("", REFUSED, PHONE)) -> list[Path]:
    """All files in the folders of a person, by default without `COPIES`; links are listed, not followed."""
    folders = [archive / part / subject for part in parts]
    return sorted(
        path
        for folder in folders
        if not folder.is_symlink()
        for path in folder.rglob("*")
        if path.is_symlink() or not path.is_dir()
    )


def remove_folders(archive: Path, subject: str) -> None:
    """Remove the folders of a person as far as they are empty."""
    for part in ("", REFUSED, PHONE):
        folder = archive / part / subject
        for path in (*sorted(folder.rglob("*"), reverse=True), folder):
            remove_empty(path, 1)


def remove_copies(archive: Path, subject: str | None = None) -> None:
    """Remove copies that a killed import left, of one person or of all; for the holder of the lock."""
    kept = archive / COPIES
    for path in [kept / subject] if subject else sorted(kept.glob("*")):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _SEEN:
            path.unlink(missing_ok=True)


def load_seen(archive: Path) -> dict[str, list[Any]]:
    """What `save_seen` wrote; empty where there is nothing to read."""
    try:
        return dict(json.loads((archive / COPIES / _SEEN).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def save_seen(archive: Path, seen: dict[str, list[Any]]) -> None:
    """Write which files lay in the drop folder: name -> size, stamp, time when they were first seen so (s).

    Raises
    ------
    OSError
        It cannot be written.
    """
    private_folder(archive)
    write_json(private_folder(archive / COPIES) / _SEEN, seen)


def plain_name(text: str) -> str:
    """A name for a file or folder of ours from one that came from outside: ASCII, no separator, no leading dot."""
    kept = "".join(c if c.isascii() and (c.isalnum() or c in "-_. ") else "_" for c in text).lstrip(". ").rstrip()
    return kept[-100:] or "_"
