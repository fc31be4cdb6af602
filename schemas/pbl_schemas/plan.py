"""By which method keypoints are fitted, and which trials of a session together, decided by query."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from pbl_pipeline import methods
from pbl_pipeline.errors import suppress_codes

from . import fit_sets as fit
from . import keypoints, session, tracking, video
from .datajoint_setup import dj
from .jobs import jobs_of
from .method_rows import method_row, resolve_method
from .rows import grouped, inside, utc_now
from .transactions import read_committed, repeated

#: Columns of one fit: recordings of one kind of a session, seen through one chain of methods.
GROUP = ("session_id", "tracking_method", "keypoint_method", "fit_method", "fit_set_kind")


def default_fit(keypoint_method: str) -> str:
    """Return the key of the fit method for keypoints of this method (a key) where none is named: as `pbl run` chooses.
    Raises `PblError` MODEL_MISSING, MODEL_INVALID if the method's model is not registered on this machine."""
    from pbl_pipeline.fit import default_fit as suited

    row = method_row(keypoints.KeypointMethod, {"keypoint_method": keypoint_method})
    return resolve_method(fit.FitMethod, suited(methods.stored(**row).params.points()))


def unsuited(fit_method: str, keypoint_method: str | None) -> str:
    """Return a warning if a fit method (key) was made for other points than those of a keypoint method (key; None:
    markers of a laboratory); "" if not, or if the keypoint method's model is not on this machine."""
    from pbl_pipeline.fit import unsuited as compare

    name = method_row(fit.FitMethod, {"fit_method": fit_method})["name"]
    if keypoint_method is None:
        return compare(name, None)
    row = method_row(keypoints.KeypointMethod, {"keypoint_method": keypoint_method})
    with suppress_codes("MODEL_MISSING", "MODEL_INVALID"):
        return compare(name, methods.stored(**row).params.points())
    return ""


def plan_fits(selected: Sequence[Mapping[str, Any]], fit_method: str) -> None:
    """Plan this fit for rows of KeypointSelection, in sessions that have no plan for such keypoints."""
    of_session = keypoints.KeypointSelection.proj() * video.Video.proj("session_id") & list(selected)
    unplanned = (dj.U("session_id", "keypoint_method") & of_session) - fit.FitPlan.proj()
    fit.FitPlan.insert(({**row, "fit_method": fit_method} for row in unplanned.to_dicts()), skip_duplicates=True)


def plan_fit_sets(sessions: Iterable[int] | None = None) -> list[dict[str, Any]]:
    """Make a FitSet for every session whose trials are all decided and not yet in a current set, one for its trials of
    several cameras, and one for its marker recordings (MarkerPlan): these are never fitted together.

    A trial is decided when it can be fitted (TrialInput), failed, shows no one, or waits for a person's choice. While
    another trial of the session is still being computed, nothing is planned: otherwise every video of a visit would
    trigger a separate fit. A later video (or choice) makes a new set; the old set and its fit stay, no longer
    current. A recording that is marked as not usable (`video.NotUsable`) takes no part, and sets with it cease to be
    current. Workers take turns at a session, and where several sets of it are current all but one cease to be.

    Returns `fit_set` and `fit_method` of the sets that became current now.

    `sessions`: session_id of those to look at (None: all; that reads whole tables).
    """
    chosen = True if sessions is None else inside("session_id", map(int, sessions))
    current = fit.current() & (fit.FitSet & chosen)
    fitted = (fit.FitSet.Video * current).proj("tracking_method", "keypoint_method")
    in_a_set = dj.U("video_id", "tracking_method", "keypoint_method", "fit_method") & fitted
    usable = (video.Video.proj("session_id") & chosen) - video.NotUsable
    new = _lacking(fit.TrialInput.proj() * usable, in_a_set)
    in_a_set = dj.U("video_id", "fit_method") & (fit.FitSet.Video * current)
    new_markers = _lacking(fit.MarkerPlan.proj() * usable, in_a_set)
    of_kind = current * fit.FitSet.proj("session_id", "fit_set_kind")
    by_method = dj.U("session_id", "fit_method", "fit_set_kind").aggr(of_kind, n_current="count(*)")
    several = (by_method & "n_current > 1").proj()
    marked = fit.FitSet.proj("session_id") & (_with_unusable() & current)
    others = {int(s) for found in (several, marked) for s in found.to_arrays("session_id")}
    failed = queues_before_fit()
    made = []
    for session_id in sorted(new | new_markers | others):
        made += _plan_locked(session_id, failed)
    return made


