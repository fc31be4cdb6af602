"""Import of complete uploads from the drop folder of phones.

Layout: SUBJECT/SESSION/FILE in the folder `PBL_INCOMING`. A video may have the phone's sensor log of the same name
(.csv, .json, .zip; docs/phone_capture.md), which is imported with it. A file is complete if it was the same in two runs
at least `SETTLED_S` apart. It is copied into the archive and checked there, registered, and only then removed from the
drop folder: after an interruption the bytes are in at least one place, and the next run continues. A recording that
cannot be registered is moved into the folder `_refused` of the archive, with the reason beside it.

Uploads are imported in random order, so that none waits forever behind one that breaks the run.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import hashlib
import multiprocessing
import os
import random
import secrets
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import pymysql

from pbl_pipeline.errors import CODES, MACHINE, PblError
from pbl_pipeline.files import VIDEO_ENDINGS, sha256_of
from pbl_pipeline.limited import LimitExceeded, limited
from pbl_pipeline.names import normalised_label
from pbl_pipeline.sensors import read_samples
from pbl_pipeline.video import read_first, read_phone_log
from pbl_schemas import video, worker
from pbl_schemas.connection import dj
from pbl_schemas.intake import OneCamera, Registered, Sensors, VisitRecord, register
from pbl_schemas.intake.uploads import LOG_ENDINGS, Bucket, Folder, StillChanging, Upload, drop_folder, incoming_url
from pbl_schemas.operations.archive import (
    COPIES,
    LOCK,
    REFUSED,
    archive_dir,
    folder_of,
    has_row,
    load_seen,
    note_placed,
    plain_name,
    remove_copies,
    save_seen,
)
from pbl_schemas.operations.folders import private_folder, remove_empty, sync_folders
from pbl_schemas.subject_codes import check_subject

if TYPE_CHECKING:
    from pbl_pipeline.sensors.formats.samples import Samples

#: Seconds in which a file must not have changed.
SETTLED_S = 60.0
#: Time after which a run begins no further upload, and that after which it gives up copying one (s).
RUN_S, UPLOAD_S = 600.0, 600.0
#: Limits for reading a sensor log (s, bytes).
LOG_S, LOG_BYTES = 30.0, 2**30
#: Limits for opening a recording (s, bytes).
_OPEN_S, _OPEN_BYTES = 60.0, 2**31
#: Space on the archive's disk that uploads do not fill (bytes).
KEPT_FREE = 10**9
_BLOCK = 2**20
multiprocessing.set_forkserver_preload(["pbl_pipeline.video"])  # for the processes that open files (`limited`)
#: Errors of the installation, which end a run: other uploads would meet them as well.
_OURS = ("DB_NOT_RUNNING", "DB_UNAVAILABLE", "DB_REFUSED", "STORE_UNAVAILABLE", "STORE_FULL")


@dataclasses.dataclass
class Imports:
    """The outcome of a run, by the names of the uploads."""

    registered: list[str] = dataclasses.field(default_factory=list)
    known: dict[str, str] = dataclasses.field(default_factory=dict)  # registered already: the note of `register`
    refused: dict[str, PblError] = dataclasses.field(default_factory=dict)  # moved aside
    left: dict[str, PblError] = dataclasses.field(default_factory=dict)  # whole, but not taken this time
    ignored: dict[str, str] = dataclasses.field(default_factory=dict)  # not a recording in its place: why
    uploading: int = 0  # not whole yet
    later: int = 0  # left to the next run for lack of time


@dataclasses.dataclass
class Copy:
    """A copy in the archive, with its SHA-256."""

    path: Path
    sha256: str


def import_uploads(
    url: str | None = None, archive: Path | None = None, settled_s: float = SETTLED_S, run_s: float = RUN_S
) -> Imports | None:
    """Import the complete uploads of the drop folder. Safe to interrupt and to repeat.

    Returns None if another process is importing.

    Raises `PblError` USAGE; FILE_MISSING: no drop folder; FILE_UNWRITABLE: no archive; DB_..., STORE_....
    Uploads that were not imported until then stay in the drop folder.
    """
    drop, archive = drop_folder(url or incoming_url()), archive or archive_dir()
    with worker.installation_lock(LOCK, video.Video.connection) as obtained:
        if not obtained:
            return None
        out = Imports()
        try:
            remove_copies(archive)
            whole = _listed(drop, archive, settled_s, out)
        except OSError as error:
            raise _unwritable(archive, error) from error
        end = time.monotonic() + run_s
        random.shuffle(whole)
        for i, (recording, logs) in enumerate(whole):
            if time.monotonic() > end:
                out.later = len(whole) - i
                break
            _import_upload(drop, recording, logs, archive, out)
    out.registered.sort()
    return out


# ------------------------------------------------------------------------------------------------------------- listing
def _listed(drop: Folder | Bucket, archive: Path, settled_s: float, out: Imports) -> list[tuple[Upload, list[Upload]]]:
    """Recordings that have not changed for `settled_s`, each with its logs."""
    seen, now = load_seen(archive), time.time()
    still: dict[str, list] = {}
    settled: set[PurePosixPath] = set()
    recordings: list[Upload] = []
    logs: dict[PurePosixPath, list[Upload]] = {}
    for upload in drop.uploads():
        name = upload.name
        if why := _misplaced(upload):
            out.ignored[str(name)] = why
            continue
        state, before = [upload.size, upload.stamp], seen.get(str(name), [])
        # A clock that was set back does not make anything wait.
        first_seen = min(before[2], now) if before[:2] == state else now
        still[str(name)] = [*state, first_seen]
        if before[:2] == state and now - first_seen >= settled_s:
            settled.add(name)
        else:
            out.uploading += 1
        if name.suffix.lower() in VIDEO_ENDINGS:
            recordings.append(upload)
        else:
            logs.setdefault(name.with_suffix(""), []).append(upload)
    save_seen(archive, still)
    whole = []
    for recording in recordings:
        own = sorted(logs.get(recording.name.with_suffix(""), []), key=lambda log: log.name)
        if recording.name in settled and all(log.name in settled for log in own):  # else its log is still on its way
            whole.append((recording, own[:1]))
    alone = set(logs).difference(r.name.with_suffix("") for r in recordings)
    for log in (log.name for stem in alone for log in logs[stem] if log.name in settled):
        out.ignored[str(log)] = "a log without a video of its name"
    return whole


def _misplaced(upload: Upload) -> str:
    """Return why an entry of the drop folder is not a recording in its place; "" if it is one, or a log."""
    name = upload.name
    if any(part.startswith((".", "_")) for part in name.parts):
        return "a name that begins with . or _, as what is still being written has"
    if not upload.file:
        return "no file: a folder where a file is expected, one that may not be read, or a name that leads elsewhere"
    if len(name.parts) != 3:
        return f"{len(name.parts) - 1} folders deep, where SUBJECT/SESSION/FILE is expected"
    if name.suffix.lower() not in (*VIDEO_ENDINGS, *LOG_ENDINGS):
        return f"another ending than {', '.join((*VIDEO_ENDINGS, *LOG_ENDINGS))}"
    return ""


# -------------------------------------------------------------------------------------------------------------- taking
def _import_upload(drop: Folder | Bucket, recording: Upload, logs: list[Upload], archive: Path, out: Imports) -> None:
    """Copy, check, register, remove; what is refused is moved aside with its reason."""
    name, given, copies = str(recording.name), [recording, *logs], []
    try:
        try:
            end = time.monotonic() + UPLOAD_S
            for upload in given:
                copies.append(_copy(drop, upload, archive, end))
            subject, session, file = recording.name.parts
            check_subject(normalised_label(subject), "rename the folder and upload again", recording.name)
            for copy in copies[1:]:
                check_log(copy.path)
            registered = register_copies(VisitRecord(subject, session), file, copies, archive)
        except (OSError, StillChanging, pymysql.err.Error, dj.DataJointError):
            raise
        except Exception as error:  # one upload never stops the others
            coded = _named(name, error)
            if coded.code in _OURS:
                raise
            if CODES[coded.code].cause == MACHINE:
                out.left[name] = coded
                for copy in copies:  # the next run makes them again; one with a row was registered before
                    if not video.Video & {"video_path": str(copy.path)}:
                        copy.path.unlink(missing_ok=True)
                return
            out.refused[name] = coded
            _set_aside(drop, given, copies, archive, coded)
        else:
            if registered.status != "registered":
                out.known[name] = registered.note
            else:
                out.registered.append(name)
        copies, done = [], len(copies)
        for upload in given[:done]:
            drop.remove(upload)
    except StillChanging:
        out.uploading += 1
    except OSError as error:
        out.left[name] = _named(name, _unwritable(archive, error))
    finally:
        for copy in copies:
            if copy.path.is_relative_to(archive / COPIES):  # what has its place in the archive already may have its row
                copy.path.unlink(missing_ok=True)


def _copy(drop: Folder | Bucket, upload: Upload, archive: Path, end: float) -> Copy:
    """Copy into the archive under a new name, on disk when this returns. Raises `PblError` UPLOAD_REFUSED; OSError and
    StillChanging: nothing is left behind."""
    digest, n = hashlib.sha256(), 0
    folder = folder_of(archive, COPIES, normalised_label(upload.name.parts[0]))
    part = folder / f"{secrets.token_hex(6)}{upload.name.suffix.lower()}"
    keep_free(folder, upload.size)
    try:
        with (
            drop.open(upload) as source,
            open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as target,
        ):
            while n <= upload.size and (block := source.read(_BLOCK)):
                digest.update(block)
                target.write(block)
                n += len(block)
                if time.monotonic() > end:
                    raise OSError(f"{n >> 20} MiB were copied in {UPLOAD_S:.0f} s")
            target.flush()
            os.fsync(target.fileno())
        if n != upload.size or not drop.unchanged(upload):
            raise StillChanging
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, Exception) and not isinstance(error, (OSError, PblError, StillChanging)):
            raise OSError(f"{type(error).__name__}: {error}") from error  # the client of an object store
        raise
    return Copy(part, digest.hexdigest())


def has_room(folder: Path, n_bytes: int) -> bool:
    """Return whether so many bytes fit on the disk of a folder, which need not exist yet, beside `KEPT_FREE`."""
    while not folder.is_dir():
        folder = folder.parent
    return shutil.disk_usage(folder).free >= n_bytes + KEPT_FREE


def keep_free(folder: Path, n_bytes: int) -> None:
    """Raise OSError if so many bytes do not fit on the disk of a folder beside `KEPT_FREE`."""
    if not has_room(folder, n_bytes):
        raise OSError(errno.ENOSPC, f"no room beside the {KEPT_FREE / 1e9:.0f} GB that are kept free")


def check_room(n_bytes: int, next_step: str) -> None:
    """Raise `PblError` FILE_UNWRITABLE, with `next_step`, if so many bytes do not fit into the archive."""
    if not has_room(archive_dir(), n_bytes):
        found = f"no room for {n_bytes / 1e9:.1f} GB in the archive of the server"
        expected = f"room for it beside {KEPT_FREE / 1e9:.0f} GB that are kept free"
        raise PblError("FILE_UNWRITABLE", found, expected, next_step)


def check_opens(path: Path) -> None:
    """Decode the first picture of a file in a process with limits. Raises `PblError` VIDEO_...: what is wrong with it;
    MACHINE_SHORT beyond the limits, or if the process was ended."""
    _within_limits(read_first, path, _OPEN_S, _OPEN_BYTES)


def check_log(path: Path) -> None:
    """Read a sensor log in a process with limits. Raises `PblError` PHONE_LOG, FILE_FORMAT; MACHINE_SHORT."""
    _within_limits(read_phone_log, path, LOG_S, LOG_BYTES)


def samples_of(path: Path, rate_hz: float | None = None, called: str | None = None) -> list[Samples]:
    """Read the wearable sensors in a log (`read_samples`), in a process with limits. Raises what that raises;
    MACHINE_SHORT."""
    return _within_limits(functools.partial(read_samples, rate_hz=rate_hz, called=called), path, LOG_S, LOG_BYTES, True)


def _within_limits(
    read: Callable[[Path], object], file: Path, seconds: float, n_bytes: int, returns: bool = False
) -> Any:
    try:
        return limited(read, file, seconds=seconds, n_bytes=n_bytes, returns=returns)
    except LimitExceeded as error:
        expected = f"{seconds:g} s of this machine and {n_bytes / 2**30:g} GiB of its memory"
        next_step = "try again; if it stays so, give the server more memory, or fewer processes"
        raise PblError("MACHINE_SHORT", f"the file was not opened: {error}", expected, next_step, key=file) from error


def register_copies(visit: VisitRecord, file: str, copies: Sequence[Copy], archive: Path) -> Registered:
    """Move copies of a recording, and of its sensor log if there is one (`check_log`), to their place in the archive
    and register them; return the outcome. `file`: the name that the recording came with.

    Raises `PblError`, which says what is wrong with the recording: the copies are where they were, if it has no row.
    """
    visit.check(file)
    recording, *logs = copies
    folder = private_folder(folder_of(archive, "", visit.subject) / plain_name(visit.session_label))
    name = Path(plain_name(file))
    target = folder / f"{name.stem}-{recording.sha256[:8]}{name.suffix}"
    came, note = [copy.path for copy in copies], note_placed(archive, target)
    for copy, to in zip(copies, (target, *(target.with_suffix(log.path.suffix) for log in logs)), strict=True):
        copy.path = copy.path.replace(to)
    sync_folders(folder, archive)
    sensors = Sensors(attitude=logs[0].path if logs else None)
    (result,) = register([OneCamera(target, visit, sensors, recording.sha256)])
    if result.error is not None:
        if has_row(target):
            note.unlink()
        elif result.error.code not in _OURS:
            for copy, path in zip(copies, came, strict=True):
                copy.path = copy.path.replace(path)
            note.unlink()
        raise result.error
    if result.status != "registered":
        registered = Path((video.Video & {"video_id": result.video_id}).fetch1("video_path"))
        if registered != target and registered.is_file() and sha256_of(registered) == recording.sha256:
            target.unlink()
    note.unlink()
    return result


def _set_aside(
    drop: Folder | Bucket, given: Sequence[Upload], copies: Sequence[Copy], archive: Path, why: PblError
) -> None:
    """Move a refused upload into the archive's folder for it, the reason first. A copy is moved instead of the
    original. Raises OSError if it cannot be moved: it stays in the drop folder."""
    name = given[0].name
    folder = folder_of(archive, REFUSED, normalised_label(name.parts[0]))
    mark = copies[0].sha256 if copies else hashlib.sha256(os.fsencode(str(name))).hexdigest()
    aside = folder / f"{mark[:12]}-{plain_name(name.name)}"
    reason = os.open(aside.with_name(aside.name + ".txt"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with open(reason, "w", encoding="utf-8") as text:
        text.write(why.text() + "\n")
    for i, upload in enumerate(given):
        to = aside if i == 0 else aside.with_name(f"{aside.name}.log{upload.name.suffix.lower()}")
        if i < len(copies):
            was = copies[i].path
            if video.Video & {"video_path": str(was)}:  # the same recording was registered before
                shutil.copyfile(was, to)
            else:
                copies[i].path = was.replace(to)
                remove_empty(was.parent, 2)
        else:
            drop.move(upload, to)
    sync_folders(folder, archive)


def _unwritable(archive: Path, error: OSError) -> PblError:
    return PblError(
        "FILE_UNWRITABLE",
        key=archive,
        found=f"{error.strerror or error}" + (f" ({error.filename})" if error.filename else ""),
        expected="room and rights in the archive, and the right to remove uploads from the drop folder",
        next_step="see to it; the recording is still where it was uploaded, and the next run takes it",
    )


def _named(name: str, error: Exception) -> PblError:
    """Return the coded error about an upload, under its original name instead of that of our copy."""
    if isinstance(error, PblError):
        return error if error.code == "UPLOAD_REFUSED" else error.with_key(name)
    return PblError(
        "INTERNAL",
        found=f"{type(error).__name__}: {error}",
        expected="a recording that can be registered, or a coded error",
        next_step="report this; the recording is kept",
        key=name,
    )
