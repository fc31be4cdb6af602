"""A person's recordings outside the store: registered videos, the archive, the drop folder; for `pbl forget`."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline import temporary
from schemas import video
from schemas.intake.uploads import Bucket, Folder, Upload, drop_folder
from schemas.operations import archive
from schemas.operations.archive import archive_dir


def delete_registered(videos: Sequence[dict[str, Any]]) -> tuple[list[str], dict[str, str]]:
    """Delete videos that are unchanged since registration; return deleted paths, and path -> reason of those kept."""
    from pbl_pipeline.video import sha256_of

    gone, kept = [], {}
    for item in videos:
        path = Path(item["path"])
        if not os.path.lexists(path):
            continue
        if path.is_symlink() or not path.is_file():
            kept[str(path)] = "it is not a plain file"
        elif video.Video & {"video_path": str(path)}:
            kept[str(path)] = "another row names this path"
        elif path.stat().st_size != item["size"] or sha256_of(path) != item["sha256"]:
            kept[str(path)] = "it holds other bytes than were registered: another file took its place"
        else:
            try:
                path.unlink()
                gone.append(str(path))
            except OSError as error:
                kept[str(path)] = error.strerror or str(error)
    return gone, kept


def find_recordings(subject: str) -> list[str]:
    """Return the person's files in the archive, copies of a killed import included, and in the drop folder."""
    parts = ("", archive.REFUSED, archive.PHONE, archive.COPIES)
    return [str(p) for p in archive.of_person(archive_dir(), subject, parts)] + list(_uploads(_drop(), subject))


def _drop() -> Folder | Bucket | None:
    url = os.environ.get("PBL_INCOMING")
    return drop_folder(url) if url else None


def _uploads(drop: Folder | Bucket | None, subject: str) -> dict[str, Upload]:
    return {} if drop is None else {f"{drop.root}/{upload.name}": upload for upload in drop.uploads(subject)}


def delete_uploads(subject: str) -> list[str]:
    """Delete the person's uploads and their folders; return their paths."""
    gone, drop = [], _drop()
    if drop is None:
        return gone
    for name, upload in _uploads(drop, subject).items():
        with contextlib.suppress(OSError):  # what cannot be removed is found again, and named
            drop.remove(upload)
            gone.append(name)
    drop.remove_folders(subject)
    return gone


def delete_archived(subject: str) -> tuple[list[str], dict[str, str]]:
    """Delete the person's files in the archive; return deleted paths, and path -> reason of those kept."""
    gone, kept = [], {}
    for path in archive.of_person(archive_dir(), subject):
        if video.Video & {"video_path": str(path)}:  # a file that was moved here
            kept[str(path)] = "another row names this path"
            continue
        path.unlink(missing_ok=True)
        gone.append(str(path))
    archive.remove_folders(archive_dir(), subject)
    return gone, kept


def delete_left_over(subject: str) -> list[str]:
    """Remove the remains of killed processes; return those that may still hold something of the person."""
    archive.remove_copies(archive_dir(), subject)
    seen = archive.load_seen(archive_dir())
    others = {name: about for name, about in seen.items() if not name.startswith(f"{subject}/")}
    if others != seen:
        archive.save_seen(archive_dir(), others)
    return [f"{path}, of a process that was killed" for path in temporary.sweep()]
