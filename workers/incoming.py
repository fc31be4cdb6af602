"""Recordings that phones upload: taken over from a folder or an object store's prefix when they are whole.

Layout: SUBJECT/SESSION/FILE under the place that `PBL_INCOMING` names. Beside a video may lie the phone's sensor log of
the same name (.csv, .json, .zip; docs/phone_capture.md), which is taken with it. A file is taken when its size and
time were the same at two looks at least `SETTLED_S` apart. It is copied into the archive and checked there, registered,
and only then removed from where it came: whatever breaks off in between, the bytes are in at least one place, and the
next look goes on. What cannot be registered is moved into the folder `_refused` of the archive, with the reason beside
it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import secrets
import time
from pathlib import Path, PurePosixPath
from typing import Any

import fsspec

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError
from schemas import connection, video
from schemas.codes import check_subject
from schemas.ingest import Visit, ingest
from schemas.sensors import Sensors

#: Seconds in which a file must not have changed.
SETTLED_S = 60.0
#: What is a recording and what its log, by the ending; everything else is left alone and counted.
VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi", ".3gp")
LOG_ENDINGS = (".csv", ".json", ".zip")
_BLOCK = 2**20


@dataclasses.dataclass
class Taken:
    """What one look did: paths of what was registered or had been before; of what was refused, with the reason; how
    many are still being uploaded or have no place in the layout."""

    registered: list[str] = dataclasses.field(default_factory=list)
    known: list[str] = dataclasses.field(default_factory=list)
    refused: dict[str, str] = dataclasses.field(default_factory=dict)
    uploading: int = 0
    ignored: int = 0


def incoming_url() -> str:
    """Where phones upload to: PBL_INCOMING, a folder or s3://BUCKET/PREFIX. Raises USAGE where it is not set."""
    value = os.environ.get("PBL_INCOMING")
    if not value:
        raise PblError(
            "USAGE",
            found="PBL_INCOMING is not set",
            expected="the folder or s3://BUCKET/PREFIX into which recordings are uploaded, as SUBJECT/SESSION/FILE",
            next_step="set it, or leave `pbl cron import` out",
        )
    return value


def archive_dir() -> Path:
    """Where recordings are kept: PBL_ARCHIVE (default: recordings/ in PBL_HOME)."""
    return Path(os.environ.get("PBL_ARCHIVE") or settings.home_dir() / "recordings").absolute()


def take_over(url: str | None = None, archive: Path | None = None, settled_s: float = SETTLED_S) -> Taken:
    """Look once, and take what is whole. Safe to break off and to repeat; one process at a time.

    Raises
    ------
    PblError
        USAGE, or FILE_UNWRITABLE when the archive cannot be written (disk full): nothing is removed then.
    """
    url, archive = url or incoming_url(), archive or archive_dir()
    fs, root = fsspec.core.url_to_fs(url, **_login(url))
    with connection.alone("incoming", video.Video.connection) as obtained:
        return _take_over(fs, str(root), archive, settled_s) if obtained else Taken()


def _take_over(fs: Any, root: str, archive: Path, settled_s: float) -> Taken:
    out, seen = Taken(), _load_seen(archive)
    now, still, whole = time.time(), {}, {}
    for path, about in sorted(fs.find(root, detail=True).items()):
        name = PurePosixPath(str(path).removeprefix(root).lstrip("/"))
        if not _has_place(name):
            out.ignored += 1
            continue
        state = [int(about["size"] or 0), str(about.get("mtime") or about.get("LastModified") or "")]
        before = seen.get(str(name))
        first_seen = before[2] if before is not None and before[:2] == state else now
        still[str(name)] = [*state, first_seen]
        if before is None or before[:2] != state or now - first_seen < settled_s:
            out.uploading += 1
        else:
            whole[name] = _File(path, state)
    for name, file in whole.items():
        if name.suffix.lower() not in VIDEO_ENDINGS:
            continue
        logs = [PurePosixPath(n) for n in still if _is_log_of(PurePosixPath(n), name)]
        if all(n in whole for n in logs):  # else its log is still on its way
            _take(fs, name, file, [whole[n] for n in logs[:1]], archive, out)
    _save_seen(archive, still)
    return out


def _has_place(name: PurePosixPath) -> bool:
    return (
        len(name.parts) == 3
        and not any(part.startswith((".", "_")) for part in name.parts)
        and name.suffix.lower() in (*VIDEO_ENDINGS, *LOG_ENDINGS)
    )


