"""Move a video that was registered under the wrong person or visit."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label, normalised_label

from .. import fit, gait, gdi, keypoints, kinetics, lab, session, video, worker
from ..datajoint_setup import dj
from ..operations.archive import LOCK, archive_dir, busy, folder_of, plain_name
from ..operations.folders import private_folder, remove_empty, sync_folders
from ..queues import forget_errors
from ..rows import delete_below
from ..subject_codes import check_subject
from ..transactions import in_transaction
from ..video import unknown_video
from .records import VisitRecord, session_ids
from .sensors import carriers, hand_on, read_carried
from .videos import check_same_number

#: Plans of a visit that follow a video into its new one.
_PLANS = (fit.FitPlan, gait.GaitPlan, gdi.GdiPlan, kinetics.KineticsPlan)


@dataclasses.dataclass(frozen=True)
class Move:
    """Changes that moving a video would make."""

    video_id: int
    files: Mapping[int, Path]  # number -> path of the videos that move: of several cameras all of the trial
    before: tuple[str, str]  # subject, session label
    after: tuple[str, str]
    new_subject: bool  # whether it is to be made
    new_session: bool
    sets: tuple[dict[str, Any], ...]  # keys of the sets of the old visit that hold one of them: deleted
    deleted: dict[str, int]  # rows by table, with all dependent results
    left: int  # videos that the old visit keeps


def plan_move(video_id: int, subject: str, session_label: str) -> Move:
    """Return what `carry_out` would do; change nothing. Raises `PblError` DB_NOT_FOUND for a number that no video has;
    USAGE for a subject code that could be a name, a label too long, or the visit that the video is in already."""
    subject, session_label = normalised_label(subject), normalised_label(session_label)
    check_subject(subject, "pass --to SUBJECT/SESSION with such a code")
    check_label("session", session_label, 64, 1)
    there = session.as_registered({"subject": subject, "session_label": session_label})
    session_label = there["session_label"]
    rows = (video.Video * session.Session.proj("subject", "session_label") & {"video_id": video_id}).to_dicts()
    if not rows:
        raise unknown_video(video_id)
    (row,) = rows
    if (row["subject"], row["session_label"]) == (subject, session_label):
        found = f"video_id {video_id} is in {subject}/{session_label} already"
        raise PblError("USAGE", found, "another visit", "nothing is to be done")
    numbers = fit.videos_of(fit.trial_of(video_id))
    of_these = [{"video_id": v} for v in numbers]
    sets = (fit.FitSet & (fit.FitSet.Video & of_these)).keys()
    counts = dj.Diagram.cascade(fit.FitSet & list(sets), part_integrity="cascade").counts() if sets else {}
    left = len(video.Video & {"session_id": row["session_id"]}) - len(numbers)
    if fit.trials_of([video_id]):
        for found in (session.Session & there).to_dicts():
            check_same_number(int(found["session_id"]), len(numbers), Path(row["video_path"]))
    if not left and carriers(numbers):  # the sensors go along
        for found in (session.Session & there).to_dicts():
            if fits := fit.sensor_fits(int(found["session_id"])).keys():
                more = dj.Diagram.cascade(fit.SessionFit & list(fits), part_integrity="cascade").counts()
                counts = {name: counts.get(name, 0) + more.get(name, 0) for name in counts | more}
    return Move(
        video_id,
        {int(v["video_id"]): Path(v["video_path"]) for v in (video.Video & of_these).to_dicts(order_by="video_id")},
        (row["subject"], row["session_label"]),
        (subject, session_label),
        not lab.Subject & {"subject": subject},
        not session.Session & there,
        tuple(sets),
        {name: n for name, n in counts.items() if n},
        left,
    )


def carry_out(plan: Move) -> None:
    """Move the video into its new visit, with the plans of its methods.

    Detection and keypoints stay: they depend on the video alone. The sets of fits that hold it are deleted with all
    dependent results; the rest of the old visit, and the new one, are fitted by the next populate. Logs of wearable
    sensors stay at the old visit while it has another video, else they go along. A recording in the archive goes to the
    folder of its new person, so that `pbl forget` finds it there.

    Raises what `plan_move` raises, where rows changed since; FILE_UNWRITABLE: the recording in the archive
    cannot be moved; DB_REFUSED: another process is changing the archive. Nothing is changed then.
    """
    numbers = list(plan.files)
    of_these = [{"video_id": v} for v in numbers]

    def work(paths: Mapping[int, Path]) -> None:
        again = plan_move(plan.video_id, *plan.after)
        old = int((video.Video & {"video_id": plan.video_id}).fetch1("session_id"))
        delete_below(fit.FitSet, again.sets)
        (new,) = session_ids([VisitRecord(*plan.after)]).values()
        for number, path in paths.items():
            video.Video.update1({"video_id": number, "session_id": new, "video_path": str(path)})
        points = keypoints.KeypointSelection & of_these
        for table in _PLANS:
            rows = (table & {"session_id": old}).to_dicts()
            if "keypoint_method" in table.primary_key:
                here = set(points.to_arrays("keypoint_method"))
                rows = [row for row in rows if row["keypoint_method"] in here]
            table.insert(({**row, "session_id": new} for row in rows), skip_duplicates=True)
        hand_on(numbers, old, new, read)

    read = read_carried(numbers, *plan.after) if not plan.left and carriers(numbers) else []
    with _moved_files(plan) as paths:
        in_transaction(lambda: work(paths), fresh=True)
    for number in numbers:
        forget_errors(number)


@contextlib.contextmanager
def _moved_files(plan: Move) -> Iterator[Mapping[int, Path]]:
    """Yield the paths of the recordings in their new visit; one in the archive keeps its old name until the end."""
    archive = archive_dir()
    kept = [path for path in plan.files.values() if path.is_relative_to(archive) and path.is_file()]
    if not kept:
        yield plan.files
        return
    with worker.installation_lock(LOCK, video.Video.connection) as obtained:
        if not obtained:
            raise busy("repeat this in a minute", kept[0])
        names: dict[Path, Path] = {}
        try:
            folder = private_folder(folder_of(archive, "", plan.after[0]) / plain_name(plan.after[1]))
            for path in kept:
                for old in path.parent.glob(f"{glob.escape(path.stem)}.*"):  # also its log
                    names[old] = folder / old.name
                    os.link(old, names[old])
            sync_folders(folder, archive)
        except OSError as error:
            _unlink(names.values())
            found, expected = error.strerror or str(error), "the recording in its new folder"
            next_step = "see that the archive can be written"
            raise PblError("FILE_UNWRITABLE", found, expected, next_step, key=kept[0]) from error
        try:
            yield {number: names.get(path, path) for number, path in plan.files.items()}
        except BaseException:
            _unlink(names.values())
            raise
        _unlink(names)
        for folder in {path.parent for path in kept}:
            remove_empty(folder, 2)


def _unlink(paths: Any) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
