"""Files that a browser sends for a visit: written to the archive while they arrive, checked, and taken in like an
upload of the drop folder."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import logging
import os
import secrets
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any

from pbl_pipeline.errors import CODES, MACHINE, PblError, joined
from pbl_pipeline.files import VIDEO_ENDINGS
from pbl_pipeline.sensors import SEGMENTS, Given, read_given
from pbl_schemas import session, video, worker
from pbl_schemas.decisions.review_decisions import queue_visit, record
from pbl_schemas.intake import Registered, Sensors, VisitRecord, phone_recordings
from pbl_schemas.intake.sensors import attach_worn
from pbl_schemas.intake.uploads import LARGEST, LARGEST_LOG, LOG_ENDINGS
from pbl_schemas.operations.archive import LOCK, PHONE, archive_dir, folder_of, plain_name, remove_folders
from pbl_schemas.operations.folders import private_folder, remove_empty

from .incoming import Copy, check_log, check_opens, keep_free, register_copies, samples_of
from .log import event

log = logging.getLogger("pbl.web")

_refused = functools.partial(PblError, "UPLOAD_REFUSED")


@dataclasses.dataclass(frozen=True)
class Place:
    """The visit that files are sent for; by: who sends them; link: of the phone that does, None without one."""

    session_id: int
    subject: str
    label: str
    by: str = ""
    link: int | None = None


@dataclasses.dataclass(frozen=True)
class Received:
    """Outcome of a file: its name as it was sent; status as in `Registered`. worn: of wearable sensors, all logs of a
    form that could be read together; note: what was done with them."""

    name: str
    status: str
    video_id: int | None = None
    error: PblError | None = None
    worn: bool = False
    note: str = ""


def place(session_id: int, by: str = "") -> Place:
    """Return the visit. Raises `PblError` DB_NOT_FOUND."""
    visit = session.registered_visit(session_id)
    return Place(session_id, visit["subject"], visit["session_label"], by)


class Arriving:
    """A file that arrives: written under a new name in the person's folder of the archive, and hashed. Raises
    `PblError` UPLOAD_REFUSED for another ending than that of a recording or sensor log, or too many bytes; OSError.
    worn: the log of a wearable sensor, of any ending, in a folder of its own."""

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
        own = f"browser-{secrets.token_hex(6)}"
        self.path = private_folder(folder / own) / self.name if worn else folder / f"{own}{ending}"
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
        remove_empty(self.path.parent, int(self.worn))


def check(
    whole: Sequence[tuple[Arriving, Copy]], segment: str, of_visit: tuple[list[dict[str, Any]], dict[str, str | None]]
) -> tuple[list[tuple[Arriving, Copy]], Sensors, list[Received]]:
    """Return the files of a form that may be registered, its logs of wearable sensors, and what is refused of them, or
    could not be checked (`check_opens`, `check_log`, `read_given` of each log, `Sensors.at_visit` of all together).
    segment: of the logs, "" where the names in them tell it; of_visit: its `fit.worn_logs`."""
    most = len(SEGMENTS) + 1  # of so many logs two are on one segment: not all of a form are in memory
    good, given, refused, samples = [], [], [], functools.lru_cache(most)(samples_of)
    videos = {PurePosixPath(one.name).stem for one, _ in whole if not (one.is_log or one.worn)}
    for one, copy in whole:
        try:
            if one.worn:
                own = read_given([Given(one.path, segment or None)], samples)
                given += [Given(one.path, log.segment, log.name) for log in own]
                continue
            if not one.is_log or PurePosixPath(one.name).stem in videos:  # a log alone is refused as such
                (check_log if one.is_log else check_opens)(one.path)
            good.append((one, copy))
        except PblError as error:
            refused.append(Received(one.name, "refused", error=error.with_key(one.name), worn=one.worn))
    try:
        return good, Sensors(imu=given[:most], samples=samples).read()[0].at_visit(*of_visit), refused
    except PblError as error:
        return good, Sensors(), [*refused, _refusal(_names(Sensors(imu=given)), error, worn=True)]


def _names(worn: Sensors) -> str:
    return ", ".join({one.file: one.file.name for one in worn.imu}.values())


def register(
    to: Place, arrived: Sequence[tuple[Arriving, Copy]], worn: Sensors, activity: str, pace: str
) -> list[Received] | None:
    """Register files that were checked; a sensor log goes with the video of its name, those of wearable sensors
    with the visit, all together. One outcome for each video, each log without a video, and all wearable sensors; None,
    with nothing done, while the drop folder is being taken over or a person removed (not for logs alone).

    Raises `PblError` DB_NOT_FOUND if the visit is gone, PHONE_LINK if the link is, DB_..., STORE_..., FILE_UNWRITABLE.
    """
    logs = {PurePosixPath(one.name).stem: copy for one, copy in arrived if one.is_log}
    out = []
    # Logs of wearable sensors alone need no place in the archive, whose folders may be another's that holds the lock.
    lock = worker.installation_lock(LOCK, video.Video.connection) if arrived else contextlib.nullcontext(True)
    with lock as obtained:
        if not obtained:
            return None
        place(to.session_id)  # a visit that was removed is not made again
        if to.link is not None:
            phone_recordings.check_link(to.link)
        visit = VisitRecord(to.subject, to.label, activity=activity or None, pace=pace or None)
        for one, copy in arrived:
            if not one.is_log:
                its_log = logs.pop(PurePosixPath(one.name).stem, None)
                out.append(_register_copies(visit, one.name, [copy, its_log] if its_log else [copy], to.by))
        if arrived:
            remove_folders(archive_dir(), to.subject)
    out += [_attach(to, worn)] if worn else []
    alone = functools.partial(
        _refused, "a sensor log alone", "the video of the same name with it", "send both together"
    )
    out += [Received(f"{stem}{copy.path.suffix}", "refused", error=alone(key=stem)) for stem, copy in logs.items()]
    if any(one.error is None for one in out):
        try:
            queue_visit(to.session_id)
        except PblError as error:
            if error.code != "NOT_QUEUED":  # workers find what is registered; the outcomes are not lost for it
                raise
            event(log, logging.ERROR, "not queued", error=error.text())
    return out


def _refusal(name: str, error: PblError, worn: bool = False) -> Received:
    """The outcome of a file that is refused. Raises an error of this machine: the others would meet it as well."""
    if CODES[error.code].cause == MACHINE:
        raise error
    return Received(name, "refused", error=error.with_key(name), worn=worn)


def _attach(to: Place, worn: Sensors) -> Received:
    name = _names(worn)
    try:
        done = attach_worn(to.session_id, worn)
    except PblError as error:
        return _refusal(name, error, worn=True)
    if done:
        segments = sorted(one.segment or "" for one in worn.imu)
        about = {} if to.link is None else {"phone_link": to.link}
        record("sensors", to.by, about, {}, {"sensors": segments}, session_id=to.session_id)
    return Received(name, "registered" if done else "known", worn=True, note=joined(done, "; "))


def _register_copies(visit: VisitRecord, name: str, copies: list[Copy], by: str) -> Received:
    try:
        result: Registered = register_copies(visit, name, copies, archive_dir())
    except PblError as error:
        return _refusal(name, error)
    assert result.video_id is not None
    if result.status == "registered":
        record("recording", by, {}, {}, {"recording": "registered"}, video_id=result.video_id)
    return Received(name, result.status, result.video_id)
