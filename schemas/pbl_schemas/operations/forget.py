"""Remove a person: every row, every queued job, every stored file, and write a list that proves it.

Recordings (in the archive, the drop folder and where they were registered) are deleted on request only; copies and
temporary files of killed processes in any case.

The columns of a row identify its person: a subject's code, or the number of a session, video or set of videos of that
person. Every table that depends on a person has one of them (a test checks all foreign keys). So do the queues, which
have no foreign keys; DataJoint's cascading delete reaches neither queues nor files.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from pbl_pipeline import progress, settings, temporary
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.files import sha256_of
from pbl_schemas import connection, fit, lab, session, video, worker
from pbl_schemas.datajoint_setup import RightMissing, full_path
from pbl_schemas.intake.uploads import Bucket, Folder, Upload, drop_folder
from pbl_schemas.operations import archive
from pbl_schemas.operations.archive import archive_dir
from pbl_schemas.operations.folders import remove_empty, write_json
from pbl_schemas.rows import delete_below, inside
from pbl_schemas.store import files_below, purge, store_errors
from pbl_schemas.subject_codes import check_subject

from . import catalog
from .catalog import Column, quote


def delete_registered(videos: Sequence[dict[str, Any]]) -> tuple[list[str], dict[str, str]]:
    """Delete videos that are unchanged since registration; return deleted paths, and path -> reason of those kept."""
    from pbl_pipeline.video import check_file

    gone, kept = [], {}
    for item in videos:
        path = Path(item["path"])
        if not os.path.lexists(path):
            continue
        if path.is_symlink() or not path.is_file():
            kept[str(path)] = "it is not a plain file"
        elif video.Video & {"video_path": str(path)}:
            kept[str(path)] = "another row names this path"
        elif path.stat().st_size != item["size"] or sha256_of(check_file(path)) != item["sha256"]:
            kept[str(path)] = "it holds other bytes than were registered: another file took its place"
        else:
            try:
                path.unlink()
                gone.append(str(path))
            except OSError as error:
                kept[str(path)] = error.strerror or str(error)
    return gone, kept


def _drop() -> Folder | Bucket | None:
    url = os.environ.get("PBL_INCOMING")
    return drop_folder(url) if url else None


def _uploads(drop: Folder | Bucket | None, subject: str) -> dict[str, Upload]:
    return {} if drop is None else {f"{drop.root}/{upload.name}": upload for upload in drop.uploads(subject)}


def delete_uploads(subject: str) -> list[str]:
    """Delete the person's uploads and their folders; return their paths."""
    gone, drop = [], _drop()
    if drop is None:
        return gone
    for name, upload in _uploads(drop, subject).items():
        with contextlib.suppress(OSError):  # a file that cannot be removed is found again, and named
            drop.remove(upload)
            gone.append(name)
    drop.remove_folders(subject)
    return gone


def delete_archived(subject: str) -> tuple[list[str], dict[str, str]]:
    """Delete the person's files in the archive; return deleted paths, and path -> reason of those kept."""
    gone, kept = [], {}
    for path in archive.files_of_person(archive_dir(), subject):
        if video.Video & {"video_path": str(path)}:  # a file that was moved here
            kept[str(path)] = "another row names this path"
            continue
        path.unlink(missing_ok=True)
        gone.append(str(path))
    archive.remove_folders(archive_dir(), subject)
    return gone, kept


def delete_left_over(subject: str) -> list[str]:
    """Remove the remains of killed processes; return those that may still hold something of the person."""
    archive.remove_copies(archive_dir(), subject)
    seen = archive.load_seen(archive_dir())
    others = {name: about for name, about in seen.items() if not name.startswith(f"{subject}/")}
    if others != seen:
        archive.save_seen(archive_dir(), others)
    return [f"{path}, of a process that was killed" for path in temporary.sweep()]


#: Columns that identify the person of a row. `fit_set` is a hash over one session's videos.
IDENTITIES = ("subject", "session_id", "video_id", "fit_set")

Say = Callable[[str], None]
Ids = dict[str, list[Any]]


