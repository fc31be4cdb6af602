"""Layout of the archive of uploaded recordings, and the files of a person in it.

    SUBJECT/SESSION/HASH-FILE    registered recordings, with their logs
    _refused/SUBJECT/HASH-FILE   refused uploads, with the reason in HASH-FILE.txt
    _phone/SUBJECT/NUMBER/       parts of a recording that a phone sends, until it is registered
    _phone/SUBJECT/FILE.placed   note of a recording that lies in its place, SESSION/FILE, until it has a row
    .incoming/SUBJECT/           copies in progress; while no import runs, the remains of a killed one
    .incoming/seen.json          content of the drop folder when it was last listed

SUBJECT is `_` for uploads under a name that is not a code.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import shutil
import time
from pathlib import Path
from typing import Any, NamedTuple

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError

from .. import video
from ..subject_codes import SUBJECT_CODE
from .folders import private_folder, remove_empty, sync_folders, write_json, write_text

#: Name of the installation-wide lock that every process holds while it changes the archive
#: (`worker.installation_lock`).
LOCK = "incoming"
REFUSED, COPIES, PHONE = "_refused", ".incoming", "_phone"
#: Age at which the parts of a recording that did not go on are removed (days).
UNFINISHED_DAYS = 7.0
_SEEN, _PLACED = "seen.json", ".placed"


def archive_dir() -> Path:
    """Return the folder of the recordings: PBL_ARCHIVE (default: recordings/ in PBL_HOME)."""
    return Path(os.environ.get("PBL_ARCHIVE") or settings.home_dir() / "recordings").absolute()


def busy(next_step: str, key: object = None) -> PblError:
    """The error of who finds `LOCK` taken."""
    found = "recordings of the drop folder are being taken over"
    return PblError("DB_REFUSED", found=found, expected="one import at a time", next_step=next_step, key=key)


def disks() -> list[tuple[str, float, float]]:
    """Name, free and total GB of each disk that holds the database, the arrays, the recordings or the backups."""
    out, seen = [], set()
    places = {"home": settings.home_dir(), "store": settings.store_dir(), "archive": archive_dir()}
    if backups := os.environ.get("PBL_BACKUP"):
        places["backup"] = Path(backups).absolute()
    for name, path in places.items():
        there = next(p for p in (path, *path.parents) if p.exists())
        device = there.stat().st_dev
        if device not in seen:
            seen.add(device)
            usage = shutil.disk_usage(there)
            out.append((f"{name} ({path})", usage.free / 1e9, usage.total / 1e9))
    return out


def folder_of(archive: Path, part: str, subject: str) -> Path:
    """Return the folder of a person in a part of the archive ("", `REFUSED`, `PHONE`, `COPIES`); made if missing.
    Raises OSError if it cannot be made."""
    private_folder(archive)
    return private_folder(private_folder(archive / part) / (subject if SUBJECT_CODE.fullmatch(subject) else "_"))


def files_of_person(archive: Path, subject: str, parts: tuple[str, ...] = ("", REFUSED, PHONE)) -> list[Path]:
    """Return all files in the folders of a person, by default without `COPIES`; links are listed, not followed."""
    folders = [archive / part / subject for part in parts]
    return sorted(
        path
        for folder in folders
        if not folder.is_symlink()
        for path in folder.rglob("*")
        if path.is_symlink() or not path.is_dir()
    )


class Unfinished(NamedTuple):
    """Parts of a recording that is not registered: their folder or file, length (byte), and the time of the last
    one."""

    path: Path
    n_bytes: int
    last_s: float


def note_placed(archive: Path, target: Path) -> Path:
    """Write, before a recording is put into its place, where that is; return the note, to be removed once it has a row.
    A killed process leaves it to `remove_unfinished`."""
    subject = target.parent.parent.name
    note = folder_of(archive, PHONE, subject) / f"{target.name}{_PLACED}"
    write_text(note, os.fsencode(f"{target.parent.name}/{target.name}"))
    sync_folders(note.parent, archive)
    return note


def has_row(target: Path) -> bool:
    """Return whether a recording in its place of the archive is registered, under whatever name of the archive."""
    rows = video.Video.connection.query(
        f"SELECT video_path FROM {video.Video.full_table_name} WHERE SUBSTRING_INDEX(video_path, '/', -1) = %s",  # noqa: S608
        args=(target.name,),
    )
    return any(Path(path).parts[-3:] == target.parts[-3:] for (path,) in rows.fetchall())


def _placed(archive: Path, note: Path) -> tuple[Path, list[Path]]:
    """Return the place of a note's recording; and it and its sensor log, as far as they are there and not another
    recording's; of a note of another place, only itself."""
    own = archive / note.parent.name
    where = Path(os.fsdecode(note.read_bytes()))
    target = own / where
    if target.parent.parent != own or ".." in where.parts:
        return note, []
    beside = [p for p in target.parent.glob(f"{glob.escape(target.stem)}.*") if p.stem == target.stem and p != target]
    logs = [] if any(has_row(p) or (note.parent / f"{p.name}{_PLACED}").exists() for p in beside) else beside
    return target, [path for path in (target, *logs) if path.is_file()]


