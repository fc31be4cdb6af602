"""The session fit: sets of trials that are fitted together, and the resulting movement."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import distinct
from pbl_pipeline.qc import OUTCOME_TYPE
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import definition, number, to_row
from pbl_pipeline.results.fits import DepthFit, Residuals, SensorFit, Solution, TrialFigures
from pbl_pipeline.temporary import new_folder

from . import keypoints, lab, session, video
from .datajoint_setup import dj
from .fit_sets import (  # noqa: F401  one schema: `fit.FitSet` and the others
    KIND_TYPE,
    KINDS,
    LABORATORY,
    MARKERS,
    RIG,
    SINGLE,
    BodyModel,
    FitMethod,
    FitPlan,
    FitSelection,
    FitSet,
    MarkerPlan,
    TrialInput,
    current,
    load_input,
    of_session,
    rig_of,
    schema,
    session_of_set,
    trial_of,
    trials_of,
    videos_of,
    views_of,
)
from .method_rows import method_row
from .origin import Origin, computes, origin_columns
from .plan import plan_fit_sets
from .record_parts import part_of
from .rows import InputChanged, MadeOnce, delete_below, inside, one
from .store import store_errors
from .stored_files import file_ref, read_stored, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import fit as lib
    from pbl_pipeline.sensors import Read, SensorLog


@schema
class SessionFit(dj.Computed):
    definition = f"""
    # one body fitted to all trials of a set
    -> FitSelection
    ---
    -> session.Session
    -> BodyModel
    {definition(Solution, only=("solver", "loss"))}
    {definition(Residuals, "fit")}
    fit_outcome          : {OUTCOME_TYPE}  # worst check
    {definition(Solution, only=("iterations", "converged", "result", "scale"))}
    fit_height=null      : float64             # (m) body height of the person that the fit was told, null: not known
    {definition(Solution, only=("compile_seconds", "device"))}
    session_file         : <object@arrays>     # npz: scale (8), site_offset_m (J,3) m, loss_trace (K,2)
    {origin_columns("fit")}
    """

    class Trial(dj.Part):
        definition = f"""
        # the fitted movement of one video, or of several cameras' trial, which has the number of one of them
        -> master
        -> FitSet.Video
        ---
        {definition(TrialFigures, "trial")}
        trial_file        : <object@arrays>    # fit.npz: time_s (T) s, qpos and qpos_sd (T,40) m and rad, markers_world_m (T,J,3) m, residual_2d_px (T,J) px, residual_3d_m (T,J) m; docs/files.md
        """  # noqa: E501

    Check = part_of("Check", Quality, "fit", "quality checks of the fit")
    Sensor = part_of(
        "Sensor", SensorFit, comment="what was found of a wearable sensor in a trial", of=("master", "FitSet.Video")
    )
    Depth = part_of("Depth", DepthFit, comment="what was found of a depth recording", of=("master", "FitSet.Video"))

    @property
    def key_source(self) -> Any:
        return current()

    def populate(self, *restrictions: Any, **options: Any) -> dict[str, Any]:
        """DataJoint's own, after the fits of all sessions whose trials are decided have been planned."""
        plan_fit_sets()
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
        now, trials = _beside(key), []
        depths = _depths(now[1])
        for r, name in zip(leads, names, strict=True):
            own = views.get(int(r["video_id"]), [])
            if not all(v["video_id"] in files for v in own):
                raise InputChanged("a camera of this set has no keypoints any more")
            refs = [files[v["video_id"]] for v in own] or [files[r["video_id"]]]
            trials.append((r["video_id"], name, r["camera_motion"], refs, rig_of(own), depths.get(r["video_id"])))
        height_m = number(one(_people(FitSet) & key, "subject_height"))
        table = None
        if of_markers and of_markers[0]["marker_table_file"] is not None:  # the laboratory's own set, one for a session
            table = (of_markers[0]["recording_marker_set"], file_ref(of_markers[0]["marker_table_file"]))
        worn = None
        if now[0]:
            of_visit = {"session_id": int(one(FitSet & key, "session_id"))}
            worn = worn_logs(of_visit, {int(t[0]): t[1] for t in trials})
        return trials, table, height_m, worn, now, method_row(FitMethod, key)

    @computes
    def make_compute(
        self,
        key: dict,
        trials: Sequence[tuple],
        table: tuple | None,
        height_m: float | None,
        worn: tuple | None,
        beside: tuple,
        method: Mapping[str, Any],
    ) -> tuple[lib.SessionFit, list[int], str, tuple]:
        from pbl_pipeline.fit import fit_session

        session_input = self._loaded(trials, table, height_m, worn)
        stated = {"markers": session_input.markers, "height_m": height_m}
        if worn is not None:
            stated |= {"sensors": session_input.sensors, "sensor_clock_s": session_input.sensor_clock_s}
        if session_input.depths:
            stated |= {"depths": session_input.depths}
        result = fit_session(
            session_input.trials,
            session_input.names,
            methods.stored(**method),
            camera_motion=session_input.camera_motion,
            **{k: v for k, v in stated.items() if v is not None},
        )
        return result, [t[0] for t in trials], method["sha"], beside

    def make_computes(
        self, keys: Sequence[dict], fetched: Sequence[tuple], threads: int | None = None
    ) -> list[tuple[lib.SessionFit, list[int], str, tuple, Origin] | None]:
        """Several sets in one call of the library: for each what `make_compute` returns, None if it would raise.

        A worker with a GPU fits a batch so, and hands each result to the table's own make. threads: as for
        `fit_sessions`.
        """
        from pbl_pipeline.fit import fit_sessions

        out: list[tuple[lib.SessionFit, list[int], str, tuple, Origin] | None] = [None] * len(keys)
        for sha in dict.fromkeys(method["sha"] for *_, method in fetched):
            rows = [i for i, (*_, method) in enumerate(fetched) if method["sha"] == sha]
            start = time.monotonic()
            sessions, places = [], []
            for i in rows:
                try:
                    sessions.append(self._loaded(*fetched[i][:4]))
                    places.append(i)
                except PblError:
                    continue  # make_compute will say it
            results = fit_sessions(sessions, methods.stored(**fetched[rows[0]][-1]), threads=threads)
            origin = Origin.now((time.monotonic() - start) / max(len(results), 1))
            for i, result in zip(places, results, strict=True):
                if not isinstance(result, PblError):
                    out[i] = (result, [t[0] for t in fetched[i][0]], sha, fetched[i][4], origin)
        return out

    def _loaded(
        self, trials: Sequence[tuple], table: tuple | None, height_m: float | None, worn: tuple | None
    ) -> lib.SessionInput:
        """Keypoints of one or several cameras or markers, names and camera motions of the trials of `make_fetch`,
        their depths, and the logs of wearable sensors. Raises `PblError` SENSOR_LOG, DEPTH_FILE."""
        from pbl_pipeline.body import load_marker_set
        from pbl_pipeline.depth import DepthFile, with_recordings
        from pbl_pipeline.fit import SessionInput
        from pbl_pipeline.sensors import places

        _, names, motions, refs, rigs, files = (list(column) for column in zip(*trials, strict=True))
        own, more = None, dict[str, Any]()
        with ExitStack() as stack:
            markers = video.NO_CAMERA in motions
            loaded = [load_input(stack, r, rig, markers) for r, rig in zip(refs, rigs, strict=True)]
            if table is not None:
                own = load_marker_set(stack.enter_context(stored_file(table[1])), name=table[0])
            if worn is not None:
                logs, recorded = read_worn(*worn)[0], [worn[1].get(name) for name in names]
                more = {"sensors": logs, "sensor_clock_s": places(logs, recorded, loaded)}
            if any(files):
                given = [f and DepthFile(stack.enter_context(stored_file(f[0])), *f[1:]) for f in files]
                loaded, more["depths"] = with_recordings(loaded, given)
        # The library knows one moving camera; "one of several" on stands is a static one for it.
        motions = ["handheld" if m == "handheld" else "static" for m in motions]
        return SessionInput(loaded, names, motions, own, height_m, **more)

    def make_insert(
        self, key: dict, result: lib.SessionFit, ids: list[int], sha: str, beside: tuple, origin: Origin
    ) -> None:
        from pbl_pipeline.qc import worst

        session_id = session_of_set(key)  # locked: no sensors or depths are attached from here on
        if _beside(key, "LOCK IN SHARE MODE") != beside:
            raise InputChanged("other wearable sensors or depth recordings than were fitted", key)
        body_sha = result.trials[0].body_sha256
        with new_folder() as folder:
            arrays = {n: np.asarray(getattr(result, n), np.float32) for n in ("scale", "site_offset_m", "loss_trace")}
            np.savez(folder / "session.npz", allow_pickle=False, **arrays)
            self.insert1(
                {
                    **key,
                    "session_id": session_id,
                    "body_model": one(BodyModel & {"body_sha256": body_sha}, "body_model"),
                    **to_row(result),
                    **to_row(Residuals.of(result.trials), "fit"),
                    "fit_outcome": worst(result.qc),
                    "fit_height": number(result.trials[0].height_m),
                    "session_file": folder / "session.npz",
                    **origin.row("fit", method_hash=sha, model_sha256=body_sha),
                }
            )
            for video_id, trial in zip(ids, result.trials, strict=True):
                path = folder / f"{video_id}.fit.npz"
                float32_trial(trial).save(path)
                of_trial = {**key, "video_id": video_id}
                self.Trial.insert1({**of_trial, **to_row(trial.figures, "trial"), "trial_file": path})
                self.Sensor.insert_records(of_trial, trial.sensors)
                self.Depth.insert_records(of_trial, [trial.depth] if trial.depth else [])
        self.Check.insert_records(key, result.qc)


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


