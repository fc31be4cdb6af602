"""Links by which phones film for a visit, and the recordings that they send."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import hashlib
import re
import secrets
from collections.abc import Mapping
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label

from .. import session, video
from ..capture import RECEIVED, REFUSED, UPLOADING, PhoneLink, PhoneRecording, Protocol
from ..job_errors import as_text, stored_error
from ..reading.usable import Usable, verdicts
from ..rows import utc_now
from ..transactions import in_transaction, next_id

#: Hours for which a link is good, and the most that it can be.
HOURS, MOST_HOURS = 2.0, 24.0
#: Length of a part of a recording, the last one excepted (byte); the most parts; the longest sensor log (byte).
PART_BYTES, MOST_PARTS, MOST_LOG_BYTES = 2**20, 900, 32 * 2**20
#: Recordings that one link takes.
MOST_RECORDINGS = 100
#: Statements of a phone about a recording: longest text of each (characters), and whole numbers.
TEXTS = {"activity": 32, "pace": 32, "aid": 64, "step": 64, "note": 500, "camera": 128, "sensor": 64, "worn": 8}
NUMBERS = ("frames", "dropped")
_refused = functools.partial(
    PblError,
    "PHONE_LINK",
    expected="a link of the visit's page, opened within its time by one phone",
    next_step='press "Film with a phone" on the page of the visit and scan the new code; recordings on this phone '
    "are kept",
)


_TAKEN = "a link that another phone has opened"
_TRIED = re.compile(r"^(\d+) x ")
#: Characters of an error, which how often it was tried stands before.
_LONGEST = 980


@dataclasses.dataclass(frozen=True)
class Phone:
    """A phone that may film for a visit by its link. by: who made that."""

    link: int
    session_id: int
    subject: str
    label: str
    expires: datetime.datetime
    by: str


@dataclasses.dataclass(frozen=True)
class Sent:
    """A recording that a phone sends. `about`: statements of the phone; `error`: why it was not taken."""

    number: int
    session_id: int
    sha256: str
    video_bytes: int
    log_bytes: int
    about: Mapping[str, Any]
    state: str
    error: PblError | None
    video_id: int | None

    @property
    def n_parts(self) -> int:
        """Number of its parts."""
        return -(-(self.video_bytes + self.log_bytes) // PART_BYTES)


# --------------------------------------------------------------------------------------------------------------- links
def make_link(session_id: int, by: str, hours: float = HOURS, protocol: str | None = None) -> tuple[int, str]:
    """Insert a link for a visit; return its number and its key, which is kept nowhere. Raises `PblError` DB_NOT_FOUND
    for an unknown visit or protocol, USAGE for a time that is too long."""
    session.registered_visit(session_id)
    if protocol is not None and not Protocol & {"protocol": protocol}:
        next_step = "`pbl capture protocol NAME SHEET` registers one"
        raise PblError("DB_NOT_FOUND", f"no protocol {protocol}", "a registered protocol", next_step)
    if not 0 < hours <= MOST_HOURS:
        found = f"a link for {hours:g} hours"
        raise PblError("USAGE", found, f"more than 0 and at most {MOST_HOURS:g}", "make a link for each day of filming")
    key, now = secrets.token_urlsafe(32), utc_now()

    def insert() -> int:
        number = next_id(PhoneLink, "phone_link")
        PhoneLink.insert1(
            {
                "phone_link": number,
                "session_id": session_id,
                "protocol": protocol,
                "link_key_sha256": hashed(key),
                "link_by": by,
                "link_created": now,
                "link_expires": now + datetime.timedelta(hours=hours),
            }
        )
        return number

    return in_transaction(insert), key


def end_link(session_id: int, number: int) -> None:
    """End a link of a visit; one that has ended or that the visit does not have is left alone."""
    if PhoneLink & {"phone_link": number, "session_id": session_id} & "link_ended IS NULL":
        PhoneLink.update1({"phone_link": number, "link_ended": utc_now()})


def use_link(key: str, cookie: str) -> str | None:
    """Open a link by its key; return the cookie that the phone gets, None if it already has the right one.

    The phone that opens a link first is the only one that it opens for. Raises `PblError` PHONE_LINK.
    """
    if is_open(key, cookie):
        return None
    new = secrets.token_urlsafe(32)
    bound = PhoneLink.connection.query(
        f"UPDATE {PhoneLink.full_table_name} SET link_phone_sha256 = %s"  # noqa: S608  DataJoint's own name
        " WHERE link_key_sha256 = %s AND link_phone_sha256 = ''",
        args=(hashed(new), hashed(key)),
    )
    if int(bound.rowcount) != 1:
        raise _refused(_TAKEN)
    return new


def is_open(key: str, cookie: str) -> bool:
    """Return whether the phone with a cookie has opened a link, by its key; False for a link that no phone has opened.
    Raises `PblError` PHONE_LINK for one that is not known, has ended or that another phone has opened."""
    phone = _valid(PhoneLink & {"link_key_sha256": hashed(key)})["link_phone_sha256"]
    if phone and not (cookie and phone == hashed(cookie)):
        raise _refused(_TAKEN)
    return bool(phone)


def phone_of(cookie: str) -> Phone:
    """Return the phone with a cookie. Raises `PblError` PHONE_LINK if its link has ended or never was."""
    link = _valid(PhoneLink & {"link_phone_sha256": hashed(cookie)})
    visit = (session.Session & {"session_id": link["session_id"]}).fetch1()
    where = int(link["session_id"]), visit["subject"], visit["session_label"]
    return Phone(int(link["phone_link"]), *where, link["link_expires"], link["link_by"])


def check_link(number: int) -> None:
    """Raise `PblError` PHONE_LINK if a link has ended."""
    _valid(PhoneLink & {"phone_link": number})


def hashed(secret: str) -> str:
    """SHA-256 of a key or cookie, in hexadecimal digits."""
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


def _valid(query: Any) -> dict[str, Any]:
    rows = query.to_dicts()
    if len(rows) != 1:
        raise _refused("a link that is not known, or whose visit was removed")
    if rows[0]["link_ended"] is not None or rows[0]["link_expires"] <= utc_now():
        raise _refused("a link that has ended")
    return rows[0]


# ---------------------------------------------------------------------------------------------------------- recordings
def begin(phone: Phone, stated: object) -> Sent:
    """Insert a recording of which the phone states its sizes, its sum and what it shows; return it, also where the same
    recording is known.

    Raises `PblError` UPLOAD_REFUSED for a statement that cannot be, a recording that is too long, or too many of them;
    USAGE for a text with control characters or too long.

    `stated`: "sha256", "video_bytes", "log_bytes", and what `TEXTS` and `NUMBERS` name. Not trusted.
    """
    if not isinstance(stated, dict):
        raise upload_refused("no statement of a recording")
    sha256: Any = stated.get("sha256")
    sizes: list[Any] = [stated.get("video_bytes"), stated.get("log_bytes")]
    if not isinstance(sha256, str) or len(sha256) != 64 or set(sha256) - set("0123456789abcdef"):
        raise upload_refused("a recording without its SHA-256")
    if any(type(n) is not int or n < 0 for n in sizes) or not sizes[0]:
        raise upload_refused("a recording without its length")
    if sum(sizes) > PART_BYTES * MOST_PARTS or sizes[1] > MOST_LOG_BYTES:
        raise upload_refused(f"a recording of {sum(sizes) / 1e6:.0f} MB", "film shorter passes: ten minutes at most")
    about: dict[str, Any] = {name: stated[name] for name in TEXTS if stated.get(name)}
    for name, text in about.items():
        check_label(name, text if isinstance(text, str) else "\n", TEXTS[name])
    about |= {n: v for n in NUMBERS if type(v := stated.get(n)) is int and 0 <= v < 10**7}
    same = {"session_id": phone.session_id, "phone_sha256": sha256}

    def insert() -> None:
        if PhoneRecording & same:
            return
        if len(PhoneRecording & {"phone_link": phone.link}) >= MOST_RECORDINGS:
            raise upload_refused(f"more than {MOST_RECORDINGS} recordings by one link", "make another link")
        PhoneRecording.insert1(
            {
                **same,
                "phone_recording": next_id(PhoneRecording, "phone_recording"),
                "phone_link": phone.link,
                "phone_video_size": sizes[0],
                "phone_log_size": sizes[1],
                "phone_about": about,
                "phone_state": UPLOADING,
                "phone_created": utc_now(),
            }
        )

    in_transaction(insert)
    return _sent((PhoneRecording & same).fetch1())


def begun_bytes(days: float) -> dict[int, int]:
    """Return the length (byte), by number, of the recordings that phones began to send within so many days and have not
    ended."""
    since = utc_now() - datetime.timedelta(days=days)
    begun = PhoneRecording & {"phone_state": UPLOADING} & f"phone_created > '{since:%F %T}'"
    return {int(r["phone_recording"]): r["phone_video_size"] + r["phone_log_size"] for r in begun.to_dicts()}


def not_begun(number: int) -> None:
    """Take back that a recording was begun, of which nothing is here; the phone begins it again."""
    (PhoneRecording & {"phone_recording": number, "phone_state": UPLOADING}).delete_quick()


def recording(phone: Phone, number: int) -> Sent:
    """Return a recording of the phone's visit. Raises `PblError` DB_NOT_FOUND for that of another one."""
    rows = (PhoneRecording & {"phone_recording": number, "session_id": phone.session_id}).to_dicts()
    if not rows:
        found = f"no recording {number} of this visit"
        expected = "a recording that this visit's phone has begun to send"
        raise PblError("DB_NOT_FOUND", found, expected, "load the page again: it begins the upload anew")
    return _sent(rows[0])


