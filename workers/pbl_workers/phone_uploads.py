"""Recordings that phones send, from the first part to the row: the parts as files of the archive, checked and joined,
taken in like an upload of the drop folder, and computed before everything else.

Every part is a separate file, which gets its name only when it is complete and on disk. After an interruption the
existing parts count, and all of them stay until the recording is registered.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from pbl_pipeline.errors import PblError
from pbl_schemas import video, worker
from pbl_schemas.capture import UPLOADING
from pbl_schemas.intake import VisitRecord, phone_recordings
from pbl_schemas.intake.phone_recordings import PART_BYTES, Phone, Sent, upload_refused
from pbl_schemas.operations.archive import LOCK, PHONE, archive_dir, busy, folder_of, remove_folders, unfinished
from pbl_schemas.operations.folders import private_folder, sync_folders, write_text

from . import queue
from .incoming import Copy, check_log, check_opens, check_room, keep_free, register_copies
from .registry import FIRST


def folder(phone: Phone, sent: Sent) -> Path:
    """Return the folder of a recording's parts; it is made if missing. Raises OSError."""
    return private_folder(folder_of(archive_dir(), PHONE, phone.subject) / str(sent.number))


def missing(phone: Phone, sent: Sent) -> list[int]:
    """Return the numbers of the parts that are not here, from 0; none of a recording that is registered."""
    if sent.state != UPLOADING:
        return []
    here = {path.name for path in folder(phone, sent).iterdir()}
    return [n for n in range(sent.n_parts) if str(n) not in here]


def check_part(sent: Sent, start: int, end: int, total: int) -> int:
    """Return the number of the part with the bytes from `start` to `end`, the last one included. Raises `PblError`
    UPLOAD_REFUSED for what is not a part of the recording."""
    size = sent.video_bytes + sent.log_bytes
    if total != size or start % PART_BYTES or not start <= end == min(start + PART_BYTES, size) - 1:
        raise upload_refused(f"bytes {start} to {end} of {total} of a recording of {size}")
    if sent.state != UPLOADING:
        raise upload_refused("a part of a recording that has been received", "load the page again")
    return start // PART_BYTES


def check_promised(begun: Mapping[int, int], next_step: str) -> None:
    """Raise `PblError` FILE_UNWRITABLE if all recordings that were begun (byte by number) do not fit, each twice: the
    parts stay until the whole is registered."""
    here = {one.path.name: one.n_bytes for one in unfinished(archive_dir(), parts_alone=True)}
    check_room(sum(max(2 * n - here.get(str(number), 0), 0) for number, n in begun.items()), next_step)


def keep_part(phone: Phone, sent: Sent, number: int, body: bytes, sha256: str) -> None:
    """Write a part to the archive, on disk when this returns. Raises `PblError` UPLOAD_REFUSED if the bytes are not
    those that the phone sent; OSError if it cannot be written."""
    if hashlib.sha256(body).hexdigest() != sha256:
        raise upload_refused(f"part {number} with another SHA-256 than was sent", "it is sent again")
    here = folder(phone, sent)
    keep_free(here, len(body))
    write_text(here / str(number), body)
    sync_folders(here, here)


def put_together(phone: Phone, sent: Sent) -> list[Copy]:
    """Return the video, and the sensor log if there is one, as files made of the parts, checked by the sum that the
    phone stated.

    Raises `PblError` UPLOAD_REFUSED: parts are missing, or together they are not what was announced; VIDEO_... for what
    is not a video, PHONE_LOG; MACHINE_SHORT. Only the parts are left then.
    """
    if left := missing(phone, sent):
        raise upload_refused(f"{len(left)} of {sent.n_parts} parts are missing", "the page sends them")
    here = folder(phone, sent)
    whole, log = here / "video.mp4", here / "log.json"
    try:
        video_sum = _join(here, sent, whole, log)
        check_opens(whole)
        if sent.log_bytes:
            check_log(log)
    except BaseException:
        remove_joined(phone, sent)
        raise
    copies = [Copy(whole, video_sum)]
    return [*copies, Copy(log, "")] if sent.log_bytes else copies


def _join(here: Path, sent: Sent, whole: Path, log: Path) -> str:
    """Write video and log from the parts; return the SHA-256 of the video."""
    keep_free(here, sent.video_bytes + sent.log_bytes)
    sums, video_sum, left_of_video = hashlib.sha256(), hashlib.sha256(), sent.video_bytes
    with whole.open("wb") as film, log.open("wb") as beside:
        for number in range(sent.n_parts):
            body = (here / str(number)).read_bytes()
            sums.update(hashlib.sha256(body).digest())
            of_video, rest = body[:left_of_video], body[left_of_video:]
            left_of_video -= len(of_video)
            film.write(of_video)
            video_sum.update(of_video)
            beside.write(rest)
        for file in (film, beside):
            file.flush()
            os.fsync(file.fileno())
    if sums.hexdigest() != sent.sha256:
        for number in range(sent.n_parts):
            (here / str(number)).unlink()
        raise upload_refused("parts that together have another SHA-256 than was announced", "they are sent again")
    return video_sum.hexdigest()


def remove_joined(phone: Phone, sent: Sent) -> None:
    """Remove what was made of the parts and is not registered; the parts stay."""
    for name in ("video.mp4", "log.json"):
        (folder(phone, sent) / name).unlink(missing_ok=True)


def register(phone: Phone, sent: Sent, copies: list[Copy]) -> int:
    """Register a recording that was put together, and have it computed first; return its video_id.

    Raises `PblError` DB_REFUSED while the drop folder is being imported or a person removed; DB_NOT_FOUND if the
    visit is gone; VIDEO_DUPLICATE if another visit has the recording; what is wrong with it.
    """
    stated = {name: sent.about[name] for name in ("activity", "pace") if name in sent.about}
    visit = VisitRecord(phone.subject, phone.label, **stated)
    with worker.installation_lock(LOCK, video.Video.connection) as obtained:
        if not obtained:
            raise busy("the page tries again")
        phone_recordings.recording(phone, sent.number)  # a visit that was removed is not made again
        if video.Video & {"video_sha256": copies[0].sha256} & f"session_id != {phone.session_id}":
            # Without the owner: the phone has the right to its own visit alone.
            found = "this recording is registered in another visit"
            next_step = "film again; who runs the server can find and move it (`pbl move`)"
            raise PblError("VIDEO_DUPLICATE", found, "a recording of this visit", next_step)
        result = register_copies(visit, f"phone-{sent.number}.mp4", copies, archive_dir())
    assert result.video_id is not None
    queue.fill(video.VideoInfo, [{"video_id": result.video_id}], FIRST)
    phone_recordings.received(sent.number, result.video_id)
    return result.video_id


def discard(phone: Phone, sent: Sent) -> None:
    """Remove the parts of a recording that is registered or cannot be."""
    with contextlib.suppress(OSError):  # it is not there, and the disk has no room for it
        shutil.rmtree(folder(phone, sent), ignore_errors=True)
    remove_folders(archive_dir(), phone.subject)
