"""The session fit: sets of trials that are fitted together, and the resulting movement."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import distinct
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import definition, from_row, number, to_row
from pbl_pipeline.results.fits import Solution
from pbl_pipeline.temporary import new_folder

from . import keypoints, lab, session, video
from .datajoint_setup import dj
from .method_rows import method_columns, method_row
from .origin import Origin, computes, origin_columns
from .rows import InputChanged, MadeOnce, inside, one
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import fit as lib

schema = dj.Schema()

#: Stands for the methods before the fit if laboratory markers are fitted.
LABORATORY = "laboratory markers"
#: Kinds of sets, which are never fitted, pooled or averaged with one another: videos of one camera each, trials of
#: several calibrated cameras, marker recordings.
SINGLE, RIG, MARKERS = "single", "rig", "markers"
KINDS = (SINGLE, RIG, MARKERS)
#: Type of a column that holds a kind.
KIND_TYPE = "enum('single', 'rig', 'markers')"


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


@schema
class FitMethod(dj.Lookup):
    stage = "fit"
    definition = f"""
    # frozen parameters of a session fit
    {method_columns("fit")}
    """


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
        return refs, _rig(views), ids, name, method_row(FitMethod, key)

    @computes
    def make_compute(
        self, key: dict, refs: Sequence[dict], rig: tuple | None, ids: list[int], name: str, method: Mapping[str, Any]
    ) -> tuple[int, float, float | None, list[int], str]:
        from pbl_pipeline.fit import check_trial
        from pbl_pipeline.keypoints import MultiView, ray_miss_m

        with ExitStack() as stack:
            found = _load_trial(stack, refs, rig)
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


@schema
class SessionFit(dj.Computed):
    definition = f"""
    # one body fitted to all trials of a set
    -> FitSelection
    ---
    -> session.Session
    -> BodyModel
    {definition(Solution, only=("solver", "loss"))}
    fit_residual_2d=null : float64             # (px) median distance of body and keypoints in the picture
    fit_residual_3d=null : float64             # (cm) median distance of body and 3D keypoints
    fit_outcome          : enum('PASS', 'WARN', 'EMPTY', 'NEEDS_CHOICE', 'FAIL')  # worst check
    {definition(Solution, only=("iterations", "converged", "scale"))}
    fit_height=null      : float64             # (m) body height of the person that the fit was told, null: not known
    {definition(Solution, only=("compile_seconds", "device"))}
    session_file         : <object@arrays>     # npz: scale (8), site_offset_m (J,3) m, loss_trace (K,2)
    {origin_columns("fit")}
    """

    class Trial(dj.Part):
        # trial_orientation is no enum: DataJoint 2.3.5 cannot read one back whose values hold a colon.
        definition = """
        # the fitted movement of one video, or of several cameras' trial, which has the number of one of them
        -> master
        -> FitSet.Video
        ---
        trial_name        : varchar(255)
        trial_n_fitted    : int32              # frames with joint angles
        trial_residual_2d=null : float64       # (px) median distance of body and keypoints in the picture
        trial_residual_3d=null : float64       # (cm) median distance of body and 3D keypoints
        trial_orientation=null : varchar(32)   # where the vertical comes from, such as 'measured: phone', null where it was not recorded
        trial_clock_offset=null : float64      # (s) the phone sensor's clock minus the video's, null where not estimated
        trial_file        : <object@arrays>    # fit.npz: time_s (T) s, qpos and qpos_sd (T,40) m and rad, markers_world_m (T,J,3) m, residual_2d_px (T,J) px, residual_3d_m (T,J) m; docs/files.md
        """  # noqa: E501

    class Check(dj.Part):
        definition = f"""
        # quality checks of the fit
        -> master
        {definition(Quality, "fit")}
        """

    #: Plans the sets of all sessions; `pbl_schemas.activate` puts `plan.plan_fit_sets` here, which knows this table.
    plan: Callable[[], Any]

    @property
    def key_source(self) -> Any:
        return current()

    def populate(self, *restrictions: Any, **options: Any) -> dict[str, Any]:
        """DataJoint's own, after the fits of all sessions whose trials are decided have been planned."""
        self.plan()
        return super().populate(*restrictions, **options)

    def make_fetch(self, key: dict) -> tuple:
        rows = (_recordings_with_points(FitSet) & key).to_dicts(order_by="video_id")
        of_markers = [] if rows else (_marker_recordings(FitSet) & key).to_dicts(order_by="video_id")
        if not rows and not of_markers:
            raise InputChanged("no video of this set has keypoints any more")
        of_rig = bool(rows) and rows[0]["fit_set_kind"] == RIG
        views = views_of([int(r["video_id"]) for r in rows]) if of_rig else {}
        files = {r["video_id"]: file_ref(r["keypoints_file" if rows else "markers_file"]) for r in rows or of_markers}
        leads = [r for r in rows or of_markers if not of_rig or views[int(r["video_id"])]]
        names = distinct([Path(r["video_name"]).stem for r in leads], [r["video_id"] for r in leads])
        trials = []
        for r, name in zip(leads, names, strict=True):
            own = views.get(int(r["video_id"]), [])
            if not all(v["video_id"] in files for v in own):
                raise InputChanged("a camera of this set has no keypoints any more")
            refs = [files[v["video_id"]] for v in own] or [files[r["video_id"]]]
            trials.append((r["video_id"], name, r["camera_motion"], refs, _rig(own)))
        height_m = number(one(_people(FitSet) & key, "subject_height"))
        table = None
        if of_markers and of_markers[0]["marker_table_file"] is not None:  # the laboratory's own set, one for a session
            table = (of_markers[0]["recording_marker_set"], file_ref(of_markers[0]["marker_table_file"]))
        return trials, table, height_m, method_row(FitMethod, key)

    @computes
    def make_compute(
        self, key: dict, trials: Sequence[tuple], table: tuple | None, height_m: float | None, method: Mapping[str, Any]
    ) -> tuple[lib.SessionFit, list[int], str]:
        from pbl_pipeline.fit import fit_session

        session_input = self._loaded(trials, table, height_m)
        stated = {"markers": session_input.markers, "height_m": height_m}
        result = fit_session(
            session_input.trials,
            session_input.names,
            methods.stored(**method),
            camera_motion=session_input.camera_motion,
            **{k: v for k, v in stated.items() if v is not None},
        )
        return result, [t[0] for t in trials], method["sha"]

    def make_computes(
        self, keys: Sequence[dict], fetched: Sequence[tuple], threads: int | None = None
    ) -> list[tuple[lib.SessionFit, list[int], str, Origin] | None]:
        """Several sets in one call of the library: for each what `make_compute` returns, None if it would raise.

        A worker with a GPU fits a batch so, and hands each result to the table's own make. threads: as for
        `fit_sessions`.
        """
        from pbl_pipeline.fit import fit_sessions

        out: list[tuple[lib.SessionFit, list[int], str, Origin] | None] = [None] * len(keys)
        for sha in dict.fromkeys(method["sha"] for *_, method in fetched):
            rows = [i for i, (*_, method) in enumerate(fetched) if method["sha"] == sha]
            start = time.monotonic()
            sessions, places = [], []
            for i in rows:
                try:
                    sessions.append(self._loaded(*fetched[i][:3]))
                    places.append(i)
                except PblError:
                    continue  # make_compute will say it
            results = fit_sessions(sessions, methods.stored(**fetched[rows[0]][-1]), threads=threads)
            origin = Origin.now((time.monotonic() - start) / max(len(results), 1))
            for i, result in zip(places, results, strict=True):
                if not isinstance(result, PblError):
                    out[i] = (result, [t[0] for t in fetched[i][0]], sha, origin)
        return out

    def _loaded(self, trials: Sequence[tuple], table: tuple | None, height_m: float | None) -> lib.SessionInput:
        """Keypoints of one or several cameras or markers, names and camera motions of the trials of `make_fetch`."""
        from pbl_pipeline.body import load_marker_set
        from pbl_pipeline.fit import SessionInput

        _, names, motions, refs, rigs = (list(column) for column in zip(*trials, strict=True))
        own = None
        with ExitStack() as stack:
            markers = video.NO_CAMERA in motions
            loaded = [_load_trial(stack, r, rig, markers) for r, rig in zip(refs, rigs, strict=True)]
            if table is not None:
                own = load_marker_set(stack.enter_context(stored_file(table[1])), name=table[0])
        # The library knows one moving camera; "one of several" on stands is a static one for it.
        motions = ["handheld" if m == "handheld" else "static" for m in motions]
        return SessionInput(loaded, names, motions, own, height_m)

    def make_insert(self, key: dict, result: lib.SessionFit, ids: list[int], sha: str, origin: Origin) -> None:
        from pbl_pipeline.qc import worst

        body_sha = result.trials[0].body_sha256
        residual_2d = np.concatenate([t.residual_2d_px.ravel() for t in result.trials])
        residual_3d = np.concatenate([t.residual_3d_m.ravel() for t in result.trials])
        with new_folder() as folder:
            np.savez(
                folder / "session.npz",
                scale=np.asarray(result.scale, np.float32),
                site_offset_m=np.asarray(result.site_offset_m, np.float32),
                loss_trace=np.asarray(result.loss_trace, np.float32),
            )
            self.insert1(
                {
                    **key,
                    "session_id": session_of_set(key),
                    "body_model": one(BodyModel & {"body_sha256": body_sha}, "body_model"),
                    **to_row(result),
                    "fit_residual_2d": median(residual_2d),
                    "fit_residual_3d": median(100 * residual_3d),
                    "fit_outcome": worst(result.qc),
                    "fit_height": number(result.trials[0].height_m),
                    "session_file": folder / "session.npz",
                    **origin.row("fit", method_hash=sha, model_sha256=body_sha),
                }
            )
            for video_id, trial in zip(ids, result.trials, strict=True):
                path = folder / f"{video_id}.fit.npz"
                float32_trial(trial).save(path)
                self.Trial.insert1(
                    {
                        **key,
                        "video_id": video_id,
                        "trial_name": trial.name,
                        "trial_n_fitted": int(np.isfinite(trial.qpos).all(axis=1).sum()),
                        "trial_residual_2d": median(trial.residual_2d_px),
                        "trial_residual_3d": median(100 * trial.residual_3d_m),
                        "trial_orientation": trial.orientation_source,
                        "trial_clock_offset": number(trial.phone_clock_offset_s),
                        "trial_file": path,
                    }
                )
        self.Check.insert({**key, **to_row(check, "fit")} for check in result.qc)