def _beside(key: Mapping[str, Any], lock: str = "") -> tuple[tuple, tuple]:
    """Recordings that a set is fitted with beside keypoints: bytes, segments, rates and mounts of the logs of wearable
    sensors, none for markers; videos, bytes and scales of depth recordings, of one camera each. lock: clause by which a
    transaction sees what others have committed."""
    visit, kind = one(FitSet & {"fit_set": key["fit_set"]}, "session_id", "fit_set_kind")
    logs, depths = video.WearableImu.full_table_name, video.DepthVideo.full_table_name
    videos, of_set = video.Video.full_table_name, FitSet.Video.full_table_name

    def rows(query: str, value: Any) -> tuple:  # plain SQL: a lock does not reach into subqueries of DataJoint's joins
        return tuple(FitSet.connection.query(f"{query} {lock}", args=(value,)).fetchall())

    worn = (
        f"SELECT imu_sha256, imu_segments, imu_rate, imu_mounts FROM {logs} JOIN {videos} USING (video_id)"  # noqa: S608
        " WHERE session_id = %s AND imu_segments IS NOT NULL ORDER BY imu_sha256"
    )
    seen = (
        f"SELECT video_id, depth_sha256, depth_scale FROM {depths} JOIN {of_set} USING (video_id)"  # noqa: S608
        " WHERE fit_set = %s AND depth_read ORDER BY video_id"
    )
    return rows(worn, int(visit)) if kind != MARKERS else (), rows(seen, key["fit_set"]) if kind == SINGLE else ()


