"""Folders and switches of this machine. Environment variables override; nothing is read from the working directory."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs

from pbl_pipeline.errors import PblError

#: Ways to hide the heads in a recording (`pbl_pipeline.deidentify`).
DEIDENTIFY = ("blur", "pixelate", "skeleton")

#: Every environment variable the project reads, with its meaning (README lists them; a test compares).
VARIABLES: dict[str, str] = {
    "PBL_CACHE": "folder for fetched models, demo files and compiled programs (default: the user's cache folder)",
    "PBL_HOME": "folder for the embedded database and its object store (default: the user's data folder)",
    "PBL_CORES": "cores that a process uses (default: those that it is bound to or its container may use; `pbl worker` "
    "sets each process's share)",
    "PBL_OFFLINE": "1: never fetch anything, fail with the remedy instead",
    "PBL_DB_PREFIX": "prefix of the database schema names (default: pbl)",
    "PBL_MODELS": "folder of the registered keypoint models (default: models/ in PBL_HOME)",
    "PBL_ONNX_DEVICE": "where networks run (BlazePose, ONNX models): auto, cpu or cuda (default: auto, CUDA where it "
    "works)",
    "PBL_STORE": "folder of the object store that holds arrays (default: store/ in PBL_HOME)",
    "PBL_INCOMING": "folder or s3://BUCKET/PREFIX into which phones upload, for pbl cron import",
    "PBL_ARCHIVE": "folder in which uploaded recordings are kept (default: recordings/ in PBL_HOME)",
    "PBL_BACKUP": "folder of the regular backups (database, store, recordings), for pbl cron backup",
    "PBL_DEIDENTIFY": "blur, pixelate or skeleton: overlays and reports show recordings with hidden heads, and workers "
    "compute these (default: off)",
    "PBL_AUDIT_LOOKS": "1: each look at a recording in pbl web is a row of review.Viewing, and without it nothing is "
    "shown",
    "PBL_S3_ENDPOINT": "address of an object store (S3, MinIO) that holds arrays instead of a folder",
    "PBL_S3_BUCKET": "its bucket (default: pbl)",
    "PBL_S3_KEY": "its access key; or PBL_S3_KEY_FILE, a file with it",
    "PBL_S3_SECRET": "its secret key; or PBL_S3_SECRET_FILE, a file with it",
}


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


def audit_looks() -> bool:
    """True if each viewing of a recording in the review page has to leave a row."""
    return os.environ.get("PBL_AUDIT_LOOKS", "") not in ("", "0")


def offline() -> bool:
    """True if nothing may be fetched."""
    return os.environ.get("PBL_OFFLINE", "") not in ("", "0")
