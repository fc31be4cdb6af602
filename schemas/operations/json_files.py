"""Small files that must never be half written."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


def write_json(path: Path, content: dict[str, Any], mode: int = 0o600) -> None:
    """Write a JSON file as `write_text` does."""
    write_text(path, json.dumps(content, indent=1), mode)


def write_text(path: Path, text: str, mode: int = 0o600) -> None:
    """Write a file with these permissions: aside and renamed, so that no reader and no power cut leaves half of it.

    Raises
    ------
    OSError
        It cannot be written; the file that was there is unchanged.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with os.fdopen(os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "w", encoding="utf-8") as out:
            if hasattr(os, "fchmod"):  # not on Windows before Python 3.13
                os.fchmod(out.fileno(), mode)
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        aside.replace(path)
    except OSError:
        aside.unlink(missing_ok=True)
        raise
