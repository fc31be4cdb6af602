"""Version and commit of the code that computed a result, such as `0.2.0+g8589a11c2f4e`."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

#: Written into a wheel by `hatch_build.py`; a checkout has none, and git is asked.
COMMIT_FILE = Path(__file__).with_name("_commit.txt")
#: Folders of a checkout whose uncommitted changes make it `.dirty`.
PACKAGES = ("pbl_pipeline", "schemas", "workers")
_ROOT = Path(__file__).resolve().parents[1]


@functools.cache
def code_version() -> str:
    """Version and commit of the running code, followed by `.dirty` if files differ from the commit; the version alone
    if neither a checkout nor the wheel states a commit. Found once per process."""
    from pbl_pipeline import (
        __version__,  # not above: `hatch_build.py` loads this file where the package is not installed
    )

    commit = built_commit(COMMIT_FILE) or checked_out_commit(_ROOT)
    return f"{__version__}+g{commit}" if commit else __version__


def built_commit(file: Path) -> str:
    """The commit that a wheel was built from, "" if it is not stated."""
    return file.read_text(encoding="utf-8").strip() if file.is_file() else ""


def checked_out_commit(root: Path) -> str:
    """12 digits of the commit of a checkout, with `.dirty` if the packages have changed or new files; "" if the folder
    is not a checkout or git is not installed."""
    if not (root / ".git").exists():  # not a repository further up, such as one that holds a virtual environment
        return ""
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    changed = commit and _git(root, "status", "--porcelain", "--", *PACKAGES)
    return f"{commit}.dirty" if changed else commit


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