def _lacking(wanted: Any, there: Any) -> set[int]:
    """Return the sessions of rows that the other query lacks. It is joined: as NOT IN a server that knows little of the
    tables yet reads it anew for each row."""
    names = ", ".join(there.heading.names)
    there = f"SELECT {names}, 1 AS is_there FROM ({there.make_sql()}) AS t"  # noqa: S608  names are DataJoint's own
    rows = fit.FitSet.connection.query(
        f"SELECT DISTINCT session_id FROM ({wanted.make_sql()}) AS w LEFT JOIN ({there}) AS t USING ({names})"  # noqa: S608
        " WHERE is_there IS NULL"
    )
    return {int(s) for (s,) in rows.fetchall()}


@repeated
def _plan_locked(session_id: int, failed: Sequence[Any]) -> list[dict[str, Any]]:
    with locked(session_id):
        return plan_anew(session_id, failed)


def queues_before_fit() -> list[Any]:
    """Queues whose error rows decide that a trial does not take part in a fit. Declares them, which ends a transaction
    that is open: ask before `locked`."""
    stages = (video.VideoInfo, tracking.Tracking, tracking.SubjectChoice, keypoints.Keypoints, fit.TrialInput)
    return [jobs_of(table) for table in stages]


def plan_anew(session_id: int, failed: Sequence[Any]) -> list[dict[str, Any]]:
    """Plan one session as `plan_fit_sets` does, inside `locked`; `failed`: `queues_before_fit`."""
    outdated = fit.current() & (_with_unusable() & {"session_id": session_id})
    for key in outdated.proj().to_dicts():
        fit.FitSelection.update1({**key, "fit_current": False})
    _keep_one_current(session_id)
    return _plan_session(session_id, failed) + _plan_markers(session_id)


def _with_unusable() -> Any:
    return fit.FitSet.proj("session_id") & (fit.FitSet.Video & video.NotUsable).proj()


@contextmanager
def locked(session_id: int) -> Iterator[None]:
    """A transaction in which no other process plans this session and every query sees what others have committed.

    Two workers that see different trials ready would otherwise both make their set the current one.
    """
    with read_committed(fit.schema.connection):
        session.lock(session_id)
        yield


def _keep_one_current(session_id: int) -> None:
    """Keep the largest of several current sets of a group current; of equally large ones the newest."""
    member = fit.FitSet.Video.proj("tracking_method", "keypoint_method")
    sets = fit.FitSet.proj("session_id", "fit_set_kind", "fit_set_n", "fit_set_created") & {"session_id": session_id}
    rows = (fit.current() * sets).to_dicts(order_by="fit_set_n DESC, fit_set_created DESC")
    kept = set()
    for row in rows:
        methods = (member & {"fit_set": row["fit_set"]}).to_dicts(limit=1)[0]
        group = tuple({**methods, **row}[k] for k in GROUP)
        if group in kept:
            fit.FitSelection.update1({k: row[k] for k in fit.FitSelection.primary_key} | {"fit_current": False})
        kept.add(group)


def _plan_session(session_id: int, failed: Sequence[Any]) -> list[dict[str, Any]]:
    videos = (video.Video & {"session_id": session_id}) - video.NotUsable
    selected = (keypoints.KeypointSelection.proj() * videos.proj("session_id")) * fit.FitPlan.proj()
    views = {int(r["video_id"]): r for r in (video.RigView * video.Rig.proj("rig_sha256") & videos.proj()).to_dicts()}
    ready_by_group: dict[tuple, list[dict]] = defaultdict(list)
    trials_by_group: dict[tuple, set[int]] = defaultdict(set)
    for row in _members(videos, views):
        ready_by_group[group := tuple(row[k] for k in GROUP)].append(row)
        trials_by_group[group].add(_trial_of(row))
    decided = _decided(videos, failed)
    # Of several cameras one that gives no keypoints decides that the trial does not take part.
    undecided: dict[tuple, dict[int, bool]] = defaultdict(dict)
    for row in selected.to_dicts():
        row |= _of_view(row, views)
        group, trial = tuple(row[k] for k in GROUP), _trial_of(row)
        if trial not in trials_by_group[group]:
            undecided[group][trial] = undecided[group].get(trial, True) and not decided(row)
    waiting = {group for group, trials in undecided.items() if any(trials.values())}
    made = []
    for group, rows in ready_by_group.items():
        if group not in waiting:
            made += _make_set(dict(zip(GROUP, group, strict=True)), rows)
    return made