@MadeOnce
def _recordings_with_points(sets: Any) -> Any:
    own = sets.proj("fit_set_kind") * sets.Video
    return own * keypoints.Keypoints.proj("keypoints_file") * video.Video


@MadeOnce
def _marker_recordings(sets: Any) -> Any:
    return sets.Video.proj() * video.MarkerRecording * video.Video


@MadeOnce
def _people(sets: Any) -> Any:
    return sets.proj("session_id") * session.Session.proj("subject") * lab.Subject.proj("subject_height")


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


def _rig(views: Sequence[Mapping[str, Any]]) -> tuple[dict, list[str]] | None:
    """File of the calibration and the camera of each view; None for a video of one camera."""
    return (file_ref(views[0]["rig_file"]), [v["rig_camera"] for v in views]) if views else None


def load_trial(ref: Mapping[str, Any]) -> lib.TrialFit:
    """Return the library's `TrialFit` in a file of the store."""
    from pbl_pipeline.fit import TrialFit

    with stored_file(ref) as path:
        return TrialFit.load(path)


def _load_trial(stack: ExitStack, refs: Sequence[dict], rig: tuple | None, markers: bool = False) -> lib.Trial:
    from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers

    paths = [stack.enter_context(stored_file(ref)) for ref in refs]
    if markers:
        return WorldMarkers.load(paths[0])
    views = [Keypoints.load(path) for path in paths]
    if rig is None:
        return views[0]
    return MultiView.from_calibration(views, stack.enter_context(stored_file(rig[0])), rig[1])


