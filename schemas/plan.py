"""Which trials of a session are fitted together, decided by query."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from . import fit, keypoints, tracking, video
from ._base import dj, utc_now

#: What one fit is for: a session, seen through one chain of methods.
GROUP = ("session_id", "tracking_method", "keypoint_method", "fit_method")


def plan_fit_sets() -> list[dict[str, Any]]:
    """Make a FitSet for every session whose trials are all decided and not yet in a current set.

    A trial is decided when it can be fitted (TrialInput), failed, shows nobody, or waits for a person's choice. While
    another trial of the session is still being computed, nothing is planned: otherwise every single video of a visit
    would trigger a fit of its own. A later video (or choice) makes a new set; the old set and its fit stay, no longer
    current.

    Returns
    -------
    list of dict
        fit_set and fit_method of the sets that became current now.
    """
    fitted = (fit.FitSet.Video * (fit.FitSelection & {"fit_current": True})).proj("tracking_method", "keypoint_method")
    in_a_set = dj.U("video_id", "tracking_method", "keypoint_method", "fit_method") & fitted
    new = fit.TrialInput.proj() * video.Video.proj("session_id") - in_a_set
    sessions = sorted({int(s) for s in new.to_arrays("session_id")})
    made = []
    for session_id in sessions:
        made += _plan_session(session_id)
    return made


def _plan_session(session_id: int) -> list[dict[str, Any]]:
    videos = video.Video & {"session_id": session_id}
    selected = (keypoints.KeypointSelection.proj() * videos.proj("session_id")) * fit.FitPlan.proj()
    ready = (
        fit.TrialInput.proj()
        * videos.proj("session_id", "video_sha256")
        * keypoints.Keypoints.proj("keypoints_person_id")
    )
    ready_by_group: dict[tuple, list[dict]] = defaultdict(list)
    for row in ready.to_dicts(order_by="video_id"):
        ready_by_group[tuple(row[k] for k in GROUP)].append(row)
    decided = _decided(videos)
    waiting = set()
    for row in selected.to_dicts():
        group = tuple(row[k] for k in GROUP)
        is_ready = any(r["video_id"] == row["video_id"] for r in ready_by_group.get(group, ()))
        if not is_ready and not decided(row):
            waiting.add(group)
    made = []
    for group, rows in ready_by_group.items():
        if group not in waiting:
            made += _make_set(dict(zip(GROUP, group, strict=True)), rows)
    return made


def _make_set(group: Mapping[str, Any], rows: list[dict]) -> list[dict[str, Any]]:
    name = fit_set_hash(group, rows)
    selection = {"fit_set": name, "fit_method": group["fit_method"]}
    if fit.FitSelection & selection & {"fit_current": True}:
        return []
    connection = fit.schema.connection
    assert connection is not None
    with connection.transaction:
        fit.FitSet.insert1(
            {
                "fit_set": name,
                "session_id": group["session_id"],
                "fit_set_n": len(rows),
                "fit_set_created": utc_now(),
            },
            skip_duplicates=True,
        )
        member = ("video_id", "tracking_method", "keypoint_method")
        fit.FitSet.Video.insert(
            ({"fit_set": name, **{k: row[k] for k in member}} for row in rows), skip_duplicates=True
        )
        for older in _older_sets(group, name):
            fit.FitSelection.update1({**older, "fit_current": False})
        # Another process may have planned the same set in the meantime.
        fit.FitSelection.insert1({**selection, "fit_current": True}, skip_duplicates=True)
        fit.FitSelection.update1({**selection, "fit_current": True})
    return [selection]


def _older_sets(group: Mapping[str, Any], name: str) -> list[dict]:
    """Current selections of the same session, methods and fit method, other than `name`."""
    same = {"tracking_method": group["tracking_method"], "keypoint_method": group["keypoint_method"]}
    sets = (fit.FitSet & {"session_id": group["session_id"]}) & (fit.FitSet.Video & same).proj()
    current = fit.FitSelection & {"fit_method": group["fit_method"], "fit_current": True}
    keys = (current & sets.proj()).keys()
    return [k for k in keys if k["fit_set"] != name]


def fit_set_hash(group: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]) -> str:
    """16 hex digits over the session, the methods up to the keypoints, and each video's bytes and person."""
    lines = [str(group[k]) for k in GROUP[:3]]
    lines += sorted(f"{row['video_sha256']} person {row['keypoints_person_id']}" for row in rows)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _decided(videos: Any) -> Any:
    """A test of a selection row: True when it will not give keypoints by itself (failed, nobody, must be chosen)."""
    ids = {int(v) for v in videos.to_arrays("video_id")}
    stopped: list[dict] = []
    for table in (video.VideoInfo, tracking.Tracking, tracking.SubjectChoice, keypoints.Keypoints, fit.TrialInput):
        failed = table.jobs.errors.keys()
        stopped += [k for k in failed if int(k["video_id"]) in ids]
    unchosen = (tracking.SubjectChoice & videos) - [{"choice_status": s} for s in tracking.CHOSEN]
    stopped += list(unchosen.keys())

    def test(row: Mapping[str, Any]) -> bool:
        return any(all(row[k] == v for k, v in key.items()) for key in stopped)

    return test
