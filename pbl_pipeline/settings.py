"""Folders and switches of this machine. Environment variables override; nothing is read from the working directory."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs

from pbl_pipeline.errors import PblError

#: Ways to hide the heads in a recording (`pbl_pipeline.deidentify`).
DEIDENTIFY = ("blur", "pixelate", "skeleton")


def cache_dir() -> Path:
    """The user's cache folder for PBL, created when absent."""
    path = Path(os.environ.get("PBL_CACHE") or platformdirs.user_cache_dir("pbl"))
    path.mkdir(parents=True, exist_ok=True)
    return path


def home_dir() -> Path:
    """Folder of the embedded database and the object store (not created here: its owner decides permissions)."""
    value = os.environ.get("PBL_HOME")
    if value:
        return Path(value).absolute()
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        # The database server never runs as root, and the account it drops to cannot look into root's home.
        return Path("/var/lib/pbl")
    return Path(platformdirs.user_data_dir("pbl"))


def store_dir() -> Path:
    """Folder of the object store that holds the arrays (not created here)."""
    return Path(os.environ.get("PBL_STORE") or home_dir() / "store").absolute()


def models_dir() -> Path:
    """Folder of the registered keypoint models (not created here). Not the cache: a lab's model has no other copy."""
    return Path(os.environ.get("PBL_MODELS") or home_dir() / "models").absolute()


def deidentify_how() -> str:
    """The way heads are hidden in overlays and reports: "blur", "pixelate", "skeleton", or "" for not at all.

    Raises `PblError` USAGE for another word: a misspelling must not show faces.
    """
    how = os.environ.get("PBL_DEIDENTIFY", "").strip().lower()
    if how not in ("", *DEIDENTIFY):
        raise PblError(
            "USAGE",
            found=f"PBL_DEIDENTIFY={how!r}",
            expected=f"one of {', '.join(DEIDENTIFY)}, or nothing",
            next_step="correct the environment variable",
        )
    return how


def letter_head() -> list[str]:
    """Lines at the head of a letter: name and address of the clinic. Empty if none are set."""
    return [line.strip() for line in os.environ.get("PBL_LETTER_HEAD", "").split(";") if line.strip()]


def audit_looks() -> bool:
    """True if each viewing of a recording in the review page has to leave a row."""
    return os.environ.get("PBL_AUDIT_LOOKS", "") not in ("", "0")


def offline() -> bool:
    """True if nothing may be fetched."""
    return os.environ.get("PBL_OFFLINE", "") not in ("", "0")
