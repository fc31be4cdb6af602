"""Files of a backup: listings with checksums; recordings, each at its own path below `recordings/`, and back."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError

#: Folders of a backup, each with a listing: files of the store, and registered videos.
RECORDINGS = "recordings"
PARTS = ("store", RECORDINGS)


def safe_path(path: str) -> PurePosixPath:
    """Return a path of the store, checked not to leave it. Raises BACKUP_INVALID."""
    parts = PurePosixPath(path)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or "\n" in path or "\\" in path:
        raise PblError(
            "BACKUP_INVALID",
            key=repr(path)[:200],
            found="a path that leaves the store",
            expected="a relative path without ..",
            next_step="the row was not written by this pipeline: find it and delete it",
        )
    return parts


def listed(folder: Path, part: str) -> Iterable[tuple[str, str]]:
    """Yield SHA-256 and path of the files of a part of a backup. Raises BACKUP_INVALID for a path that leaves it."""
    for line in (folder / f"{part}.sha256").read_text(encoding="utf-8").splitlines():
        sha, _, path = line.partition("  ")
        yield sha, str(safe_path(path))


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hex (light, unlike `pbl_pipeline.video`, which has the same for recordings)."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def unwritable(path: Path, error: OSError) -> PblError:
    """Return the error for a folder without room or rights."""
    return PblError(
        "FILE_UNWRITABLE",
        key=path,
        found=error.strerror or str(error),
        expected="a folder with room for the whole backup",
        next_step="free space, remove what was begun, and run it again",
    )


@dataclasses.dataclass
class Recordings:
    """Recordings that were copied."""

    paths: list[str] = dataclasses.field(default_factory=list)  # where they were registered
    n_bytes: int = 0
    left: dict[str, str] = dataclasses.field(default_factory=dict)  # path of one that was left out -> reason


def save_recordings(videos: Iterable[tuple[str, str]], folder: Path, previous: Path | None = None) -> Recordings:
    """Copy videos, given as (path, SHA-256), into a backup, and list them in `recordings.sha256`.

    Those that an earlier backup holds are linked, which takes no room. A video that is gone or changed is left out.

    Raises `PblError` FILE_UNWRITABLE: the backup.
    """
    done, before = Recordings(), set()
    if previous is not None and (previous / f"{RECORDINGS}.sha256").is_file():
        before = set(listed(previous, RECORDINGS))
    with (
        (folder / f"{RECORDINGS}.sha256").open("w", encoding="utf-8") as listing,
        progress.bar(RECORDINGS, unit="file") as update,
    ):
        for path, sha in videos:
            update(1)
            name = path.lstrip("/")
            target = folder / RECORDINGS / name
            old = previous / RECORDINGS / name if previous is not None and (sha, name) in before else None
            try:
                why = _save_recording(Path(path), sha, target, old)
            except OSError as error:
                raise unwritable(target, error) from error
            if why:
                done.left[path] = why
                continue
            listing.write(f"{sha}  {name}\n")
            done.paths.append(path)
            done.n_bytes += target.stat().st_size
    return done


def _save_recording(path: Path, sha: str, target: Path, old: Path | None) -> str:
    """Link or copy one recording; return the reason where it was left out, else ""."""
    try:
        safe_path(str(path).lstrip("/"))
        with path.open("rb"):
            pass
    except PblError as error:
        return error.found
    except OSError as error:
        return error.strerror or str(error)
    target.parent.mkdir(parents=True, exist_ok=True)
    if old is not None:
        with contextlib.suppress(OSError):  # another disk, or a file system without links
            os.link(old, target)
            return ""
    shutil.copyfile(path, target)
    if sha256_of(target) != sha:
        target.unlink()
        return "not the bytes that were registered"
    return ""


def restore_recordings(folder: Path) -> Recordings:
    """Copy the recordings of a backup back to where they were registered. A file that is there is never changed.

    Raises `PblError` FILE_UNWRITABLE.
    """
    done = Recordings()
    if not (folder / f"{RECORDINGS}.sha256").exists():
        return done
    for sha, name in listed(folder, RECORDINGS):
        path = Path("/") / name
        if path.exists():
            if sha256_of(path) != sha:
                done.left[str(path)] = "another file is there"
            continue
        try:
            with _private():
                path.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / RECORDINGS / name, part := path.with_name(f".{path.name}.part"))
                os.replace(part, path)
        except OSError as error:
            raise PblError(
                "FILE_UNWRITABLE",
                key=path,
                found=error.strerror or str(error),
                expected="the place where this recording was registered",
                next_step="make it writable, with room, then copy recordings/ of the backup there by hand (cp -n -r)",
            ) from error
        done.paths.append(str(path))
        done.n_bytes += path.stat().st_size
    return done


@contextlib.contextmanager
def _private() -> Iterator[None]:
    """Make new files and folders readable by their owner only."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)
