"""Activity and pace of a registered video: how they are changed, and what a change makes outdated."""

from __future__ import annotations

from .. import fit, gait, gdi, video
from ..rows import counted, delete_below


def set_condition(video_id: int, activity: str | None = None, pace: str | None = None) -> list[str]:
    """State activity or pace of a registered video (None: as it is), of one of several cameras for all of the trial's;
    returns what changed, in words.

    Where a session's measures pool the video now and did not before, or the other way round, they are deleted, so that
    the next populate computes them anew; likewise the measures of a video that is or was one of a task. Call it inside
    a transaction.

    Raises `PblError` DB_NOT_FOUND for an unknown number; USAGE for labels of more than 32 characters.
    """
    videos = fit.videos_of(fit.trial_of(video_id))
    return list(dict.fromkeys(change for v in videos for change in _set_condition(v, activity, pace)))


def _set_condition(video_id: int, activity: str | None, pace: str | None) -> list[str]:
    from pbl_pipeline.gait import TASK_MEASURES, Condition

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
    of_task = after.activity != before.activity and not {before.activity, after.activity}.isdisjoint(TASK_MEASURES)
    made = (gait.Spatiotemporal & key).keys() if of_task else []
    if rows := counted(delete_below(gait.Spatiotemporal, made)):
        changes.append(f"measures of the task were deleted: {rows}")
    if after.pool != before.pool:
        sets = fit.FitSet & (fit.FitSet.Video & key).proj()
        if rows := counted(delete_below(gdi.SessionGdi, (gdi.SessionGdi & sets).keys())):
            changes.append(f"what pooled it was deleted: {rows}")
    return changes
