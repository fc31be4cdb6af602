"""What is done in a video and at which pace, and how tall a person is: how it is changed, and what a change makes
outdated."""

from __future__ import annotations

from typing import Any

from . import fit, gdi, lab, session, video
from .rows import delete_below, number


def set_condition(video_id: int, activity: str | None = None, pace: str | None = None) -> list[str]:
    """State activity or pace of a registered video (None: as it is), of one of several cameras for all of the trial's;
    returns what changed, in words.

    Where a session's measures pool the video now and did not before, or the other way round, they are deleted, so that
    the next populate computes them anew. Call it inside a transaction.

    Raises
    ------
    PblError
        DB_NOT_FOUND for a number that no video has; USAGE for labels of more than 32 characters.
    """
    videos = fit.videos_of(fit.trial_of(video_id))
    return list(dict.fromkeys(change for v in videos for change in _set_condition(v, activity, pace)))


def _set_condition(video_id: int, activity: str | None, pace: str | None) -> list[str]:
    from pbl_pipeline.gait import Condition

    key = {"video_id": video_id}
    before = video.conditions(key).get(video_id)
    if before is None:
        raise video.unknown_video(video_id)
    changes = []
    after = Condition(before.activity if activity is None else activity, before.pace if pace is None else pace)
    if activity is not None and after.activity != before.activity:
        video.Video.update1({**key, "activity": activity})
        changes.append(f"activity is {activity} now")
    if after.pace != before.pace:
        video.Pace.insert1({**key, "pace": after.pace}, replace=True)
        changes.append(f"pace is {after.pace} now")
    if after.pool != before.pool and (deleted := _delete_pooled(key)):
        rows = ", ".join(f"{n} of {name}" for name, n in deleted.items())
        changes.append(f"what pooled it was deleted: {rows}")
    return changes


def _delete_pooled(key: dict[str, Any]) -> dict[str, int]:
    sets = (fit.FitSet.Video & key).proj()
    return delete_below(gdi.SessionGdi, (gdi.SessionGdi & (fit.FitSet & sets)).keys())


def set_height(subject: str, height_m: float | None) -> list[str]:
    """State the body height (m) of a registered person (None: as it is); returns what changed, in words.

    Fits of videos of one camera that were told another height are deleted with what was computed from them, so that the
    next populate computes them anew. Call it inside a transaction.
    """
    key = {"subject": subject}
    if height_m is None or number((lab.Subject & key).fetch1("subject_height")) == height_m:
        return []
    lab.Subject.update1({**key, "subject_height": height_m})
    changes = [f"height of {subject} is {height_m:g} m now"]
    sets = fit.FitSet & {"fit_set_kind": fit.SINGLE} & (session.Session & key).proj()
    if deleted := delete_below(fit.SessionFit, (fit.SessionFit & sets.proj()).keys()):
        rows = ", ".join(f"{n} of {name}" for name, n in deleted.items())
        changes.append(f"what was fitted without it was deleted: {rows}")
    return changes