@dataclasses.dataclass(frozen=True)
class Found:
    """All that is stored of a person."""

    rows: dict[str, int]  # table -> number of rows
    files: list[str]  # paths in the store, including files without a row
    videos: list[dict[str, Any]]  # path, SHA-256 and size of the registered video files
    running: list[str]  # jobs that a worker is computing
    recordings: list[str]  # in the archive and, where PBL_INCOMING is set, in the drop folder

    @property
    def nothing(self) -> bool:
        """True when there is no row and no stored file."""
        return not self.rows and not self.files


@dataclasses.dataclass(frozen=True)
class Forgotten:
    """The outcome of a removal."""

    manifest: Path
    rows: dict[str, int]  # table -> number of rows removed
    files: list[str]  # removed from the store
    videos: list[str]  # deleted recordings
    kept: dict[str, str]  # path of a recording that remains -> reason
    left: list[str]  # places that still name the person; empty if none does


def manifest_path(subject: str) -> Path:
    """Return the path of the list: `PBL_HOME/forgotten/<subject>.json`. Raises USAGE for an invalid code."""
    check_subject(subject, "check the code")
    return settings.home_dir() / "forgotten" / f"{subject}.json"


def find(subject: str) -> tuple[Ids, Found]:
    """Return all that is stored of a person; change nothing. Raises `PblError` DB_NOT_FOUND when neither the database
    nor a list of an earlier run knows the subject."""
    ids, earlier = _identities(subject), read_manifest(subject)
    parts = ("", archive.REFUSED, archive.PHONE, archive.COPIES)  # copies are of a killed import
    recordings = [str(p) for p in archive.files_of_person(archive_dir(), subject, parts)] + list(
        _uploads(_drop(), subject)
    )
    if not lab.Subject & {"subject": subject} and not earlier and not recordings:
        raise PblError(
            "DB_NOT_FOUND",
            key=subject,
            found="no such subject",
            expected="the code of a subject",
            next_step="the codes are in `pbl_schemas.lab.Subject`; they are case-sensitive",
        )
    owners = {"session_id": session.Session, "video_id": video.Video, "fit_set": fit.FitSet}
    for name, values in earlier.get("ids", {}).items():
        # In a rebuilt database numbers of an earlier run may be another person's.
        free = [v for v in values if name not in owners or not owners[name] & {name: v}]
        ids[name] = list(dict.fromkeys([*ids[name], *free]))
    return ids, _find(ids, earlier, recordings)


def forget(subject: str, videos: bool = False, say: Say = lambda _: None) -> Forgotten:
    """Remove a person. An interrupted run can be repeated: the list of files is written before a row is deleted.

    Raises `PblError` DB_NOT_FOUND; DB_REFUSED while a worker computes something of this person or uploads are taken
    over, or without the right to delete; STORE_UNAVAILABLE.

    `videos`: also delete the video files that are unchanged since registration.
    """
    try:
        with worker.installation_lock(archive.LOCK, connection.connect()) as obtained:
            if not obtained:
                raise archive.busy("repeat this when it has ended", subject)  # else a recording may appear afterwards
            return _forget(subject, videos, say)
    except RightMissing as error:  # the account that may also remove the files of the store
        raise RightMissing(error.found, "owner") from error


def _forget(subject: str, videos: bool, say: Say) -> Forgotten:
    ids, found = find(subject)
    if found.running:
        busy = f"{len(found.running)} computations are running: {'; '.join(found.running[:5])}"
        next_step = "wait for their end, or stop those workers (pbl cron release frees dead ones); then repeat"
        raise PblError("DB_REFUSED", busy, "none, so that no result appears after it was deleted", next_step, subject)
    manifest = {**read_manifest(subject), "subject": subject, "ids": ids, "state": "begun"}
    manifest["files"] = sorted({*manifest.get("files", []), *found.files})
    manifest["videos"] = found.videos
    manifest["rows"] = {**manifest.get("rows", {}), **found.rows}
    manifest.setdefault("begun", _now())
    _write(subject, manifest)
    say(f"The list of what goes is in {manifest_path(subject)}")
    _delete_rows(subject, ids, say)
    _delete_files(found.files, ids, say)
    gone, kept = [], {}
    left = delete_left_over(subject)
    if videos:
        gone, kept = delete_registered(found.videos)
        more, named = delete_archived(subject)
        gone, kept = gone + more + delete_uploads(subject), kept | named
    _, after = find(subject)
    if not videos:
        there = [v["path"] for v in found.videos if os.path.lexists(v["path"])]
        kept = dict.fromkeys(there + after.recordings, "not asked for")
    left += [f"{n} rows of {table}" for table, n in after.rows.items()] + after.files
    left += _mentions(subject, found.videos)
    left += [path for path in after.recordings if path not in kept]
    manifest.update(state="left over" if left else "done", ended=_now(), kept=kept, left=left)
    manifest["videos_deleted"] = sorted({*manifest.get("videos_deleted", []), *gone})
    _write(subject, manifest)
    return Forgotten(
        manifest_path(subject), manifest["rows"], manifest["files"], manifest["videos_deleted"], kept, left
    )


