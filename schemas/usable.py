"""Recordings that a person marked as not usable, and why; `schemas.decide` marks them."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterable
from typing import Any

from . import video

#: The reasons in words, for texts in English.
REASONS = {
    "not_in_view": "the person is not in view, or only in part",
    "too_dark": "too dark or blurred",
    "camera_moved": "the camera was moved, or stood badly",
    "other_person": "somebody else is filmed",
    "other_task": "another task than the registered one",
    "helped": "the person was held or led",
    "interrupted": "the walk was interrupted",
    "duplicate": "the same walk as in another recording",
    "other": "another reason",
}


@dataclasses.dataclass(frozen=True)
class Unusable:
    """A recording that is marked as not usable. reason: one of `video.UNUSABLE_REASONS`; note: more of it."""

    video_id: int
    reason: str
    note: str
    by: str
    at: datetime.datetime

    @property
    def text(self) -> str:
        """Why, in words."""
        said = REASONS[self.reason]
        return self.note if self.reason == "other" and self.note else f"{said} ({self.note})" if self.note else said


def unusable(videos: Iterable[int]) -> dict[int, Unusable]:
    """Those of these recordings that are marked, by number."""
    keys = [{"video_id": int(v)} for v in videos]
    return {m.video_id: m for m in _marks(keys)} if keys else {}


def all_unusable(most: int = 200) -> list[Unusable]:
    """Every recording that is marked, the last first."""
    return _marks(True, order_by="unusable_created DESC, video_id", limit=most)


def _marks(keys: Any, **options: Any) -> list[Unusable]:
    return [
        Unusable(int(r["video_id"]), *(r[f"unusable_{k}"] for k in ("reason", "note", "by", "created")))
        for r in (video.NotUsable & keys).to_dicts(**options)
    ]
