"""Trials that are fitted, and the sets of them that are fitted together; `plan` makes the sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import methods
from pbl_pipeline.filming import KINDS, MARKERS, RIG, SINGLE  # noqa: F401  of `fit`
from pbl_pipeline.records import number

from . import keypoints, session, video
from .datajoint_setup import dj
from .method_rows import method_row, method_table
from .origin import Origin, computes, origin_columns
from .rows import InputChanged, inside, one
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import fit as lib

schema = dj.Schema()

#: Stands for the methods before the fit if laboratory markers are fitted.
LABORATORY = "laboratory markers"
#: Type of a column that holds a kind.
KIND_TYPE = f"enum({', '.join(map(repr, KINDS))})"


@schema
class BodyModel(dj.Lookup):
    definition = """
    # a body to fit, by the hash of its MJCF
    body_model    : varchar(48)                # name and version
    ---
    body_name     : varchar(32)
    body_version  : varchar(15)
    body_sha256   : char(64)                   # of the MJCF
    joint_names   : json                       # order of qpos
    scale_names   : json                       # order of the scale groups
    unique index (body_sha256)
    """


FitMethod = schema(method_table("FitMethod", "fit", "fit", "a session fit"))


@schema
class FitPlan(dj.Manual):
    definition = """
    # which keypoints of a session are fitted by which method: videos of one camera each, and trials of several cameras
    -> session.Session
    -> keypoints.KeypointMethod
    -> FitMethod
    """


@schema
class MarkerPlan(dj.Manual):
    definition = """
    # which marker recordings are fitted by which method
    -> video.MarkerRecording
    -> FitMethod
    """


@schema
class TrialInput(dj.Computed):
    definition = f"""
    # trials whose keypoints can be fitted; one that cannot has an error row here and does not hold up its session
    -> keypoints.Keypoints
    -> FitMethod
    ---
    in_view_share   : float64                  # (0..1) share of frames with the whole person in view
    n_used          : int32                    # frames that the fit will use
    ray_miss=null   : float64                  # (cm) by how much the rays of several cameras miss each other, of the worst; null for one camera
    {origin_columns("trial_input")}
    """  # noqa: E501

    class View(dj.Part):
        definition = """
        # keypoints of each camera, of a trial that several cameras film
        -> master
        -> keypoints.Keypoints.proj(view_video_id='video_id')
        """

    @property
    def key_source(self) -> Any:
        """Keypoints of one camera; of several cameras those of the video that has the trial's number, where all of its
        views have keypoints."""
        planned = video.Video.proj("session_id") * FitPlan
        of_view = keypoints.Keypoints.proj(view_video_id="video_id")
        trials = video.RigView.proj(view_video_id="video_id", video_id="rig_trial")
        unseen = (trials * keypoints.Keypoints.proj()).proj() - of_view
        others = (video.RigView & "video_id != rig_trial").proj()
        return (((keypoints.Keypoints.proj() * FitMethod.proj()) & planned) - others) - unseen - video.NotUsable

    @staticmethod
    def with_trials(keys: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return these keys of Keypoints, and those of the trials whose views the videos are."""
        trial_of = trials_of([int(k["video_id"]) for k in keys])
        more = [{**k, "video_id": trial_of[v]} for k in keys if (v := int(k["video_id"])) in trial_of]
        return [*map(dict, keys), *(k for k in more if k not in keys)]

    def make_fetch(self, key: dict) -> tuple:
        name, file = one(keypoints.Keypoints * video.Video & key, "video_name", "keypoints_file")
        views = views_of([key["video_id"]])[key["video_id"]]
        ids = [int(v["video_id"]) for v in views]
        files = {key["video_id"]: file}
        if ids:
            of_views = keypoints.Keypoints & [{**key, "video_id": v} for v in ids]
            files = {r["video_id"]: r["keypoints_file"] for r in of_views.to_dicts()}
        if missing := [str(v) for v in ids if v not in files]:
            raise InputChanged(f"no keypoints any more of video_id {', '.join(missing)}, a camera of this trial")
        refs = [file_ref(files[v]) for v in ids or files]
        return refs, rig_of(views), ids, name, method_row(FitMethod, key)

    @computes
    def make_compute(
        self, key: dict, refs: Sequence[dict], rig: tuple | None, ids: list[int], name: str, method: Mapping[str, Any]
    ) -> tuple[int, float, float | None, list[int], str]:
        from pbl_pipeline.fit import check_trial
        from pbl_pipeline.keypoints import MultiView, ray_miss_m

        with ExitStack() as stack:
            found = load_input(stack, refs, rig)
        checked = check_trial(found, name, methods.stored(**method))
        miss = number(100 * np.nanmax(ray_miss_m(found))) if isinstance(found, MultiView) else None
        return int(np.sum(checked.used)), float(checked.whole_share), miss, ids, method["sha"]

    def make_insert(
        self, key: dict, n_used: int, share: float, miss: float | None, ids: list[int], sha: str, origin: Origin
    ) -> None:
        row = {"n_used": n_used, "in_view_share": share, "ray_miss": miss}
        self.insert1({**key, **row, **origin.row("trial_input", method_hash=sha)})
        self.View.insert({**key, "view_video_id": v} for v in ids)


