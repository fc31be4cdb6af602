"""The session fit: which trials are fitted together, and the movement that comes out."""

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

from . import keypoints, session, video  # noqa: F401  a definition refers to session
from ._datajoint import dj
from .checks import check_columns, check_row, check_values
from .method_rows import method_columns, method_row
from .origin import Origin, computes, origin_columns
from .rows import InputChanged, number, one
from .stored_files import file_ref, new_folder, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import fit as lib

schema = dj.Schema()

#: What stands for the methods before the fit where markers of a laboratory are fitted.
LABORATORY = "laboratory markers"


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
    # which keypoints of a session are fitted by which method
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
    {origin_columns("trial_input")}
    """

    @property
    def key_source(self) -> Any:
        planned = video.Video.proj("session_id") * FitPlan
        return (keypoints.Keypoints.proj() * FitMethod.proj()) & planned

    def make_fetch(self, key: dict) -> tuple:
        ref = file_ref(one(keypoints.Keypoints & key, "keypoints_file"))
        return (
            ref,
            one(video.Video & key, "video_name"),
            method_row(FitMethod, key),
        )

    @computes
    def make_compute(self, key: dict, ref: dict, name: str, method: Mapping[str, Any]) -> tuple[int, float, str]:
        from pbl_pipeline.fit import check_trial
        from pbl_pipeline.keypoints import Keypoints

        with stored_file(self, ref) as path:
            found = Keypoints.load(path)
        used, share = check_trial(found, name, methods.stored(**method))
        return int(np.sum(used)), float(share), method["sha"]

    def make_insert(self, key: dict, n_used: int, share: float, sha: str, origin: Origin) -> None:
        row = {"n_used": n_used, "in_view_share": share, **origin.row("trial_input", method_hash=sha)}
        self.insert1({**key, **row})


@schema
class FitSet(dj.Manual):
    definition = """
    # recordings of a session that are fitted together, videos or marker recordings; another or another person makes another set
    fit_set           : char(16)               # hash over session, recordings, persons and keypoint method or marker set
    ---
    -> session.Session
    fit_set_n         : int16                  # how many recordings
    fit_set_created   : datetime               # when planned, UTC
    """  # noqa: E501

    class Video(dj.Part):
        definition = """
        # keypoints of a video; a marker recording has none, and no method before the fit
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