def trial_key(video_id: int) -> dict[str, Any] | None:
    """Key of the fit of a recording: of its current sets the one that was computed last; None if there is none."""
    trials = SessionFit.Trial.proj() * SessionFit.proj("fit_computed") * current().proj() & {"video_id": video_id}
    rows = trials.to_dicts(order_by="fit_computed DESC", limit=1)
    return {k: rows[0][k] for k in SessionFit.Trial.primary_key} if rows else None


def fit_checks(key: Mapping[str, Any]) -> list[tuple]:
    """The checks of one session fit as arguments of the library's `Check`: what `make_fetch` may hand on."""
    rows = (SessionFit.Check & {k: key[k] for k in SessionFit.primary_key}).to_dicts(order_by="fit_check")
    return [dataclasses.astuple(from_row(Quality, row, "fit")) for row in rows]


def median(values: np.ndarray) -> float | None:
    """Return the median of the finite values; None without any."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if len(there) else None


def float32_trial(trial: lib.TrialFit) -> lib.TrialFit:
    """Return the trial with float32 arrays except for time stamps, for the store."""
    wide = [f.name for f in dataclasses.fields(trial) if isinstance(getattr(trial, f.name), np.ndarray)]
    return dataclasses.replace(trial, **{n: np.asarray(getattr(trial, n), np.float32) for n in wide if n != "time_s"})