@schema
class FitSet(dj.Manual):
    definition = f"""
    # recordings of one kind of a session that are fitted together; another or another person makes another set
    fit_set           : char(16)               # hash over session, recordings, persons, keypoint method or marker set, cameras of a rig
    ---
    -> session.Session
    fit_set_kind      : {KIND_TYPE} # videos of one camera each, trials of several calibrated cameras, or marker recordings
    fit_set_n         : int16                  # how many recordings
    fit_set_created   : datetime               # when planned, UTC
    """  # noqa: E501

    class Video(dj.Part):
        definition = """
        # keypoints of a video, of every camera of a rig; a marker recording has none, and no method before the fit
        -> master
        -> video.Video
        ---
        -> [nullable] keypoints.Keypoints
        """


@schema
class FitSelection(dj.Manual):
    definition = """
    # which sets are fitted by which method
    -> FitSet
    -> FitMethod
    ---
    fit_current : bool                         # false once a newer set of the session took its place; old fits stay
    """


def current() -> Any:
    """Rows of `FitSelection` that count: the newest set of each session, kind and method of the fit."""
    return FitSelection & {"fit_current": True}


def session_of_set(key: Mapping[str, Any]) -> int:
    """Return the session of a set, by a key with `fit_set`.

    It stands in every computed table below a set, so that its natural join with `session.Session` is its own visit and
    not every pair. A set never changes its session. The session's row is locked as the insert of a row that refers to
    it does, but before other rows, so that planning the session (which locks it, then its sets) waits instead of
    deadlocking.
    """
    number = int(one(FitSet & {"fit_set": key["fit_set"]}, "session_id"))
    sessions = session.Session
    sessions.connection.query(
        f"SELECT session_id FROM {sessions.full_table_name} WHERE session_id = %s LOCK IN SHARE MODE",  # noqa: S608
        args=(number,),
    )
    return number


def of_session(key: Mapping[str, Any]) -> dict[str, Any]:
    """Return a key with `fit_set` and the `session_of_set`, which a row below a set begins with."""
    return {**key, "session_id": session_of_set(key)}


def views_of(trials: Sequence[int]) -> dict[int, list[dict[str, Any]]]:
    """The views of trials that several cameras film, by the trial's number: rows of RigView and Rig, the video that has
    the number first. Empty for other videos."""
    found: dict[int, list[dict[str, Any]]] = {int(t): [] for t in trials}
    rows = (video.RigView * video.Rig & inside("rig_trial", found)).to_dicts(order_by="video_id")
    for row in sorted(rows, key=lambda r: r["video_id"] != r["rig_trial"]):
        found[int(row["rig_trial"])].append(row)
    return found


def trials_of(videos: Sequence[int]) -> dict[int, int]:
    """Video -> trial of those videos that are one of several cameras."""
    rows = (video.RigView & inside("video_id", videos)).proj("rig_trial").to_dicts()
    return {int(r["video_id"]): int(r["rig_trial"]) for r in rows}


def trial_of(video_id: int) -> int:
    """The number of the trial that a video is of: its own unless it is one of several cameras."""
    return trials_of([video_id]).get(video_id, video_id)


def videos_of(trial: int) -> list[int]:
    """The videos of a trial, the one with its number first: all of its cameras, or itself."""
    return [int(v["video_id"]) for v in views_of([trial])[trial]] or [trial]


def rig_of(views: Sequence[Mapping[str, Any]]) -> tuple[dict, list[str]] | None:
    """File of the calibration and the camera of each view; None for a video of one camera."""
    return (file_ref(views[0]["rig_file"]), [v["rig_camera"] for v in views]) if views else None


def load_input(stack: ExitStack, refs: Sequence[dict], rig: tuple | None, markers: bool = False) -> lib.Trial:
    from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers

    paths = [stack.enter_context(stored_file(ref)) for ref in refs]
    if markers:
        return WorldMarkers.load(paths[0])
    views = [Keypoints.load(path) for path in paths]
    if rig is None:
        return views[0]
    return MultiView.from_calibration(views, stack.enter_context(stored_file(rig[0])), rig[1])