@schema
class SessionFit(dj.Computed):
    definition = f"""
    # one body fitted to all trials of a set
    -> FitSelection
    ---
    -> BodyModel
    solver               : varchar(32)
    fit_loss             : float64             # (-) total loss at the end
    fit_residual_2d=null : float64             # (px) median distance of body and keypoints in the picture
    fit_residual_3d=null : float64             # (cm) median distance of body and 3D keypoints
    fit_outcome          : enum('PASS', 'WARN', 'EMPTY', 'NEEDS_CHOICE', 'FAIL')  # worst check
    fit_iterations=null  : int32               # steps of the solver, null for fits of before it was recorded
    fit_converged=null   : bool                # ended at a minimum, not at its bound on iterations or steps; null too
    fit_scale            : json                # multiplier (-) of each scale group, 1 = the unscaled body
    compile_seconds      : float64             # (s) of the duration, spent compiling
    compute_device       : varchar(64)         # what JAX computed on
    session_file         : <object@arrays>     # npz: scale (8), site_offset_m (J,3) m, loss_trace (K,2)
    {origin_columns("fit")}
    """

    class Trial(dj.Part):
        # trial_orientation is no enum: DataJoint 2.3.5 cannot read one back whose values hold a colon.
        definition = """
        # the fitted movement of one video
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
        {check_columns("fit")}
        """

    @property
    def key_source(self) -> Any:
        return FitSelection & {"fit_current": True}

    def populate(self, *restrictions: Any, **options: Any) -> dict[str, Any]:
        """DataJoint's own, after the fits of all sessions whose trials are decided have been planned."""
        from .plan import plan_fit_sets

        plan_fit_sets()
        return super().populate(*restrictions, **options)

    def make_fetch(self, key: dict) -> tuple:
        rows = (FitSet.Video * keypoints.Keypoints.proj("keypoints_file") * video.Video & key).to_dicts(
            order_by="video_id"
        )
        recorded = FitSet.Video.proj() * video.MarkerRecording * video.Video & key
        of_markers = [] if rows else recorded.to_dicts(order_by="video_id")
        if not rows and not of_markers:
            raise InputChanged("no video of this set has keypoints any more")
        both = rows or of_markers
        names = trial_names([(r["video_id"], r["video_name"]) for r in both])
        trials = [
            (r["video_id"], n, r["camera_motion"], file_ref(r["keypoints_file" if rows else "markers_file"]))
            for r, n in zip(both, names, strict=True)
        ]
        return trials, _marker_table(of_markers), method_row(FitMethod, key)

    @computes
    def make_compute(
        self, key: dict, trials: Sequence[tuple], table: tuple | None, method: Mapping[str, Any]
    ) -> tuple[lib.SessionFit, list[int], str]:
        from pbl_pipeline.fit import fit_session

        session_input = self._loaded(trials, table)
        own = {} if session_input.markers is None else {"markers": session_input.markers}
        result = fit_session(
            session_input.trials,
            session_input.names,
            methods.stored(**method),
            camera_motion=session_input.camera_motion,
            **own,
        )
        return result, [t[0] for t in trials], method["sha"]

    def make_computes(
        self, keys: Sequence[dict], fetched: Sequence[tuple]
    ) -> list[tuple[lib.SessionFit, list[int], str, Origin] | None]:
        """Several sets in one call of the library: for each what `make_compute` returns, None where it would raise.

        A worker with a GPU fits a batch so, and hands each result to the table's own make.
        """
        from pbl_pipeline.fit import fit_sessions

        out: list[tuple[lib.SessionFit, list[int], str, Origin] | None] = [None] * len(keys)
        for sha in dict.fromkeys(method["sha"] for *_, method in fetched):
            rows = [i for i, (*_, method) in enumerate(fetched) if method["sha"] == sha]
            start = time.monotonic()
            sessions, places = [], []
            for i in rows:
                try:
                    sessions.append(self._loaded(*fetched[i][:2]))
                    places.append(i)
                except PblError:
                    continue  # make_compute will say it
            results = fit_sessions(sessions, methods.stored(**fetched[rows[0]][-1]))
            origin = Origin.now((time.monotonic() - start) / max(len(results), 1))
            for i, result in zip(places, results, strict=True):
                if not isinstance(result, PblError):
                    out[i] = (result, [t[0] for t in fetched[i][0]], sha, origin)
        return out

    def _loaded(self, trials: Sequence[tuple], table: tuple | None) -> lib.SessionInput:
        """Keypoints or markers, names and camera motions of the trials that `make_fetch` gave."""
        from pbl_pipeline.body import load_marker_set
        from pbl_pipeline.fit import SessionInput
        from pbl_pipeline.keypoints import Keypoints, WorldMarkers

        _, names, motions, refs = (list(column) for column in zip(*trials, strict=True))
        kind = WorldMarkers if video.NO_CAMERA in motions else Keypoints
        own = None
        with ExitStack() as stack:
            paths = [stack.enter_context(stored_file(self, ref)) for ref in refs]
            loaded = [kind.load(path) for path in paths]
            if table is not None:
                own = load_marker_set(stack.enter_context(stored_file(self, table[1])), name=table[0])
        # The library knows one moving camera; "one of several" on stands is a static one for it.
        return SessionInput(loaded, names, ["handheld" if m == "handheld" else "static" for m in motions], own)

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
                    "body_model": one(BodyModel & {"body_sha256": body_sha}, "body_model"),
                    "solver": result.solver,
                    "fit_loss": float(result.trials[0].loss),
                    "fit_residual_2d": median(residual_2d),
                    "fit_residual_3d": median(100 * residual_3d),
                    "fit_outcome": worst(result.qc),
                    "fit_iterations": int(result.iterations),
                    "fit_converged": bool(result.converged),
                    "fit_scale": [round(float(s), 5) for s in result.scale],
                    "compile_seconds": result.compile_seconds,
                    "compute_device": result.device[:64],
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
        self.Check.insert({**key, **check_row("fit", check)} for check in result.qc)


def _marker_table(rows: Sequence[Mapping[str, Any]]) -> tuple[str, dict] | None:
    """Name and file of the marker set of marker recordings, where it is the laboratory's own: one for a session."""
    if not rows or rows[0]["marker_table_file"] is None:
        return None
    return rows[0]["recording_marker_set"], file_ref(rows[0]["marker_table_file"])


def fit_checks(key: Mapping[str, Any]) -> list[tuple]:
    """The checks of one session fit as arguments of the library's `Check`: what `make_fetch` may hand on."""
    rows = (SessionFit.Check & {k: key[k] for k in SessionFit.primary_key}).to_dicts(order_by="fit_check")
    return [check_values("fit", row) for row in rows]


def median(values: np.ndarray) -> float | None:
    """Median of the values that are there; None where none is."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if len(there) else None


def trial_names(videos: Sequence[tuple[int, str]]) -> list[str]:
    """A name for each (video_id, file name): the file's stem, with the number where stems repeat."""
    return distinct([Path(name).stem for _, name in videos], [number for number, _ in videos])


def float32_trial(trial: lib.TrialFit) -> lib.TrialFit:
    """The trial with float32 arrays, time stamps excepted: what the store keeps."""
    wide = [f.name for f in dataclasses.fields(trial) if isinstance(getattr(trial, f.name), np.ndarray)]
    return dataclasses.replace(trial, **{n: np.asarray(getattr(trial, n), np.float32) for n in wide if n != "time_s"})
