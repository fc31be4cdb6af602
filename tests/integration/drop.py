"""Uploads for tests of the drop folder."""

import time
from pathlib import Path

from pbl_workers.incoming import Imports, import_uploads

from . import chain


def upload(drop: Path, where: str, name: str = "walk") -> Path:
    """A small video at a place of the drop folder; other bytes for other names."""
    path = drop / where
    path.parent.mkdir(parents=True, exist_ok=True)
    return chain.small_video(path.parent, name, n=60).rename(path)


def look(drop: Path, archive: Path, settled_s: float = 0.0) -> Imports:
    """One run of the import, which must not find another one."""
    taken = import_uploads(str(drop), archive, settled_s)
    assert taken is not None
    return taken


def twice(drop: Path, archive: Path) -> Imports:
    """The run that sees a file for the first time, and the one that may take it."""
    first = look(drop, archive, settled_s=0.05)
    assert not first.registered
    time.sleep(0.1)
    return look(drop, archive, settled_s=0.05)


def files(folder: Path) -> list[str]:
    """Files below a folder, without those of `.incoming`."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and ".incoming" not in p.parts)


def codes(taken: Imports) -> dict[str, str]:
    """Name -> code of what was refused."""
    return {name: error.code for name, error in taken.refused.items()}