# ---------------------------------------------------------------------------------------------------------- finding
def _identities(subject: str) -> Ids:
    sessions = [int(s) for s in (session.Session & {"subject": subject}).to_arrays("session_id")]
    of_sessions = [{"session_id": s} for s in sessions]
    videos = (video.Video & of_sessions).to_arrays("video_id") if sessions else []
    sets = (fit.FitSet & of_sessions).to_arrays("fit_set") if sessions else []
    return {
        "subject": [subject],
        "session_id": sessions,
        "video_id": [int(v) for v in videos],
        "fit_set": [str(s) for s in sets],
    }


def _find(ids: Ids, earlier: dict[str, Any], recordings: list[str]) -> Found:
    conn = connection.connect()
    rows: dict[str, int] = {}
    files: set[str] = set()
    running: list[str] = []
    for schema, table, columns in personal_tables():
        where, values = _whose(columns, ids)
        if not where:
            continue
        name = quote(schema, table)
        n = conn.query(f"SELECT COUNT(*) FROM {name} WHERE {where}", args=values).fetchone()[0]  # noqa: S608
        if not n:
            continue
        rows[f"{schema}.{table}"] = int(n)
        for column in (quote(c.name) for c in columns if c.names_files):
            found = conn.query(f"SELECT {column} FROM {name} WHERE ({where}) AND {column} IS NOT NULL", args=values)  # noqa: S608
            files.update(json.loads(row[0])["path"] for row in found.fetchall())
        if table.startswith("~~"):
            held = conn.query(f"SELECT host, pid FROM {name} WHERE ({where}) AND status = 'reserved'", args=values)  # noqa: S608
            running += [f"{table.removeprefix('~~')} on {host}, process {pid}" for host, pid in held.fetchall()]
    # All files in the person's folders: a computation that was killed leaves some without a row.
    store = connection.store_backend()
    files.update(path for folder in _folders(ids) for path in files_below(store, folder))
    with store_errors():
        files.update(path for path in earlier.get("files", []) if path not in files and store.exists(path))
    return Found(rows, sorted(files), _videos(ids, earlier), running, recordings)


def personal_tables() -> list[tuple[str, str, list[Column]]]:
    """Return schema, name and columns of the tables that can hold a row of a person."""
    found = catalog.tables().items()
    return [(*name, columns) for name, columns in found if {*IDENTITIES} & {c.name for c in columns}]


def _whose(columns: Sequence[Column], ids: Ids) -> tuple[str, tuple]:
    """Return an SQL condition for the person's rows, and its values; empty if the table can hold none."""
    names = {c.name for c in columns}
    parts, values = [], []
    for name in IDENTITIES:
        marks = ",".join(["%s"] * len(ids[name]))
        if ids[name] and name in names:
            parts.append(f"{quote(name)} IN ({marks})")
            values += ids[name]
    return " OR ".join(parts), tuple(values)


def _folders(ids: Ids) -> list[str]:
    """Return the person's folders of the store.

    A path is `_schema/<schema>/<table>/<key>=<value>/...`, the key in the order of the table.
    """
    root = connection.store_root()
    return [
        f"{root}/{schema}/{table}/{name}={value}"
        for (schema, table), columns in catalog.tables().items()
        if any(c.names_files for c in columns)
        for name in IDENTITIES
        if name in {c.name for c in columns}
        for value in ids[name]
    ]


def _videos(ids: Ids, earlier: dict[str, Any]) -> list[dict[str, Any]]:
    rows = (video.Video & inside("video_id", ids["video_id"])).to_dicts()
    now = [{"path": r["video_path"], "sha256": r["video_sha256"], "size": int(r["video_size"])} for r in rows]
    return now + [v for v in earlier.get("videos", []) if v not in now]