def _members(videos: Any, views: Mapping[int, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The videos of a session's trials that can be fitted, of all cameras where there are several, with methods, bytes,
    person and kind, and of one of several cameras (`views`) with its columns of RigView."""
    about = videos.proj("session_id", "video_sha256") * keypoints.Keypoints.proj("keypoints_person_id")
    rows = (fit.TrialInput.proj() * about).to_dicts(order_by="video_id")
    rows = [row for row in rows if row["video_id"] not in views]
    if views:
        seen = fit.TrialInput.View.proj(trial="video_id", video_id="view_video_id")
        rows += (seen * about).to_dicts(order_by="video_id")
    sha256 = {row["video_id"]: row["video_sha256"] for row in rows}
    rows = [{**row, **_of_view(row, views)} for row in rows]
    return [{**row, "trial_sha256": sha256[_trial_of(row)]} for row in rows]


def _of_view(row: Mapping[str, Any], views: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """The kind of set that a video belongs to, and its columns of RigView and Rig."""
    view = views.get(int(row["video_id"]))
    return {"fit_set_kind": fit.RIG if view else fit.SINGLE, **(view or {})}


def _trial_of(row: Mapping[str, Any]) -> int:
    """The number of the trial that a video is of: its own unless it is one of several cameras."""
    return int(row.get("rig_trial", row["video_id"]))


def _plan_markers(session_id: int) -> list[dict[str, Any]]:
    """Marker recordings make separate sets, never with a video: one fit method's, all those of the session.

    They were found fit to be used when they were registered, so none is waited for.
    """
    columns = ("recording_marker_set", "marker_table_sha256")
    videos = (video.Video.proj("session_id", "video_sha256") & {"session_id": session_id}) - video.NotUsable
    rows = (fit.MarkerPlan.proj() * video.MarkerRecording.proj(*columns) * videos).to_dicts(order_by="video_id")
    by_method = grouped((r["fit_method"], {**r, "tracking_method": None, "keypoint_method": None}) for r in rows)
    made = []
    for method, rows in by_method.items():
        made += _make_set(dict(zip(GROUP, (session_id, None, None, method, fit.MARKERS), strict=True)), rows)
    return made


def _make_set(group: Mapping[str, Any], rows: list[dict]) -> list[dict[str, Any]]:
    name = fit_set_hash(group, rows)
    selection = {"fit_set": name, "fit_method": group["fit_method"]}
    if fit.FitSelection & selection & {"fit_current": True}:
        return []
    about = {k: group[k] for k in ("session_id", "fit_set_kind")}
    fit.FitSet.insert1(
        {"fit_set": name, **about, "fit_set_n": len(rows), "fit_set_created": utc_now()}, skip_duplicates=True
    )
    member = ("video_id", "tracking_method", "keypoint_method")
    fit.FitSet.Video.insert(({"fit_set": name, **{k: row[k] for k in member}} for row in rows), skip_duplicates=True)
    same = {"tracking_method": group["tracking_method"], "keypoint_method": group["keypoint_method"]}
    sets = (fit.FitSet & about) & (fit.FitSet.Video & same).proj()
    of_group = fit.current() & {"fit_method": group["fit_method"]} & sets.proj()
    for older in (of_group - {"fit_set": name}).proj().to_dicts():
        fit.FitSelection.update1({**older, "fit_current": False})
    fit.FitSelection.insert1({**selection, "fit_current": True}, skip_duplicates=True)
    fit.FitSelection.update1({**selection, "fit_current": True})
    return [selection]


def fit_set_hash(group: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]) -> str:
    """16 hex digits over the session, the methods up to the keypoints, and each video's bytes and person (of several
    cameras also trial, camera and calibration; each marker recording's bytes and marker set)."""
    lines = [str(group[k]) for k in GROUP[:3]]
    lines += sorted(f"{row['video_sha256']} {_measured(row)}" for row in rows)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _measured(row: Mapping[str, Any]) -> str:
    if "recording_marker_set" in row:
        return f"markers {row['recording_marker_set']} {row['marker_table_sha256']}".rstrip()
    said = f"person {row['keypoints_person_id']}"
    if "rig_camera" in row:
        said += f" trial {row['trial_sha256']} camera {row['rig_camera']} of {row['rig_sha256']}"
    return said


def _decided(videos: Any, failed: Sequence[Any]) -> Any:
    """Return a test of a selection row: True if it will not give keypoints (failed, no one there, must be chosen)."""
    ids = inside("video_id", map(int, videos.to_arrays("video_id")))
    stopped: list[dict] = []
    for jobs in failed:
        stopped += list((jobs.errors & ids).keys())
    unchosen = (tracking.SubjectChoice & videos) - [{"choice_status": s} for s in tracking.CHOSEN]
    stopped += list(unchosen.keys())

    def test(row: Mapping[str, Any]) -> bool:
        return any(all(row[k] == v for k, v in key.items()) for key in stopped)

    return test
