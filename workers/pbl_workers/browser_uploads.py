"""Files that a browser sends for a visit: written to the archive while they arrive, checked, and taken in like an
upload of the drop folder."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import logging
import os
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from pbl_pipeline.errors import CODES, MACHINE, PblError
from pbl_pipeline.temporary import new_folder
from pbl_schemas import session, video, worker
from pbl_schemas.decisions.review_decisions import queue_visit, record
from pbl_schemas.intake import Registered, VisitRecord
from pbl_schemas.intake.uploads import LARGEST, LARGEST_LOG, LOG_ENDINGS
from pbl_schemas.operations.archive import LOCK, PHONE, archive_dir, folder_of, plain_name, remove_folders

from .incoming import VIDEO_ENDINGS, Copy, attach_log, check_log, check_opens, keep_free, register_copies
from .log import event

log = logging.getLogger("pbl.web")

_refused = functools.partial(PblError, "UPLOAD_REFUSED")


@dataclasses.dataclass(frozen=True)
class Place:
    """The visit that files are sent for."""

    session_id: int
    subject: str
    label: str


@dataclasses.dataclass(frozen=True)
class Received:
    """Outcome of a file: its name as it was sent; status as in `Registered`."""

    name: str
    status: str
    video_id: int | None = None
    error: PblError | None = None
    worn: bool = False  # of a wearable sensor


def place(session_id: int) -> Place:
    """Return the visit. Raises `PblError` DB_NOT_FOUND."""
    visit = session.registered_visit(session_id)
    return Place(session_id, visit["subject"], visit["session_label"])


class Arriving:
    """A file that arrives: written under a new name in the person's folder of the archive, and hashed. Raises
    `PblError` UPLOAD_REFUSED for another ending than that of a recording or sensor log, or too many bytes; OSError.
    worn: the log of a wearable sensor, of any ending."""

    def __init__(self, to: Place, name: str, worn: bool = False) -> None:
        self.name, self.worn = plain_name(PurePosixPath(name.replace("\\", "/")).name), worn
        ending = PurePosixPath(self.name).suffix.lower()
        if not worn and ending not in (*VIDEO_ENDINGS, *LOG_ENDINGS):
            photo = ending in (".heic", ".heif", ".jpg", ".jpeg", ".png")
            raise _refused(
                "a photo" if photo else f"a file that ends in {ending!r}",
                f"a video ({', '.join(VIDEO_ENDINGS)}), or the sensor log beside it ({', '.join(LOG_ENDINGS)})",
                "choose the video itself",
                self.name,
            )
        self._most = LARGEST_LOG if worn or ending in LOG_ENDINGS else LARGEST
        folder = folder_of(archive_dir(), PHONE, to.subject)
        self.path = folder / f"browser-{secrets.token_hex(6)}{ending}"
        self._file = open(os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")  # noqa: SIM115
        self._sum, self._n = hashlib.sha256(), 0

    @property
    def is_log(self) -> bool:
        """True for a phone's sensor log, by its ending."""
        return not self.worn and self.path.suffix in LOG_ENDINGS

    def write(self, piece: bytes) -> None:
        """Write the next bytes."""
        self._n += len(piece)
        if self._n > self._most:
            found, most = f"a file of more than {self._most / 1e9:g} GB", f"at most {self._most / 1e9:g} GB"
            raise _refused(found, most, "send a shorter recording", self.name)
        keep_free(self.path.parent, len(piece))
        self._sum.update(piece)
        self._file.write(piece)

    def finish(self) -> Copy:
        """Return the whole file, which is on disk then."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        return Copy(self.path, self._sum.hexdigest())

    def discard(self) -> None:
        """Remove the file; one that was registered has another name and stays."""
        self._file.close()
        self.path.unlink(missing_ok=True)


def check(arrived: Arriving) -> PblError | None:
    """Return what is wrong with a file that arrived, or could not be checked (`check_opens`, `check_log`); or None."""
    try:
        if not arrived.worn:  # `attach_log` reads it
            (check_log if arrived.is_log else check_opens)(arrived.path)
    except PblError as error:
        return error.with_key(arrived.name)
    return None


def register(
    to: Place, arrived: Sequence[tuple[Arriving, Copy]], activity: str, pace: str, by: str, segment: str = ""
) -> list[Received] | None:
    """Register files that arrived whole; a sensor log goes with the video of its name, that of a wearable sensor on a
    segment with the visit. One outcome for each video and each log without a video; None, with nothing done, while the
    drop folder is being taken over or a person removed.

    Raises `PblError` DB_NOT_FOUND if the visit is gone, DB_..., FILE_UNWRITABLE.
    """
    logs = {PurePosixPath(one.name).stem: copy for one, copy in arrived if one.is_log}
    out = []
    with worker.installation_lock(LOCK, video.Video.connection) as obtained:
        if not obtained:
            return None
        place(to.session_id)  # a visit that was removed is not made again
        visit = VisitRecord(to.subject, to.label, activity=activity or None, pace=pace or None)
        for one, copy in arrived:
            if one.worn:
                out.append(_attach(to, one, segment))
            elif not one.is_log:
                its_log = logs.pop(PurePosixPath(one.name).stem, None)
                out.append(_register_copies(visit, one.name, [copy, its_log] if its_log else [copy], by))
    alone = functools.partial(
        _refused,
        found="a sensor log alone",
        expected="the video of the same name with it",
        next_step="send both together",
    )
    out += [Received(f"{stem}{copy.path.suffix}", "refused", error=alone(key=stem)) for stem, copy in logs.items()]
    remove_folders(archive_dir(), to.subject)
    if any(one.error is None for one in out):
        try:
            queue_visit(to.session_id)
        except PblError as error:
            if error.code != "NOT_QUEUED":  # workers find what is registered; the outcomes are not lost for it
                raise
            event(log, logging.ERROR, "not queued", error=error.text())
    return out


def _attach(to: Place, one: Arriving, segment: str) -> Received:
    with new_folder() as folder:
        file = Path(shutil.move(one.path, folder / one.name))
        try:
            attach_log(to.session_id, file, segment)
        except PblError as error:
            return Received(one.name, "refused", error=error, worn=True)
    return Received(one.name, "registered", worn=True)


def _register_copies(visit: VisitRecord, name: str, copies: list[Copy], by: str) -> Received:
    try:
        result: Registered = register_copies(visit, name, copies, archive_dir())
    except PblError as error:
        if CODES[error.code].cause == MACHINE:  # the others would meet it as well
            raise
        return Received(name, "refused", error=error.with_key(name))
    assert result.video_id is not None
    if result.status == "registered":
        record("recording", by, {}, {}, {"recording": "registered"}, video_id=result.video_id)
    return Received(name, result.status, result.video_id)
