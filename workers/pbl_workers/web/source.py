"""Sources of visits, recordings and videos: the tables, or a folder of `pbl run` (`folder.ResultsFolder`)."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import threading
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any, Protocol

from pbl_pipeline.errors import suppress_codes
from pbl_pipeline.visit import Visit
from pbl_pipeline.words import UNUSABLE
from pbl_schemas import fit, privacy, video
from pbl_schemas.decisions import candidates, event_corrections, not_usable, review_decisions
from pbl_schemas.intake import phone_recordings, protocols
from pbl_schemas.reading import shown
from pbl_schemas.reading.usable import usual_seconds
from pbl_schemas.reading.visit_progress import Progress, visit_progress

#: De-identified copies out of a remote store that are kept on this disk at a time.
_KEPT = 8


@dataclasses.dataclass(frozen=True)
class Judged:
    """Decisions about a recording, and the state in which the page shows it. views: videos of its trial, which are
    marked together; events: those that count, None if none were searched."""

    mark: not_usable.Unusable | None
    usable_state: str
    views: int
    events: event_corrections.ShownEvents | None
    reasons: tuple[str, ...] = tuple(UNUSABLE)


def judged(video_id: int) -> Judged:
    """Return the decisions about a registered recording. Reads tables."""
    views = fit.videos_of(fit.trial_of(video_id))
    mark = not_usable.unusable([video_id]).get(video_id)
    return Judged(mark, review_decisions.usable_state(video_id), len(views), event_corrections.shown_events(video_id))


class Videos:
    """Files that are shown of recordings: the original, or the copy with hidden heads if PBL_DEIDENTIFY asks for it.

    A copy in a remote store is fetched once and kept until others, or another copy, replace it or the page ends.
    """

    def __init__(self) -> None:
        self._open = collections.OrderedDict[tuple[int, str], tuple[Path, contextlib.ExitStack]]()
        self._lock = threading.Lock()

    def path(self, video_id: int) -> Path:
        """Return the file to show. Reads tables. Raises `PblError` DB_NOT_FOUND for an unknown video or one without the
        copy that is asked for, HEAD_NOT_FOUND, VIDEO_MISSING."""
        with self._lock:
            for old in [k for k in self._open if k[0] == video_id and k[1] != privacy.copy_of(video_id)]:
                self._open.pop(old)[1].close()
            if (key := (video_id, privacy.copy_of(video_id))) in self._open:
                self._open.move_to_end(key)
                return self._open[key][0]
            stack = contextlib.ExitStack()
            copy = stack.enter_context(privacy.shown(video_id))
            if copy is None:
                return video.present_file(video_id)
            self._open[key] = (copy, stack)
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
    DB_NOT_FOUND. A source in which nothing is computed or decided inherits the last four.
    """

    def visit(self, number: int, result: int, /) -> shown.ShownVisit: ...

    def recording(self, number: int, /) -> shown.ShownRecording:
        """Return a recording; its arrays are loaded on first access."""
        ...

    def state(self, number: int, /) -> Hashable:
        """Return a value that changes with the fit of a recording. Raises `PblError` DB_NOT_FOUND without a fit."""
        ...

    def video(self, number: int) -> Path:
        """Return the video that may be shown of a recording. Raises `PblError` VIDEO_MISSING."""
        ...

    def to_export(self, number: int, result: int) -> Visit:
        """Return a computed visit. Raises `PblError` DB_NOT_FOUND if it has no result."""
        ...

    def people(self, about: shown.ShownRecording) -> tuple[Sequence[candidates.Candidates], list[str]]:
        """Return the candidates for the measured person by tracking method, and the state that is shown."""
        return [], []

    def judged(self, number: int, /) -> Judged:
        """Return the decisions about a recording."""
        return Judged(None, "", 0, None)

    def progress(self, session_id: int, /) -> Progress:
        """Return the pending computations of a visit."""
        return Progress(session_id, 0, (), ())

    def around(self, about: shown.ShownVisit) -> dict[str, Any]:
        """Return the surroundings of a visit on its page: decisions, accepted checks, entered scores."""
        return {"decisions": None, "accepted": {}, "entry": None, "film": None}

    def close(self) -> None:
        """Remove what was fetched for it."""


class TablesSource:
    """The visits of the tables."""

    def __init__(self) -> None:
        self._videos = Videos()

    visit = staticmethod(shown.shown_visit)
    recording = staticmethod(shown.shown_recording)
    state = staticmethod(shown.computations)
    judged = staticmethod(judged)
    progress = staticmethod(visit_progress)

    def video(self, number: int) -> Path:
        return self._videos.path(number)

    def to_export(self, number: int, result: int) -> Visit:
        about = shown.computed_visit(number, result)
        assert about.visit is not None
        return about.visit

    def close(self) -> None:
        self._videos.close()

    def people(self, about: shown.ShownRecording) -> tuple[Sequence[candidates.Candidates], list[str]]:
        """Return as `Source.people`; nothing before people are searched."""
        found: list[candidates.Candidates] = []
        with suppress_codes("DB_NOT_FOUND"):
            found = candidates.candidates(about.number)
        return found, [review_decisions.person_state(about.number, c.key["tracking_method"]) for c in found]

    def around(self, about: shown.ShownVisit) -> dict[str, Any]:
        from pbl_schemas.studies.visit_forms import scores_form

        number = about.row.session_id
        film = phone_recordings.filming(number)
        film |= {"usual": usual_seconds() if film["sent"] else None}
        film |= {"steps": protocols.steps_of(number, film["sent"]), "protocols": protocols.protocols()}
        return {
            "decisions": review_decisions.decisions(number),
            "accepted": review_decisions.accepted(about.key) if about.key else {},
            "entry": scores_form(number),
            "film": film,
        }
