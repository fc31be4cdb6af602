"""`fit_session` and `fit_sessions`: the functions that tables and commands call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import jax
import numpy as np

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.depth.points import PointDepths
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers
from pbl_pipeline.methods import Method
from pbl_pipeline.names import check_height
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.sensors.log import SensorLog
from pbl_pipeline.sensors.orientation import input_error
from pbl_pipeline.sensors.start import Stated
from pbl_pipeline.sensors.worn import worn
from pbl_pipeline.video import Camera

from .checks import check_fit
from .depths import check_depths
from .known_height import in_metres
from .lever_arms import with_marker_places
from .many_sessions import Packed, Work
from .methods import METHODS
from .params import GaussNewtonParams, Params
from .per_frame import start_of
from .problem import pixels_alone
from .results import SessionFit, TrialFit
from .rotations import quat_wxyz
from .session import CheckedTrial, Session, Trial, make_session
from .session import check_trial as _check_trial
from .solution import Solution
from .vertical import upright

#: Solvers at a time on a GPU: while the host works for one, the device iterates for the other; and threads that pack
#: sessions and make their results. More of them hold the interpreter when the solvers need it.
THREADS = 2


@dataclasses.dataclass(frozen=True)
class SessionInput:
    """One session for `fit_sessions`; fields as the arguments of `fit_session`."""

    trials: Sequence[Trial]
    names: Sequence[str]
    camera_motion: str | Sequence[str] = "static"
    markers: MarkerSet | None = None
    height_m: float | None = None
    sensors: Sequence[SensorLog] = ()
    sensor_clock_s: Sequence[Stated] | None = None
    depths: Sequence[PointDepths | None] = ()


def fit_session(
    trials: Sequence[Trial],
    names: Sequence[str],
    paramset: Method[Params] | Paramset | Params | str | None = None,
    camera_motion: str | Sequence[str] = "static",
    markers: MarkerSet | None = None,
    height_m: float | None = None,
    sensors: Sequence[SensorLog] = (),
    sensor_clock_s: Sequence[Stated] | None = None,
    depths: Sequence[PointDepths | None] = (),
) -> SessionFit:
    """Fit the body to all trials of one session; scale and marker offsets are shared.

    Raises `PblError` FIT_INPUT, VIEWS_DISAGREE, MARKER_SET_UNKNOWN, PHONE_LOG, DEPTH_FILE, SOLVER_UNKNOWN,
    FIT_DIVERGED.

    Parameters
    ----------
    trials, names
        Trials of one kind and a name for each: `Keypoints` of one camera, `MultiView` of several calibrated cameras, or
        `WorldMarkers` of a laboratory.
    paramset
        What `METHODS.find` takes: the name of a method, a `Paramset`, parameters of a solver; None for the default.
    camera_motion
        "static" or "handheld", for all trials or each. The logged orientation of a handheld phone
        (`Keypoints.phone_quat_wxyz`) is part of the fit, together with the offset between its clock and the video's;
        of a static one it determines the tilt. Without a log the camera counts as one that does not turn, and as level
        unless the walk shows its tilt; a check reports which.
    markers
        A laboratory's marker set (`body.load_marker_set`); None: a shipped one, by its name in the trials.
    height_m
        The person's measured body height (m), which scales the lengths of a fit to one camera; without it they have the
        detector's guess (`known_height`). Angles do not depend on it.
    sensors
        Logs of wearable sensors, one for each segment, all on one clock; one log for all trials. The method is
        `gauss-newton`'s.
    sensor_clock_s
        Time of the logs at time 0 of each trial's video, to half a second, or the earliest and latest one by wall
        clocks (`sensors.places`); None where it is not known, so that it is looked for in the whole log. Default: one
        trial, in which both begin together; not known of several.
    depths
        Of each trial of one camera, at its keypoints (`depth.with_recordings`), or None.
    """
    given = SessionInput(trials, names, camera_motion, markers, height_m, sensors, sensor_clock_s, depths)
    result = fit_sessions([given], paramset)[0]
    if isinstance(result, PblError):
        raise result
    return result


def fit_sessions(
    sessions: Sequence[SessionInput],
    paramset: Method[Params] | Paramset | Params | str | None = None,
    batch: int | None = None,
    threads: int | None = None,
) -> list[SessionFit | PblError]:
    """Fit many sessions; those packed to the same sizes go through the device together, with the same results.

    A session that cannot be fitted has its `PblError` in its place. `batch`: most sessions in one call of the solver
    (default: all on a GPU; 1 on a CPU, which gains nothing by more); `implicit-adam` takes one at a time. `threads`:
    that solve on a GPU, and as many that pack (default: `THREADS`); fewer where other processes fit on it as well.

    Raises `PblError` SOLVER_UNKNOWN.
    """
    on_cpu, method = jax.default_backend() == "cpu", METHODS.find(paramset)

    def pack(i: int) -> Packed:
        begin, given = time.perf_counter(), sessions[i]
        check_height(given.height_m)
        session = make_session(given.trials, given.names, method.params, _motions(given), given.markers)
        sensors = worn(given.sensors, given.sensor_clock_s, len(given.trials))
        session = dataclasses.replace(session, worn=sensors, depths=check_depths(given.depths, session.trials))
        if not session.plain and not isinstance(method.params, GaussNewtonParams):
            raise input_error(
                f"wearable sensors or depths and the method {method.key}", "a method of the solver gauss-newton"
            )
        shapes = tuple(a.shape for a in jax.tree.leaves(session.problem))
        kind = shapes, pixels_alone(session.problem), type(session.trials[0]), session.plain
        return Packed(i, session, start_of(session), time.perf_counter() - begin, kind)

    def finish(packed: Packed, solution: Solution) -> SessionFit:
        return _session_fit(packed, solution, method, sessions[packed.index])

    load_body()  # before the threads, each of which would load its own body and compile for it
    most, threads = max(batch or (1 if on_cpu else len(sessions)), 1), threads or THREADS
    return Work(len(sessions), pack, method, finish, most).run(1 if on_cpu else threads, threads)


def _motions(given: SessionInput) -> list[str]:
    motion = given.camera_motion
    return [motion] * len(given.trials) if isinstance(motion, str) else list(motion)


def check_trial(
    trial: Trial,
    name: str,
    paramset: Method[Params] | Paramset | Params | str | None = None,
    markers: MarkerSet | None = None,
) -> CheckedTrial:
    """Check a trial before a fit.

    Raises `PblError` FIT_INPUT, VIEWS_DISAGREE or MARKER_SET_UNKNOWN if the trial cannot be fitted.
    """
    return _check_trial(trial, name, METHODS.find(paramset).params.view, markers)


def _session_fit(packed: Packed, solution: Solution, method: Method[Params], given: SessionInput) -> SessionFit:
    begin, session, motions, paramset = time.perf_counter(), packed.session, _motions(given), method.paramset
    used = np.asarray(session.problem.weight) > 0
    finite = np.all(np.isfinite(solution.qpos[used])) and np.all(np.isfinite(solution.scale))
    if not finite or not np.isfinite(solution.loss_trace[-1, 1]) or np.any(solution.scale <= 0):
        raise PblError(
            "FIT_DIVERGED",
            found="joint angles or a cost that are not finite, or a body whose lengths are not positive",
            expected="finite angles and positive lengths",
            next_step="check the keypoints and the camera matrix",
            key=", ".join(session.names),
        )
    solution, sources = upright(session, solution)
    solution, taller = in_metres(session, solution, given.height_m)
    solution = with_marker_places(session, solution, method.params)
    seconds = packed.seconds + solution.seconds + time.perf_counter() - begin
    fits = tuple(
        _trial_fit(session, i, solution, sources[i], paramset, motions[i], seconds, given.height_m)
        for i in range(len(session.trials))
    )
    return SessionFit(
        trials=fits,
        scale=solution.scale,
        site_offset_m=solution.site_offset_m,
        loss_trace=solution.loss_trace,
        iterations=solution.iterations,
        converged=solution.result.converged,
        result=solution.result.name.lower(),
        solver=str(paramset.params["solver"]),
        params_hash=paramset.hash,
        seconds=seconds,
        compile_seconds=solution.compile_seconds,
        device=str(jax.devices()[0].device_kind),
        qc=check_fit(session, fits, solution, taller),
    )


def _trial_fit(
    session: Session,
    i: int,
    solution: Solution,
    source: str,
    paramset: Paramset,
    camera_motion: str,
    seconds: float,
    height_m: float | None,
) -> TrialFit:
    trial, arrays, at = session.trials[i], session.arrays[i], session.frames(i)
    hide, seen = ~arrays.used[:, None], solution.outcome
    n, q, j = len(arrays.time_s), solution.qpos.shape[1], len(session.markers)
    sd = np.full((n, q), np.nan) if solution.qpos_sd is None else solution.qpos_sd[at]
    view = trial.views[0] if isinstance(trial, MultiView) else trial
    camera = view.camera if isinstance(view, Keypoints) else NO_CAMERA
    size = view.image_size_px if isinstance(view, Keypoints) else (0, 0)
    has_camera = not isinstance(trial, WorldMarkers)
    moves = arrays.phone_time_s is not None and solution.qpos_sd is not None
    return TrialFit(
        name=session.names[i],
        time_s=trial.time_s,
        joint_names=tuple(session.body.joint_names),
        qpos=np.where(hide, np.nan, solution.qpos[at]),
        qpos_sd=np.where(hide, np.nan, sd),
        marker_set=session.markers.name,
        marker_names=tuple(session.markers.names),
        markers_world_m=np.where(hide[..., None], np.nan, seen.x_world_m[at, :j]),
        phone_quat_wxyz=quat_wxyz(solution.R_nc[at, 0]) if has_camera else np.full((n, 4), np.nan),
        scale=solution.scale,
        site_offset_m=solution.site_offset_m,
        residual_2d_px=np.where(hide, np.nan, seen.residual_2d_px[at, :j]),
        residual_3d_m=np.where(hide, np.nan, seen.residual_3d_m[at, :j]),
        camera=camera,
        image_size_px=size,
        camera_motion=camera_motion,
        camera_position_m=arrays.p_nc[0, 0] if has_camera else np.full(3, np.nan),
        orientation_source=source,
        phone_clock_offset_s=float(solution.clock_s[i]) if moves else float("nan"),
        solver=str(paramset.params["solver"]),
        params_hash=paramset.hash,
        body_sha256=session.body.sha256,
        loss=float(solution.loss_trace[-1, 1]),
        seconds=seconds,
        height_m=float("nan") if height_m is None else height_m,
        confidence_curve=view.confidence_curve if isinstance(view, Keypoints) else "",
        sensors=solution.sensors[i] if solution.sensors else (),
        with_depths=bool(solution.depths),
        depth=solution.depths[i] if solution.depths else None,
        frame=view.frame if isinstance(view, Keypoints) else None,
    )


#: Stands for the camera of a trial that has none.
NO_CAMERA = Camera(np.full((3, 3), np.nan), np.full(5, np.nan), "none: laboratory markers")
