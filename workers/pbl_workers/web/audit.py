"""A row for each look at a recording, before it is shown, if PBL_AUDIT_LOOKS asks for it."""

from __future__ import annotations

import time

from pbl_schemas.decisions.review_decisions import record_viewing

from .access import Session
from .tables import Asks

#: Seconds in which repeated requests of a page (ranges of a video) count as one look.
AGAIN_S = 600.0


class Looks:
    """Record of looks; `address.Address` declares which addresses count."""

    def __init__(self, asks: Asks) -> None:
        self._asks = asks

    async def record(self, session: Session, of: str, number: int, what: str) -> None:
        """Insert a row for what is looked at, one in `AGAIN_S` for all but a page; `of`: "video_id" or "session_id".
        Raises `PblError` where it cannot be written."""
        key, now = (of, str(number), what), time.monotonic()
        if what != "page" and now - session.looked.get(key, -AGAIN_S) < AGAIN_S:
            return
        await self._asks.ask(record_viewing, of, number, what, session.name)
        session.looked[key] = now
