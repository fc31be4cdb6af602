"""Record of who viewed which recording: rows that the review page writes where PBL_AUDIT_LOOKS asks for them."""

from __future__ import annotations

from .. import session, video
from ..review import Viewing
from ..rows import utc_now
from ..transactions import in_transaction, next_id


def record_viewing(of: str, number: int, what: str, by: str) -> None:
    """Insert a row of Viewing. An unknown number inserts nothing.

    `of`, `number`: "video_id" or "session_id", and which. `what`: part of it that is viewed, such as "video" or
    "report".
    """
    table = {"video_id": video.Video, "session_id": session.Session}[of]
    if not table & {of: number}:
        return
    row = {of: number, "viewing_what": what[:16], "viewing_by": by[:64], "viewing_at": utc_now()}
    in_transaction(lambda: Viewing.insert1({"viewing_id": next_id(Viewing, "viewing_id"), **row}))
