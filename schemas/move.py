"""A video that was registered under the wrong person or visit, put where it belongs."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label

from . import fit, gait, gdi, keypoints, lab, session, video, worker
from ._datajoint import dj
from .archive import LOCK, archive_dir, folder_of, plain_name
from .choose import unknown_video
from .codes import check_subject
from .folders import private_folder, remove_empty, sync_folders
from .ingest import Visit, forget_errors, in_transaction, session_of
from .rows import delete_below

#: Plans of a visit that follow a video into its new one.
_PLANS = (fit.FitPlan, gait.GaitPlan, gdi.GdiPlan)


@dataclasses.dataclass(frozen=True)
class Move:
    """What moving a video would change. `before` and `after` are (subject, session label); new_subject, new_session:
    it would make them; sets: keys of the fits' sets of the old visit that hold the video, which are deleted with all
    that was computed from them (`deleted`: table -> rows); left: videos that the old visit keeps."""

    video_id: int
    name: str
    path: Path
    before: tuple[str, str]
    after: tuple[str, str]
    new_subject: bool
    new_session: bool
    sets: tuple[dict[str, Any], ...]
    deleted: dict[str, int]
    left: int


def plan_move(video_id: int, subject: str, session_label: str) -> Move:
    """What `carry_out` would do; changes nothing.

    Raises
    ------
    PblError
        DB_NOT_FOUND for a number that no video has; USAGE for a subject code that could be a name, a label too long,
        or the visit that the video is in already.
    """
    check_subject(subject, "pass --to SUBJECT/SESSION with such a code")
    check_label("session", session_label, 64, 1)
    rows = (video.Video * session.Session.proj("subject", "session_label") & {"video_id": video_id}).to_dicts()
    if not rows:
        raise unknown_video(video_id)
    (row,) = rows
    if (row["subject"], row["session_label"]) == (subject, session_label):
        raise PblError(
            "USAGE",
            found=f"video_id {video_id} is in {subject}/{session_label} already",
            expected="another visit",
            next_step="nothing is to be done",
        )
    sets = (fit.FitSet & (fit.FitSet.Video & {"video_id": video_id})).keys()
    counts = dj.Diagram.cascade(fit.FitSet & list(sets), part_integrity="cascade").counts() if sets else {}
    there = {"subject": subject, "session_label": session_label}
    return Move(
        video_id,
        row["video_name"],
        Path(row["video_path"]),
        (row["subject"], row["session_label"]),
        (subject, session_label),
        not lab.Subject & {"subject": subject},
        not session.Session & there,
        tuple(sets),
        {name: n for name, n in counts.items() if n},
        len(video.Video & {"session_id": row["session_id"]}) - 1,
    )


def carry_out(plan: Move) -> None:
    """Put the video into its new visit, with the plans of the methods that it went through.

    Detection and keypoints stay: they depend on the video alone. The sets of fits that hold it are deleted with all
    that was computed from them; what is left of the old visit, and the new one, are fitted by the next populate. A
    recording in the archive goes to the folder of its new person, so that `pbl forget` finds it there.

    Raises
    ------
    PblError
        What `plan_move` raises, where rows changed since; FILE_UNWRITABLE: the recording in the archive cannot be
        moved, or another process is changing the archive. Nothing is changed then.
    """
    number = {"video_id": plan.video_id}

    def work(path: Path) -> None:
        again = plan_move(plan.video_id, *plan.after)
        old = int((video.Video & number).fetch1("session_id"))
        delete_below(fit.FitSet, again.sets)
        new = session_of(Visit(*plan.after))
        video.Video.update1({**number, "session_id": new, "video_path": str(path)})
        points = keypoints.KeypointSelection & number
        for table in _PLANS:
            rows = (table & {"session_id": old}).to_dicts()
            if "keypoint_method" in table.primary_key:
                here = set(points.to_arrays("keypoint_method"))
                rows = [row for row in rows if row["keypoint_method"] in here]
            table.insert(({**row, "session_id": new} for row in rows), skip_duplicates=True)

    with _moved_file(plan) as path:
        in_transaction(lambda: work(path))
    forget_errors(plan.video_id)


@contextlib.contextmanager
def _moved_file(plan: Move) -> Iterator[Path]:
    """Path of the recording in its new visit. One in the archive gets a name there and loses the old one at the end."""
    archive = archive_dir()
    if not plan.path.is_relative_to(archive) or not plan.path.is_file():
        yield plan.path
        return
    with worker.alone(LOCK, video.Video.connection) as obtained:
        if not obtained:
            raise _kept(plan.path, "uploads are being taken over now", "repeat this in a minute")
        names: dict[Path, Path] = {}
        try:
            folder = private_folder(folder_of(archive, "", plan.after[0]) / plain_name(plan.after[1]))
            for old in plan.path.parent.glob(f"{glob.escape(plan.path.stem)}.*"):  # its log, too
                names[old] = folder / old.name
                os.link(old, names[old])
            sync_folders(folder, archive)
        except OSError as error:
            _unlink(names.values())
            raise _kept(plan.path, error.strerror or str(error), "see that the archive can be written") from error
        try:
            yield names[plan.path]
        except BaseException:
            _unlink(names.values())
            raise
        _unlink(names)
        remove_empty(plan.path.parent, 2)


def _unlink(paths: Any) -> None:
    for path in paths:
        path.unlink(missing_ok=True)


def _kept(path: Path, found: str, next_step: str) -> PblError:
    return PblError(
        "FILE_UNWRITABLE", key=path, found=found, expected="the recording in its new folder", next_step=next_step
    )