def _depths(rows: Sequence[tuple]) -> dict[int, tuple]:
    """File of the store, scale and name of depth recordings, by their videos; rows: of `_beside`."""
    found = (video.DepthVideo & inside("video_id", [int(row[0]) for row in rows])).to_dicts() if rows else []
    return {r["video_id"]: (file_ref(r["depth_file"]), number(r["depth_scale"]), r["depth_name"]) for r in found}


def worn_logs(of: Any, names: Mapping[int, str] | None = None) -> tuple[list[dict[str, Any]], dict[str, str | None]]:
    """Logs of wearable sensors of a restriction of Video, rows of WearableImu with the `file_ref` of each, and the time
    of recording of its videos by `names` (None: of those that are usable, by their numbers)."""
    videos = video.Video & of
    if names is None:
        names = {int(v): f"video_id {v}" for v in (videos - video.NotUsable).to_arrays("video_id")}
    rows = (video.WearableImu & videos.proj()).to_dicts(order_by=("video_id", "imu"))
    recorded = (video.VideoInfo & inside("video_id", names)).proj("recorded_utc").to_dicts()
    logs = [{**row, "imu_file": file_ref(row["imu_file"]), "imu_rate": number(row["imu_rate"])} for row in rows]
    return logs, {names[int(r["video_id"])]: r["recorded_utc"] for r in recorded}