def _is_log_of(name: PurePosixPath, video_name: PurePosixPath) -> bool:
    return name.with_suffix("") == video_name.with_suffix("") and name.suffix.lower() in LOG_ENDINGS


@dataclasses.dataclass(frozen=True)
class _File:
    """A file as it was listed: path, and [size, time]."""

    path: str
    state: list


def _take(fs: Any, name: PurePosixPath, given: _File, logs: list[_File], archive: Path, out: Taken) -> None:
    """Copy, check, register, remove; what is refused is moved aside with its reason."""
    subject, session, file = name.parts
    try:
        copy, sha256 = _copy(fs, given, archive)
        try:
            log = _copy(fs, logs[0], archive)[0] if logs else None
        except BaseException:
            copy.unlink()
            raise
    except _StillChanging:
        out.uploading += 1
        return
    target = copy
    try:
        check_subject(subject, "rename the folder and upload again", name)
        target = archive / subject / _plain(session) / f"{sha256[:12]}-{_plain(file)}"
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(copy, target)
        if log is not None:
            log = log.replace(target.with_suffix(PurePosixPath(logs[0].path).suffix.lower()))
        sensors = [Sensors(attitude=log)] if log is not None else []
        (result,) = ingest([target], Visit(subject=subject, session_label=session), files=sensors)
        if result.error is not None:
            raise result.error
    except PblError as error:
        aside = archive / "_refused" / f"{sha256[:12]}-{_plain(file)}"
        aside.parent.mkdir(parents=True, exist_ok=True)
        os.replace(copy if copy.exists() else target, aside)
        if log is not None and log.exists():
            log.replace(aside.with_name(aside.name + ".log" + log.suffix))
        aside.with_name(aside.name + ".txt").write_text(f"{name}\n{error.text()}\n")
        fs.rm([given.path, *(f.path for f in logs)])
        out.refused[str(name)] = error.code
        return
    (out.registered if result.status == "registered" else out.known).append(str(name))
    if result.status == "known":
        # The same bytes lie in the archive under the path that is registered.
        registered = Path((video.Video & {"video_id": result.video_id}).fetch1("video_path"))
        if registered != target and registered.is_file():
            target.unlink()
    fs.rm([given.path, *(f.path for f in logs)])


class _StillChanging(Exception):
    """The file is not what it was when it was listed."""


def _copy(fs: Any, given: _File, archive: Path) -> tuple[Path, str]:
    """Copy into the archive under a name of its own, on disk when this returns; the copy and its SHA-256."""
    path, (size, _) = given.path, given.state
    digest, n = hashlib.sha256(), 0
    part = archive / ".incoming" / f"{secrets.token_hex(6)}{PurePosixPath(path).suffix.lower()}"
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        with fs.open(path, "rb") as source, part.open("wb") as target:
            while block := source.read(_BLOCK):
                digest.update(block)
                target.write(block)
                n += len(block)
            target.flush()
            os.fsync(target.fileno())
    except OSError as error:
        part.unlink(missing_ok=True)
        raise PblError(
            "FILE_UNWRITABLE",
            found=f"{type(error).__name__}: {error}",
            expected=f"room and rights in {archive}",
            next_step="make room; the recording is still where it was uploaded, and the next look takes it",
            key=path,
        ) from error
    if n != size or int(fs.info(path)["size"] or 0) != n:
        part.unlink()
        raise _StillChanging
    return part, digest.hexdigest()


def _plain(text: str) -> str:
    """A name for a file or folder of ours from one that came from outside: no separator, no leading dot."""
    kept = "".join(c if c.isalnum() or c in "-_. " else "_" for c in text).lstrip(". ").rstrip()
    return kept[-100:] or "_"


def _login(url: str) -> dict[str, Any]:
    """What fsspec needs for an object store: the same variables as the store of arrays."""
    if not url.startswith("s3://"):
        return {}
    from schemas.secret_files import secret

    endpoint = os.environ.get("PBL_S3_ENDPOINT")
    about: dict[str, Any] = {"key": secret("PBL_S3_KEY"), "secret": secret("PBL_S3_SECRET")}
    return about | ({"client_kwargs": {"endpoint_url": endpoint}} if endpoint else {})


def _load_seen(archive: Path) -> dict[str, list]:
    try:
        return dict(json.loads((archive / ".incoming" / "seen.json").read_text()))
    except (OSError, ValueError):
        return {}


def _save_seen(archive: Path, seen: dict[str, list]) -> None:
    path = archive / ".incoming" / "seen.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(seen))
    os.replace(part, path)
