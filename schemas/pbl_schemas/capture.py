"""Filming by the browser of a phone: the links that open a phone's page, and the recordings that phones send."""

from __future__ import annotations

from pbl_pipeline.records import column, record

from . import session, video  # noqa: F401  the definitions refer to them
from .datajoint_setup import dj
from .record_parts import part_of

schema = dj.Schema()

#: States of a recording of a phone.
UPLOADING, RECEIVED, REFUSED = "uploading", "received", "refused"


@record
class ProtocolStep:
    """A step of a visit's protocol. done: recordings that are usable; waiting: those without a verdict yet."""

    number: int = column("step_no", "from 1, in the order of filming", "int16", key=True)
    activity: str = column("step_activity", "as in Video", "varchar(32)")
    pace: str = column("step_pace", "as in Pace; empty for any", "varchar(32)", old="")
    view: str = column(
        "step_view",
        "side from which the person is filmed; front: or back",
        "enum('left', 'right', 'front', 'any')",
    )
    passes: int = column("step_passes", "recordings that are wanted", "int16")
    done: int = 0
    waiting: int = 0

    @property
    def complete(self) -> bool:
        """True if the visit has all of its passes."""
        return self.done >= self.passes


@schema
class Protocol(dj.Manual):
    definition = """
    # what is filmed in a visit; a phone's page leads through it
    protocol         : varchar(32)
    ---
    protocol_created : datetime                # when registered, UTC
    """

    Step = part_of("Step", ProtocolStep)


@schema
class PhoneLink(dj.Manual):
    definition = """
    # a link by which one phone films for one visit; it opens nothing after its time, or once it was ended
    phone_link           : int32
    ---
    -> session.Session
    -> [nullable] Protocol
    link_key_sha256      : char(64)            # of the key in the link, which itself is kept nowhere
    link_phone_sha256='' : varchar(64)         # of the cookie of the phone that opened it first; empty before
    link_by              : varchar(64)         # name of who made it, as the page or the command knows it
    link_created         : datetime            # when, UTC
    link_expires         : datetime            # when it ends by itself, UTC
    link_ended=null      : datetime            # when a person ended it, UTC
    unique index (link_key_sha256)
    """


@schema
class PhoneRecording(dj.Manual):
    definition = f"""
    # a recording that a phone sends, in parts, with its sensor log behind it
    phone_recording    : int32
    ---
    -> session.Session
    -> PhoneLink
    -> [nullable] video.Video
    phone_sha256       : char(64)              # of the SHA-256 sums of its parts: the same recording has one number
    phone_video_size   : int64                 # (byte) length of the video
    phone_log_size     : int64                 # (byte) length of the sensor log, 0 without one
    phone_about        : json                  # what the phone states: activity, pace, aid, note, dropped frames
    phone_state        : enum('{UPLOADING}', '{RECEIVED}', '{REFUSED}')
    phone_error=''     : varchar(1000)         # code of the error and what was found, of one that was refused
    phone_created      : datetime              # when its upload began, UTC
    unique index (session_id, phone_sha256)
    """