def recordings(session_id: int) -> list[tuple[Sent, Usable | None]]:
    """Return the recordings that phones sent for a visit, the newest first, with the verdicts on those that are
    registered."""
    rows = (PhoneRecording & {"session_id": session_id}).to_dicts(order_by="phone_recording DESC")
    sent = [_sent(row) for row in rows]
    judged = verdicts([one.video_id for one in sent if one.video_id is not None])
    return [(one, None if one.video_id is None else judged[one.video_id]) for one in sent]


def log_missing(session_id: int, sent: list[tuple[Sent, Usable | None]]) -> bool:
    """Return whether sensors were worn, as a phone said, and the visit has none of their logs."""
    own = (video.Video & {"session_id": session_id}).proj()
    return any(one.about.get("worn") for one, _ in sent) and not video.WearableImu & "imu_segments IS NOT NULL" & own


def filming(session_id: int) -> dict[str, Any]:
    """Return how a visit is filmed with phones: "links" that are open, without their sums; the `recordings` "sent";
    "several", whether more than one phone sent some; `log_missing`."""
    rows = (PhoneLink & {"session_id": session_id} & "link_ended IS NULL").to_dicts(order_by="phone_link DESC")
    links = [row for row in rows if row["link_expires"] > utc_now()]
    kept = ("phone_link", "link_by", "link_expires")
    sent = recordings(session_id)
    phones = {int(n) for n in (PhoneRecording & {"session_id": session_id}).to_arrays("phone_link")}
    return {
        "links": [{**{name: link[name] for name in kept}, "used": bool(link["link_phone_sha256"])} for link in links],
        "sent": sent,
        "several": len(phones) > 1,
        "log_missing": log_missing(session_id, sent),
    }


