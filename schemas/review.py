"""What people decided on the review page. Rows are added, never changed; `schemas.decide` writes them."""

from __future__ import annotations

from . import session, video  # noqa: F401  the definition refers to them
from ._datajoint import dj

schema = dj.Schema()


@schema
class Decision(dj.Manual):
    definition = """
    # a decision of a person about a visit or a video: who, when, what was before
    decision_id         : int32
    ---
    -> [nullable] session.Session
    -> [nullable] video.Video
    decision_what       : enum('person', 'check')  # who is measured in a video; a check of a visit that is accepted
    decision_by         : varchar(64)          # name of who decided, as the page knows it
    decision_at         : datetime             # when, UTC
    decision_about      : json                 # tracking_method; key of SessionQc, its time, the check and its video
    decision_before     : json                 # person, null for none, and status of the choice; outcome of the check
    decision_after      : json                 # likewise
    decision_reason=''  : varchar(500)         # why, in the person's words; no names
    """
