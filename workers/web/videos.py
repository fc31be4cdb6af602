"""Videos as browsers ask for them: the file that may be shown, kept open while somebody looks."""

from __future__ import annotations

import collections
import contextlib
import threading
from pathlib import Path

from schemas import privacy, video

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