def read_worn(
    logs: Sequence[Mapping[str, Any]], recorded: Mapping[str, str | None], read: Read | None = None
) -> tuple[tuple[SensorLog, ...], list[str]]:
    """Read logs as `worn_logs` returns them, or of which `imu_file` is the path of a new one, without the tables;
    returns them, and notes on videos of another day. Raises `PblError` SENSOR_LOG, USAGE: a fit with them would fail;
    as `store_errors`.
    """
    from pbl_pipeline.sensors import Given, check_day, read_given, read_samples

    with ExitStack() as stack:
        given = []
        for row in (row for row in logs if row["imu_segments"]):
            path, called = row["imu_file"], None
            if not isinstance(path, Path):
                with store_errors():
                    path, called = stack.enter_context(stored_file(path)), row["imu_name"]
            mounts = row["imu_mounts"] or {}
            given += [
                Given(path, segment, sensor or None, row["imu_rate"], called, mounts.get(segment))
                for segment, sensor in sorted(row["imu_segments"].items())
            ]
        sensors = read_given(given, read or read_samples)
    return sensors, check_day(sensors, recorded)


def delete_sensor_fits(session_id: int) -> dict[str, int]:
    """Delete the fits of a visit that its wearable sensors are part of; returns the rows as `delete_below`."""
    return delete_below(SessionFit, sensor_fits(session_id).keys())


def sensor_fits(session_id: int) -> Any:
    """Fits of a visit of which its wearable sensors are, or would be, a part."""
    sets = FitSet & {"session_id": session_id} & f"fit_set_kind <> '{MARKERS}'"
    return SessionFit & sets.proj()


def delete_depth_fits(video_id: int) -> dict[str, int]:
    """Delete the fits that the depth recording of a video is part of; returns the rows as `delete_below`."""
    sets = FitSet & {"fit_set_kind": SINGLE} & (FitSet.Video & {"video_id": video_id}).proj()
    return delete_below(SessionFit, (SessionFit & sets.proj()).keys())


def load_trial(ref: Mapping[str, Any]) -> lib.TrialFit:
    """Return the library's `TrialFit` in a file of the store."""
    from pbl_pipeline.fit import TrialFit

    return read_stored(ref, TrialFit.load)


def trial_key(video_id: int) -> dict[str, Any] | None:
    """Key of the fit of a recording: of its current sets the one that was computed last; None if there is none."""
    trials = SessionFit.Trial.proj() * SessionFit.proj("fit_computed") * current().proj() & {"video_id": video_id}
    rows = trials.to_dicts(order_by="fit_computed DESC", limit=1)
    return {k: rows[0][k] for k in SessionFit.Trial.primary_key} if rows else None


def fit_checks(key: Mapping[str, Any]) -> list[Quality]:
    """The checks of one session fit, by a key with its own."""
    return SessionFit.Check.records({k: key[k] for k in SessionFit.primary_key})


def float32_trial(trial: lib.TrialFit) -> lib.TrialFit:
    """Return the trial with float32 arrays except for stamps and numbers of frames, for the store."""
    wide = {f.name for f in dataclasses.fields(trial) if isinstance(getattr(trial, f.name), np.ndarray)}
    return dataclasses.replace(
        trial, **{n: np.asarray(getattr(trial, n), np.float32) for n in wide - {"time_s", "frame"}}
    )