# --------------------------------------------------------------------------------------------------------- removing
def _delete_rows(subject: str, ids: Ids, say: Say) -> None:
    """Delete queued jobs first (no worker takes one then), the person with what depends on it, and the rest."""
    # Calibrations of the person's videos: their notes may name a file.
    rows = video.Video & inside("video_id", ids["video_id"]) & "camera_id IS NOT NULL"
    cameras = sorted({int(c) for c in rows.to_arrays("camera_id")})
    conn = connection.connect()
    tables = personal_tables()
    queues = [t for t in tables if t[1].startswith("~~")]
    _delete_where(conn, queues, ids)
    counts = delete_below(lab.Subject, (lab.Subject & {"subject": subject}).keys())
    say(f"{sum(counts.values())} rows of {len(counts)} tables were deleted")
    _delete_where(conn, tables, ids)
    unused = [c for c in cameras if not video.Video & {"camera_id": c} and not lab.DeviceCalibration & {"camera_id": c}]
    delete_below(lab.CameraCalibration, [{"camera_id": c} for c in unused])


def _delete_where(conn: Any, tables: Sequence[tuple[str, str, list[Column]]], ids: Ids) -> None:
    for schema, table, columns in tables:
        where, values = _whose(columns, ids)
        if where:
            conn.query(f"DELETE FROM {quote(schema, table)} WHERE {where}", args=values)  # noqa: S608


def _delete_files(files: Sequence[str], ids: Ids, say: Say) -> None:
    store = connection.store_backend()
    say(f"Removing {len(files)} files from the store")
    with progress.bar("files", total=len(files), unit="file") as update:
        for path in files:
            with store_errors():
                store.remove(path)
            if store.protocol == "file":
                # The names of the folders carry the person's numbers.
                remove_empty(Path(full_path(store, path)).parent, len(PurePosixPath(path).parts) - 4)
            update(1)
    if store.protocol == "s3":
        for folder in _folders(ids):
            purge(store.fs, full_path(store, folder))


# ------------------------------------------------------------------------------------------------------------- proof
def _mentions(subject: str, videos: Sequence[dict[str, Any]]) -> list[str]:
    """Return the columns that still hold the subject's code, or the path or checksum of one of the videos."""
    terms = [t for v in videos for t in (v["path"], v["sha256"])]
    conn, out = connection.connect(), []
    for (schema, table), columns in catalog.tables().items():
        for column in columns:
            name = quote(column.name)
            if column.type not in ("char", "varchar", "text", "longtext", "json"):
                continue
            if column.name.startswith("subject") and "method" not in column.name:
                test, values = f"{name} = %s", [subject]
            elif not terms:
                continue
            elif column.type in ("char", "varchar"):
                test, values = f"{name} IN ({','.join(['%s'] * len(terms))})", terms
            else:
                test, values = " OR ".join([f"LOCATE(%s, {name})"] * len(terms)), terms
            counted = f"SELECT COUNT(*) FROM {quote(schema, table)} WHERE {test}"  # noqa: S608
            n = conn.query(counted, args=tuple(values)).fetchone()[0]
            if n:
                out.append(f"{n} rows of {schema}.{table} name it in {column.name}")
    return out


def read_manifest(subject: str) -> dict[str, Any]:
    """Return the list that an earlier run wrote; empty if there is none."""
    try:
        found = json.loads(manifest_path(subject).read_text(encoding="utf-8"))
        kinds = {"ids": dict, "files": list, "videos": list, "rows": dict}
        if not isinstance(found, dict) or not all(isinstance(found.get(n, k()), k) for n, k in kinds.items()):
            raise TypeError("not a list of a person's rows and files")
        return found
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise PblError(
            "FILE_FORMAT",
            key=manifest_path(subject),
            found=f"the list of an earlier run cannot be read ({error})",
            expected="what pbl forget wrote",
            next_step="restore the file; without it files that no row names any more cannot be found",
        ) from error


def _write(subject: str, manifest: dict[str, Any]) -> None:
    path = manifest_path(subject)
    with os_errors_as(
        "FILE_UNWRITABLE",
        "a place for the list of what is removed: nothing was removed without it",
        "free space, or set PBL_HOME to a folder you may write to",
        path,
    ):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_json(path, manifest)


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
