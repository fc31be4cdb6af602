"""Recordings that a person marked as not usable, and why; `review_decisions` marks them."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterable
from typing import Any

from pbl_pipeline.words import UNUSABLE

from .. import video
from ..rows import inside, parts


@dataclasses.dataclass(frozen=True)
class Unusable:
    """A recording that is marked as not usable. reason: one of `words.UNUSABLE`; note: details."""

    video_id: int
    reason: str
    note: str
    by: str
    at: datetime.datetime

    @property
    def text(self) -> str:
        """Return the reason in words."""
        said = UNUSABLE[self.reason]
        return self.note if self.reason == "other" and self.note else f"{said} ({self.note})" if self.note else said


def unusable(videos: Iterable[int]) -> dict[int, Unusable]:
    """Return the marks of these recordings by number."""
    return {m.video_id: m for some in parts(videos) for m in _marks(inside("video_id", map(int, some)))}


def all_unusable(most: int = 200) -> list[Unusable]:
    """Return all marked recordings, newest first."""
    return _marks(True, order_by="unusable_created DESC, video_id", limit=most)


def _marks(keys: Any, **options: Any) -> list[Unusable]:
    return [
        Unusable(int(r["video_id"]), *(r[f"unusable_{k}"] for k in ("reason", "note", "by", "created")))
        for r in (video.NotUsable & keys).to_dicts(**options)
    ]
