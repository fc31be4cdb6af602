"""Regular backups in one folder: each is complete by itself, and the oldest are removed."""

from __future__ import annotations

import datetime
import os
import re
import shutil
from pathlib import Path

from pbl_pipeline.errors import PblError
from pbl_schemas import connection, worker
from pbl_schemas.operations.backup import Backup, Say, backup

#: Names of the backups that are made here; nothing else in the folder is touched.
_NAME, _PATTERN = "%Y-%m-%dT%H%M%SZ", re.compile(r"\d{4}-\d\d-\d\dT\d{6}Z")


def backup_folder() -> Path:
    """PBL_BACKUP: where regular backups lie. Raises USAGE where it is not set."""
    value = os.environ.get("PBL_BACKUP")
    if not value:
        raise PblError(
            "USAGE",
            found="PBL_BACKUP is not set",
            expected="a folder of another disk, for backups of database, store and recordings",
            next_step="set it, or leave `pbl cron backup` out",
        )
    return Path(value).absolute()


def backup_regularly(root: Path, keep: int, say: Say = lambda _: None) -> Backup | None:
    """Save everything into a new folder of `root`, then remove all but the `keep` newest; None if another process
    is doing this.

    Recordings that the newest one has are linked: they take room once. The remains of an interrupted run are removed.

    Raises what `pbl_schemas.operations.backup.backup` raises; nothing is removed then.
    """
    with worker.installation_lock("backup", connection.connect()) as obtained:
        if not obtained:
            return None
        before = sorted(p for p in root.glob("*") if _PATTERN.fullmatch(p.name))
        whole = [p for p in before if (p / "manifest.json").is_file()]
        name = datetime.datetime.now(datetime.UTC).strftime(_NAME)
        made = backup(root / name, say=say, with_recordings=True, previous=whole[-1] if whole else None)
        for old in {*before} - {*[*whole, made.folder][-keep:]}:
            shutil.rmtree(old)
        return made