def received(number: int, video_id: int) -> None:
    """Note that a recording is registered as a video."""
    row = {"phone_recording": number, "phone_state": RECEIVED, "phone_error": "", "video_id": video_id}
    PhoneRecording.update1(row)


def refused(number: int, error: PblError) -> None:
    """Note that a recording cannot be taken, and why."""
    row = {"phone_recording": number, "phone_state": REFUSED, "phone_error": as_text(error, _LONGEST)}
    PhoneRecording.update1(row)


def not_yet(number: int, error: PblError) -> None:
    """Note that a recording could not be taken this time, for a cause outside of it, and how often."""
    before = (PhoneRecording & {"phone_recording": number}).fetch1("phone_error")
    tried = int(found[1]) + 1 if (found := _TRIED.match(before)) else 1
    PhoneRecording.update1({"phone_recording": number, "phone_error": f"{tried} x {as_text(error, _LONGEST)}"})


def upload_refused(found: str, next_step: str = "film again; if it happens again, report it") -> PblError:
    expected = f"a recording of at most {PART_BYTES * MOST_PARTS / 1e6:.0f} MB, as the page of a phone sends it"
    return PblError("UPLOAD_REFUSED", found, expected, next_step)


def _sent(row: Mapping[str, Any]) -> Sent:
    return Sent(
        number=int(row["phone_recording"]),
        session_id=int(row["session_id"]),
        sha256=row["phone_sha256"],
        video_bytes=int(row["phone_video_size"]),
        log_bytes=int(row["phone_log_size"]),
        about=row["phone_about"],
        state=row["phone_state"],
        error=stored_error(_TRIED.sub("", row["phone_error"], count=1)) if row["phone_error"] else None,
        video_id=None if row["video_id"] is None else int(row["video_id"]),
    )
