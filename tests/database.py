"""Homes of private database servers for tests."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from schemas import embedded


def new_home() -> Path:
    """A fresh folder for PBL_HOME. Not pytest's own: those are closed to the account root's server runs as."""
    home = Path(tempfile.mkdtemp(prefix="pbl-test-"))
    home.chmod(0o755)
    return home


def remove_home(home: Path) -> None:
    """Stop the server of this home, if any, and delete everything."""
    embedded.remove(embedded.Folder(home / "db"))
    shutil.rmtree(home, ignore_errors=True)
