"""Filming by the browser of a phone: the links that open a phone's page, and the recordings that phones send."""

from __future__ import annotations

from . import session, video  # noqa: F401  the definitions refer to them
from .datajoint_setup import dj

schema = dj.Schema()

#: States of a recording of a phone.
UPLOADING, RECEIVED, REFUSED = "uploading", "received", "refused"


@schema
class Protocol(dj.Manual):
    definition = """
    # what is filmed in a visit; a phone's page leads through it
    protocol         : varchar(32)
    ---
    protocol_created : datetime                # when registered, UTC
    """

    class Step(dj.Part):
        definition = """
        -> master
        step_no        : int16                 # from 1, in the order of filming
        ---
        step_activity  : varchar(32)           # as in Video
        step_pace=''   : varchar(32)           # as in Pace; empty for any
        step_view      : enum('left', 'right', 'front', 'any')  # side from which the person is filmed; front: or back
        step_passes    : int16                 # recordings that are wanted
        """


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
