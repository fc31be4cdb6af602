"""Passwords and keys from files (`NAME_FILE`, as containers mount them) or from the variable `NAME`."""

from __future__ import annotations

import os
from pathlib import Path

from pbl_pipeline.errors import PblError


def secret(name: str) -> str | None:
    """Return the content of the file that `<name>_FILE` names, else of the variable `name`, else None.

    The file wins, and one line break at its end does not count. The secret appears in no error.

    Raises `PblError` FILE_MISSING when the file cannot be read; USAGE when it is empty.
    """
    file = os.environ.get(f"{name}_FILE")
    if not file:
        return os.environ.get(name)
    try:
        text = Path(file).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        # An OSError names the file; what is wrong with the bytes of another is not repeated, they are the secret.
        said = (error.strerror or "it cannot be read") if isinstance(error, OSError) else "it is not text in UTF-8"
        raise PblError(
            "FILE_MISSING",
            key=f"{name}_FILE={file}",
            found=said,
            expected="a file with the secret in it, readable by this account",
            next_step="mount the secret there, or correct the variable",
        ) from None
    text = text.removesuffix("\n").removesuffix("\r")
    if not text:
        raise PblError(
            "USAGE",
            key=f"{name}_FILE={file}",
            found="an empty file",
            expected="a file with the secret in it",
            next_step="write the secret into it",
        )
    return text
