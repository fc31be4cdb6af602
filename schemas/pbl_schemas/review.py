"""Decisions of people, and views of recordings. Rows are added, never changed; `pbl_schemas.decisions` writes them."""

from __future__ import annotations

from . import session, video  # noqa: F401  the definition refers to them
from .datajoint_setup import dj

schema = dj.Schema()


@schema
class Decision(dj.Manual):
    definition = """
    # a decision of a person about a visit or a video: who, when, what was before
    decision_id         : int32
    ---
    -> [nullable] session.Session
    -> [nullable] video.Video
    decision_what       : varchar(16)          # its kind, such as person, check, role, score (schemas.decide)
    decision_by         : varchar(64)          # name of who decided, as the page knows it
    decision_at         : datetime             # when, UTC
    decision_about      : json                 # what it is about: names to values, by its kind
    decision_before     : json                 # what was before, likewise
    decision_after      : json                 # what was decided, likewise
    decision_reason=''  : varchar(500)         # why, in the person's words; no names
    """


@schema
class Viewing(dj.Manual):
    definition = """
    # a look at a recording, or at files of a visit, on the review page, where PBL_AUDIT_LOOKS asks for these rows
    viewing_id   : int32
    ---
    -> [nullable] session.Session
    -> [nullable] video.Video
    viewing_what : varchar(16)                 # page, video, body, overlay, report, export, ...
    viewing_by   : varchar(64)                 # name of who looked, as the page knows it
    viewing_at   : datetime                    # when, UTC; of what is asked for again and again, once in ten minutes
    """
