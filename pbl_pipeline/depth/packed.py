"""Files of a depth recording: in a folder, or in a zip, as the tables keep it and as Record3D writes it."""

from __future__ import annotations

import contextlib
import os
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from pbl_pipeline import bounded
from pbl_pipeline.errors import said
from pbl_pipeline.files import sha256_of, zipped
from pbl_pipeline.temporary import new_folder

from .recording import depth_error

#: What is read of a folder.
_READ = re.compile(r"((depth|confidence)/)?[^/]+\.(png|npy)|(odometry|camera_matrix|depth_matrix)\.csv", re.IGNORECASE)
#: Bytes of an archive's directory: 65,535 members, which is all that one can have.
_DIRECTORY = 8 * bounded.MIB
#: Bytes that a zip has before each file, beside its name.
_HEADER = 30
#: Function from a file's path in a folder or a zip, and its most bytes, to its content. It raises OSError, ValueError,
#: KeyError and `bounded.DAMAGED`.
Get = Callable[[str, int], bytes]


def names_in(path: Path) -> list[str]:
    """Return the paths of the files in a folder or a zip. Raises OSError, ValueError as `bounded`."""
    if path.is_dir():
        with bounded.of_machine(path):
            found = (*path.glob("*"), *path.glob("*/*"))
            return sorted(f.relative_to(path).as_posix() for f in found if f.is_file())
    with bounded.opened_zip(path, _DIRECTORY) as archive:
        return sorted(_members(archive))


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Get]:
    """Open a folder or a zip."""
    if path.is_dir():
        yield lambda name, most: bounded.read_bytes(path / name, most)
        return
    with bounded.opened_zip(path, _DIRECTORY) as archive:
        members = _members(archive)
        yield lambda name, most: bytes(bounded.read_member(archive, members[name], most))


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Members by their paths in the folder that was packed: below the only folder on top, as Finder and Explorer do."""
    found = [m for m in archive.infolist() if not m.is_dir() and not m.filename.startswith("__MACOSX/")]
    tops = {m.filename[: m.filename.find("/") + 1] for m in found}
    top = tops.pop() if len(tops) == 1 else ""
    return {m.filename.removeprefix(top): m for m in found}


def pack(folder: Path, copy: Path) -> Path:
    """Write what is read of a folder as a zip, without its colour video. Raises OSError; `PblError` DEPTH_FILE for
    more than `names_in` reads of a zip."""
    names = _read_of(folder)
    size = sum((folder / name).stat().st_size + _HEADER + len(os.fsencode(name)) for name in names)
    if len(names) > zipfile.ZIP_FILECOUNT_LIMIT or size > zipfile.ZIP64_LIMIT:
        raise depth_error(
            said("{n} files of {gib:.2f} GiB", n=len(names), gib=size / 2**30),
            f"up to {zipfile.ZIP_FILECOUNT_LIMIT:,} files and 2 GiB, which the tables keep",
            next_step="cut video and recording into parts, or make the pictures smaller",
            key=folder,
        )
    return zipped(folder, copy, names)


def _read_of(folder: Path) -> list[str]:
    return [name for name in names_in(folder) if _READ.fullmatch(name)]


def sha256_of_recording(path: Path) -> str:
    """SHA-256 of a file, or of the zip of a folder, of any size (`pack`)."""
    if path.is_file():
        return sha256_of(path)
    with new_folder() as folder:
        return sha256_of(zipped(path, folder / "copy.zip", _read_of(path)))
