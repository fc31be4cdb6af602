"""Temporary folders of the whole product: named by their process, removed with it or by the next command.

They hold pictures and movements of patients. A process that is killed cannot remove its folders; every command and
worker calls `sweep` at its start, and `pbl forget` reports what cannot be removed.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
import time
from pathlib import Path

#: Names begin with this; the number of the process and a random word follow, because the processes of a container that
#: is started again have the same numbers.
_PREFIX, _OWN = "pbl-tmp-", secrets.token_hex(4)
#: Names of earlier versions. Those of the page have no number: they are removed when unchanged for so long (s).
_EARLIER, _UNCHANGED_S = ("pbl-files-", "pbl-web-"), 86_400.0


class TemporaryFolder(tempfile.TemporaryDirectory[str]):
    """A folder that is removed at the end of its `with` block, by `cleanup()`, or when no one holds the object."""

    def __init__(self, beside: Path | None, prefix: str) -> None:
        from multiprocessing.util import Finalize  # here: most commands make no folder

        super().__init__(dir=beside, prefix=prefix)
        # At the end of a forked process, in which Python runs `atexit` from 3.13 on.
        Finalize(self, shutil.rmtree, (self.name, True), exitpriority=0)

    @property
    def path(self) -> Path:
        return Path(self.name)

    def __enter__(self) -> Path:  # type: ignore[override]  # a path instead of its text
        return self.path


def new_folder(beside: Path | None = None) -> TemporaryFolder:
    """Return a new temporary folder.

    Parameters
    ----------
    beside
        Parent folder, on the disk that its files will be moved to; leftovers of killed processes there are removed.
        None: the system's folder for temporary files.
    """
    if beside is not None:
        sweep(beside)
    hidden = "." if beside is not None else ""
    return TemporaryFolder(beside, f"{hidden}{_PREFIX}{os.getpid()}-{_OWN}-")


def free_bytes() -> int:
    """Return the bytes that are free in the system's folder for temporary files."""
    return shutil.disk_usage(tempfile.gettempdir()).free


def private_folder(name: str) -> Path:
    """Return the folder `name` of this user among the temporary files, which no other user may enter. It stays.

    Raises
    ------
    OSError
        It cannot be made, or others may enter it.
    """
    folder = Path(tempfile.gettempdir()) / f"pbl-{name}-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise OSError(f"{folder} can be entered by other users")
    return folder


def sweep(beside: Path | None = None) -> list[Path]:
    """Remove the folders of processes that have ended; return those that this account may not remove."""
    left = []
    with contextlib.suppress(OSError), os.scandir(tempfile.gettempdir() if beside is None else beside) as entries:
        for path in [Path(e.path) for e in entries if not e.is_symlink()]:
            name = path.name.removeprefix(".")
            prefix = next((p for p in (_PREFIX, *_EARLIER) if name.startswith(p)), None)
            if prefix is None:
                continue
            pid, own, *_ = [*name.removeprefix(prefix).split("-"), ""]
            if _used(int(pid), own) if pid.isdecimal() else prefix == _PREFIX or not _unchanged(path):
                continue
            shutil.rmtree(path, ignore_errors=True)
            if path.exists():
                left.append(path)
    return left


def _unchanged(path: Path) -> bool:
    try:
        return time.time() - path.stat().st_mtime > _UNCHANGED_S
    except OSError:
        return False


def _used(pid: int, own: str) -> bool:
    return own == _OWN if pid == os.getpid() else _alive(pid)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # another account's
        pass
    return True
