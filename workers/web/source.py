"""Where visits, recordings and videos come from: the tables, or a folder of `pbl run` (`folder.ResultsFolder`)."""

from __future__ import annotations

import collections
import contextlib
import threading
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any, Protocol

from pbl_pipeline.errors import PblError
from pbl_pipeline.visit import Visit
from schemas import privacy, video
from schemas.decisions import candidates, review_decisions
from schemas.intake import phone_recordings, protocols
from schemas.reading import shown
from schemas.reading.usable import usable
from schemas.reading.visit_progress import Progress, visit_progress

from .corrections import Judged, judged

#: De-identified copies out of a remote store that are kept on this disk at a time.
_KEPT = 8


class Videos:
    """Which file is shown of a recording: the original, or the copy with hidden heads where PBL_DEIDENTIFY asks for it.

    A copy in a remote store is fetched once and kept until others took its place or the page ends.
    """

    def __init__(self) -> None:
        self._open: collections.OrderedDict[int, tuple[Path, contextlib.ExitStack]] = collections.OrderedDict()
        self._lock = threading.Lock()

    def path(self, video_id: int) -> Path:
        """The file to show. Reads tables.

        Raises `PblError` DB_NOT_FOUND for an unknown video or one without the copy that is asked for, HEAD_NOT_FOUND,
        VIDEO_MISSING.
        """
        with self._lock:
            if video_id in self._open:
                self._open.move_to_end(video_id)
                return self._open[video_id][0]
            stack = contextlib.ExitStack()
            copy = stack.enter_context(privacy.shown(video_id))
            if copy is None:
                return video.present_file(video_id)
            self._open[video_id] = (copy, stack)
            while len(self._open) > _KEPT:
                self._open.popitem(last=False)[1][1].close()
            return copy

    def close(self) -> None:
        """Remove what was fetched."""
        with self._lock:
            for _, stack in self._open.values():
                stack.close()
            self._open.clear()


class Source(Protocol):
    """Visits and recordings by their numbers, for the pages that both sources have.

    All methods may be slow: they are called away from the loop that answers browsers. An unknown number is a `PblError`
    DB_NOT_FOUND.
    """

    def visit(self, number: int, result: int) -> shown.ShownVisit: ...

    def recording(self, number: int) -> shown.ShownRecording:
        """Return a recording; its arrays are loaded when they are asked for."""
        ...

    def state(self, number: int) -> Hashable:
        """Return what tells apart what was fitted to a recording. Raises `PblError` DB_NOT_FOUND without a fit."""
        ...

    def video(self, number: int) -> Path:
        """Return the video that may be shown of a recording. Raises `PblError` VIDEO_MISSING."""
        ...

    def to_export(self, number: int, result: int) -> Visit:
        """Return a computed visit. Raises `PblError` DB_NOT_FOUND where it has no result."""
        ...

    def people(self, about: shown.ShownRecording) -> tuple[Sequence[candidates.Candidates], list[str]]:
        """Return who can be chosen, by tracking method, and the state in which that is shown."""
        ...

    def judged(self, number: int) -> Judged:
        """Return what people decided about a recording."""
        ...

    def progress(self, session_id: int) -> Progress:
        """Return what is still to be computed of a visit."""
        ...

    def around(self, about: shown.ShownVisit) -> dict[str, Any]:
        """Return what the page of a visit shows around it: decisions, accepted checks, entered scores."""
        ...


class TablesSource:
    """The visits of the tables."""

    def __init__(self, videos: Videos) -> None:
        self._videos = videos

    def visit(self, number: int, result: int) -> shown.ShownVisit:
        return shown.shown_visit(number, result)

    def recording(self, number: int) -> shown.ShownRecording:
        return shown.shown_recording(number)

    def state(self, number: int) -> Hashable:
        return shown.computations(number)

    def video(self, number: int) -> Path:
        return self._videos.path(number)

    def to_export(self, number: int, result: int) -> Visit:
        about = shown.computed_visit(number, result)
        assert about.visit is not None
        return about.visit

    def people(self, about: shown.ShownRecording) -> tuple[Sequence[candidates.Candidates], list[str]]:
        """None before people are searched."""
        try:
            found = candidates.candidates(about.number)
        except PblError as error:
            if error.code != "DB_NOT_FOUND":
                raise
            return [], []
        return found, [review_decisions.person_state(about.number, c.key["tracking_method"]) for c in found]

    def judged(self, number: int) -> Judged:
        return judged(number)

    def progress(self, session_id: int) -> Progress:
        return visit_progress(session_id)

    def around(self, about: shown.ShownVisit) -> dict[str, Any]:
        from schemas.studies.visit_forms import entry

        number = about.row.session_id
        return {
            "decisions": review_decisions.decisions(number),
            "accepted": review_decisions.accepted(about.key) if about.key else {},
            "entry": entry(number),
            "film": _filming(number),
        }


def _filming(session_id: int) -> dict[str, Any]:
    found = phone_recordings.filming(session_id)
    sent = [(one, None if one.video_id is None else usable(one.video_id)) for one in found["sent"]]
    return {**found, "sent": sent, "steps": protocols.steps_of(session_id), "protocols": protocols.protocols()}
