"""Some recordings, their visits and sets: what a look at a part of the queues is restricted to."""

from __future__ import annotations

import dataclasses
from typing import Any

from .. import fit, video


@dataclasses.dataclass(frozen=True)
class Scope:
    """Recordings and sessions. current: of their sets only those that count."""

    videos: list[int]
    sessions: list[int]
    current: bool = False

    def where(self, table: Any) -> str | None:
        """Condition on the first column of a table's key; None where nothing of it belongs to these."""
        if "fit_set" not in table.heading.primary_key:
            return f"video_id in ({','.join(map(str, self.videos))})" if self.videos else None
        rows: Any = fit.FitSet & f"session_id in ({','.join(map(str, self.sessions))})" if self.sessions else None
        if rows is not None and self.current:
            rows = rows & fit.current().proj()
        sets = [] if rows is None else [str(s) for s in rows.to_arrays("fit_set")]
        return "fit_set in (" + ",".join(f"'{s}'" for s in sets) + ")" if sets else None


def of_visit(session_id: int) -> Scope:
    """The usable recordings of a visit and its current sets."""
    usable = (video.Video & {"session_id": int(session_id)}) - video.NotUsable
    return Scope(sorted(int(v) for v in usable.to_arrays("video_id")), [int(session_id)], current=True)