def _begun(archive: Path) -> list[Path]:
    with contextlib.suppress(PermissionError):
        return list((archive / PHONE).glob("*/*"))
    return []


def unfinished(archive: Path, parts_alone: bool = False) -> list[Unfinished]:
    """Return what phones and browsers have begun to send, and, unless `parts_alone`, recordings in their place of which
    a process was killed before they had a row, for which tables are read; while other processes write and remove it.
    What this account may not see is left out."""
    out = []
    for path in _begun(archive):
        with contextlib.suppress(FileNotFoundError, PermissionError):
            own, placed = path.stat(), path.suffix == _PLACED
            if placed and parts_alone:
                continue
            parts = _placed(archive, path)[1] if placed else path.iterdir() if path.is_dir() else (path,)
            files = [f.stat() for f in parts]
            last_s = max([own.st_mtime, *(f.st_mtime for f in files if not placed)])
            out.append(Unfinished(path, sum(f.st_size for f in files), last_s))
    return out


def remove_unfinished(archive: Path, days: float = UNFINISHED_DAYS) -> list[Unfinished]:
    """Remove and return what did not go on for so long; the phone keeps its recording, and sends it again. For the
    holder of the lock."""
    old = [one for one in unfinished(archive) if one.last_s < time.time() - 86_400 * days]
    for one in old:
        if one.path.suffix == _PLACED:
            target, files = _placed(archive, one.path)
            for path in () if has_row(target) else files:
                path.unlink(missing_ok=True)
            remove_empty(target.parent, 2)
        shutil.rmtree(one.path, ignore_errors=True) if one.path.is_dir() else one.path.unlink(missing_ok=True)
        remove_empty(one.path.parent, 1)
    return old


def remove_folders(archive: Path, subject: str) -> None:
    """Remove the empty folders of a person."""
    for part in ("", REFUSED, PHONE):
        folder = archive / part / subject
        for path in (*sorted(folder.rglob("*"), reverse=True), folder):
            remove_empty(path, 1)


def remove_copies(archive: Path, subject: str | None = None) -> None:
    """Remove copies of a killed import, of one person or of all; only for the holder of the lock."""
    kept = archive / COPIES
    for path in [kept / subject] if subject else sorted(kept.glob("*")):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _SEEN:
            path.unlink(missing_ok=True)


def load_seen(archive: Path) -> dict[str, list[Any]]:
    """Return what `save_seen` wrote; empty if there is no such file."""
    try:
        return dict(json.loads((archive / COPIES / _SEEN).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def save_seen(archive: Path, seen: dict[str, list[Any]]) -> None:
    """Write the files of the drop folder: name -> size, stamp, time when it was first seen like this (s). Raises
    OSError if it cannot be written."""
    private_folder(archive)
    write_json(private_folder(archive / COPIES) / _SEEN, seen)


def plain_name(text: str) -> str:
    """Return a safe name of a file or folder for an external one: ASCII, no separator, no leading dot."""
    kept = "".join(c if c.isascii() and (c.isalnum() or c in "-_. ") else "_" for c in text).lstrip(". ").rstrip()
    return kept[-100:] or "_"
