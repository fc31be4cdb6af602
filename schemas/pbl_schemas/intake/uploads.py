"""The drop folder: uploads of phones, in a folder of this machine or under a prefix of an object store.

Its content is not trusted: people who upload decide which files it holds and when they change. A folder is therefore
read through handles, no link is followed, and only a regular file of the account that owns the drop folder is opened.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import fsspec

from pbl_pipeline.errors import PblError, os_errors_as

from ..operations.folders import secret
from ..store import purge, store_errors

#: Endings of sensor logs.
LOG_ENDINGS = (".csv", ".json", ".zip")
#: Largest recording and log that are accepted (bytes).
LARGEST, LARGEST_LOG = 20 * 10**9, 4 * 10**8
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
#: O_NONBLOCK: a file that became a pipe since it was listed does not wait for its writer.
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class StillChanging(Exception):
    """A file that changed since it was listed."""


@dataclasses.dataclass(frozen=True, slots=True)
class Upload:
    """An entry of the drop folder."""

    name: PurePosixPath  # below the drop folder
    size: int = 0  # bytes
    stamp: str = ""  # changes with the content
    file: bool = True  # False for a folder, or a name that leads elsewhere


def incoming_url() -> str:
    """Return the upload target of phones: PBL_INCOMING, a folder or s3://BUCKET/PREFIX. Raises USAGE if it is not
    set."""
    value = os.environ.get("PBL_INCOMING")
    if not value:
        expected = "the folder or s3://BUCKET/PREFIX into which recordings are uploaded, as SUBJECT/SESSION/FILE"
        raise PblError("USAGE", "PBL_INCOMING is not set", expected, "set it, or leave `pbl cron import` out")
    return value


def drop_folder(url: str) -> Folder | Bucket:
    """Return the drop folder at a path or URL. Raises `PblError` FILE_MISSING unless it is a folder."""
    return Bucket(url) if "://" in url else Folder(Path(url).absolute())


class Folder:
    """A drop folder of this machine. Files lie three levels deep; deeper ones are not read."""

    def __init__(self, root: Path) -> None:
        self.root = root
        with (
            os_errors_as(
                "FILE_MISSING",
                "the folder into which recordings are uploaded",
                "create it, or correct PBL_INCOMING",
                root,
            ),
            self._open(()) as handle,
        ):
            self.owner = os.fstat(handle).st_uid

    def uploads(self, subject: str | None = None) -> Iterator[Upload]:
        """Yield all entries, or those of one person: every entry of the third level, and above it those that are not
        folders."""
        yield from self._below((subject,) if subject else ())

    def _below(self, parts: tuple[str, ...]) -> Iterator[Upload]:
        try:
            with self._open(parts) as handle, os.scandir(handle) as entries:
                for entry in entries:
                    name = (*parts, entry.name)
                    is_folder = entry.is_dir(follow_symlinks=False)
                    if is_folder and len(name) < 3:
                        yield from self._below(name)
                        continue
                    about = entry.stat(follow_symlinks=False)
                    yield Upload(PurePosixPath(*name), about.st_size, _stamp(about), not is_folder)
        except OSError as error:
            if not parts:
                raise
            if error.errno != errno.ENOENT:  # a folder that may not be entered, or is no longer one
                yield Upload(PurePosixPath(*parts), file=False)

    @contextlib.contextmanager
    def open(self, upload: Upload) -> Iterator[BinaryIO]:
        """Open a file for reading. Raises `PblError` UPLOAD_REFUSED: it is not a regular file of the folder's owner, or
        too large; StillChanging: the file is not the one that was listed."""
        with contextlib.ExitStack() as stack:
            try:
                handle = stack.enter_context(self._open(upload.name.parts[:-1]))
                self._check(upload, os.stat(upload.name.name, dir_fd=handle, follow_symlinks=False), handle)
                file = os.open(upload.name.name, _FILE, dir_fd=handle)
            except PermissionError as error:
                raise _refused(upload, "a file that may not be read") from error
            except (FileNotFoundError, NotADirectoryError) as error:
                raise StillChanging from error
            source = stack.enter_context(open(file, "rb"))
            self._check(upload, os.fstat(file), handle)
            yield source

    def _check(self, upload: Upload, about: os.stat_result, folder: int) -> None:
        mode = about.st_mode
        if stat.S_ISLNK(mode):
            raise _refused(upload, f"a symbolic link to {os.readlink(upload.name.name, dir_fd=folder)}")
        if not stat.S_ISREG(mode):
            kinds = ((stat.S_ISFIFO, "a named pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISDIR, "a folder"))
            raise _refused(upload, next((what for is_it, what in kinds if is_it(mode)), "a device"))
        if about.st_uid != self.owner:
            raise _refused(
                upload,
                f"a file of account {about.st_uid}; the drop folder belongs to {self.owner}",
                "upload with the account that owns the drop folder, or make the account that uploads its owner",
            )
        if about.st_nlink != 1:
            raise _refused(upload, f"a file with {about.st_nlink} names (hard links)")
        _check_size(upload, about.st_size)
        if (about.st_size, _stamp(about)) != (upload.size, upload.stamp):
            raise StillChanging

    def unchanged(self, upload: Upload) -> bool:
        """Return whether the file is unchanged."""
        try:
            with self._open(upload.name.parts[:-1]) as handle:
                about = os.stat(upload.name.name, dir_fd=handle, follow_symlinks=False)
        except FileNotFoundError:
            return False
        return (about.st_size, _stamp(about)) == (upload.size, upload.stamp)

    def remove(self, upload: Upload) -> None:
        """Remove a file, unless another one replaced it meanwhile. Raises OSError."""
        if self.unchanged(upload):
            with self._open(upload.name.parts[:-1]) as handle:
                os.unlink(upload.name.name, dir_fd=handle)

    def remove_folders(self, subject: str) -> None:
        """Remove the folders of one person as far as they are empty."""
        with contextlib.suppress(OSError), self._open((subject,)) as handle:
            for session in os.listdir(handle):
                with contextlib.suppress(OSError):
                    os.rmdir(session, dir_fd=handle)
            with self._open(()) as root:
                os.rmdir(subject, dir_fd=root)

    def move(self, upload: Upload, to: Path) -> None:
        """Move a file out of the drop folder without opening it. An entry that is not a regular file, or has another
        name, is removed. Raises OSError if it cannot be moved (another disk, no right)."""
        with self._open(upload.name.parts[:-1]) as handle:
            about = os.stat(upload.name.name, dir_fd=handle, follow_symlinks=False)
            if stat.S_ISREG(about.st_mode) and about.st_nlink == 1:
                os.rename(upload.name.name, to, src_dir_fd=handle)
                with contextlib.suppress(OSError):  # it may belong to another account; the folder is closed to others
                    to.chmod(0o600)
            elif not stat.S_ISDIR(about.st_mode):
                os.unlink(upload.name.name, dir_fd=handle)

    @contextlib.contextmanager
    def _open(self, parts: tuple[str, ...]) -> Iterator[int]:
        """Yield a handle of a folder below the drop folder; no link is followed on the way."""
        handle = os.open(self.root, _FOLDER)
        try:
            for part in parts:
                below = os.open(part, _FOLDER | os.O_NOFOLLOW, dir_fd=handle)
                os.close(handle)
                handle = below
            yield handle
        finally:
            os.close(handle)


class Bucket:
    """A drop folder under a prefix of an object store, s3://BUCKET/PREFIX. Raises `PblError` STORE_UNAVAILABLE."""

    def __init__(self, url: str) -> None:
        endpoint = os.environ.get("PBL_S3_ENDPOINT")
        login: dict[str, Any] = {"key": secret("PBL_S3_KEY"), "secret": secret("PBL_S3_SECRET")}
        login |= {"client_kwargs": {"endpoint_url": endpoint}} if endpoint else {}
        with store_errors():
            fs, root = fsspec.core.url_to_fs(url, **(login if url.startswith("s3://") else {}))
        self.fs, self.root = fs, str(root).rstrip("/")

    def uploads(self, subject: str | None = None) -> Iterator[Upload]:
        """Yield every object below the prefix, or in the folder of one person."""
        with store_errors():
            self.fs.invalidate_cache()
            found = self.fs.find(f"{self.root}/{subject}" if subject else self.root, detail=True)
        for path, about in found.items():
            name = PurePosixPath(str(path).removeprefix(self.root).lstrip("/"))
            # A key with empty parts or dots differs from its name.
            yield Upload(name, int(about["size"] or 0), _object_stamp(about), self._path(name) == str(path))

    @contextlib.contextmanager
    def open(self, upload: Upload) -> Iterator[BinaryIO]:
        """Open an object for reading. Raises `PblError` UPLOAD_REFUSED (too large), OSError."""
        _check_size(upload, upload.size)
        with self.fs.open(self._path(upload.name), "rb") as source:
            yield source

    def unchanged(self, upload: Upload) -> bool:
        """Return whether the object is unchanged."""
        self.fs.invalidate_cache()
        try:
            about = self.fs.info(self._path(upload.name))
        except FileNotFoundError:
            return False
        return (int(about["size"] or 0), _object_stamp(about)) == (upload.size, upload.stamp)

    def remove(self, upload: Upload) -> None:
        """Remove an object, unless another one replaced it meanwhile. Raises OSError."""
        if self.unchanged(upload):
            self.fs.rm(self._path(upload.name))

    def remove_folders(self, subject: str) -> None:
        """Remove older versions that the object store keeps; it has no folders."""
        if self.fs.protocol[0] == "s3":
            purge(self.fs, f"{self.root}/{subject}")

    def move(self, upload: Upload, to: Path) -> None:
        """Raise OSError: an object that is not read stays where it is."""
        raise OSError(errno.EXDEV, "it stays in the object store", str(to))

    def _path(self, name: PurePosixPath) -> str:
        return f"{self.root}/{name}"


def _stamp(about: os.stat_result) -> str:
    return f"{about.st_mtime_ns}-{about.st_ino}"


def _object_stamp(about: dict[str, Any]) -> str:
    return str(about.get("LastModified") or about.get("mtime") or "")


def _check_size(upload: Upload, size: int) -> None:
    most = LARGEST_LOG if upload.name.suffix.lower() in LOG_ENDINGS else LARGEST
    if size > most:
        raise _refused(upload, f"a file of {size / 1e9:.1f} GB", f"upload what is smaller than {most / 1e9:g} GB")


def _refused(upload: Upload, found: str, next_step: str = "upload the recording itself") -> PblError:
    return PblError(
        "UPLOAD_REFUSED",
        key=upload.name,
        found=found,
        expected="a regular file of the drop folder's owner, with one name and not too large",
        next_step=next_step,
    )
