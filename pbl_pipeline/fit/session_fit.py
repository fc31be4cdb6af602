"""`fit_session` and `fit_sessions`: the functions that tables and commands call."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import numpy as np

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers
from pbl_pipeline.methods import Method
from pbl_pipeline.names import check_height
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.prefetch import prefetched
from pbl_pipeline.video import Camera

from .checks import check_fit
from .known_height import in_metres
from .methods import METHODS
from .params import Params
from .per_frame import start_of
from .problem import State, pixels_alone
from .results import SessionFit, TrialFit
from .rotations import quat_wxyz
from .session import Session, Trial, make_session
from .session import check_trial as _check_trial
from .solution import Solution
from .vertical import upright

#: Sessions given to the solver at once on a GPU: enough to keep its lanes filled, few enough that the next ones are
#: packed meanwhile. The first ones are fewer, so that the device begins early.
BATCH, FIRST = 128, 32
#: Batches that are solved at a time on a GPU: while the host works on one, the device iterates the other.
SOLVERS = 2
#: Threads that pack sessions and make their results. More of them hold the interpreter when the solvers need it: 256
#: sessions on an H100 take 4.1 s with two, 4.4 with four, 5.8 with eight.
PACKERS = 2


@dataclasses.dataclass(frozen=True)
class SessionInput:
    """One session for `fit_sessions`; fields as the arguments of `fit_session`."""

    trials: Sequence[Trial]
    names: Sequence[str]
    camera_motion: str | Sequence[str] = "static"
    markers: MarkerSet | None = None
    height_m: float | None = None


def fit_session(
    trials: Sequence[Trial],
    names: Sequence[str],
    paramset: Method[Params] | Paramset | Params | str | None = None,
    camera_motion: str | Sequence[str] = "static",
    markers: MarkerSet | None = None,
    height_m: float | None = None,
) -> SessionFit:
    """Fit the body to all trials of one session; scale and marker offsets are shared.

    Raises `PblError` FIT_INPUT, VIEWS_DISAGREE, MARKER_SET_UNKNOWN, PHONE_LOG, SOLVER_UNKNOWN, FIT_DIVERGED.

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
    """
    result = fit_sessions([SessionInput(trials, names, camera_motion, markers, height_m)], paramset)[0]
    if isinstance(result, PblError):
        raise result
    return result


def fit_sessions(
    sessions: Sequence[SessionInput],
    paramset: Method[Params] | Paramset | Params | str | None = None,
    batch: int | None = None,
) -> list[SessionFit | PblError]:
    """Fit many sessions; those packed to the same sizes go through the device together, with the same results.

    A session that cannot be fitted has its `PblError` in its place. `batch`: most sessions at once
    (default: `BATCH` on a GPU, 1 on a CPU, which gains nothing by it); `implicit-adam` takes one at a time.

    Raises `PblError` SOLVER_UNKNOWN.
    """
    method = METHODS.find(paramset)
    solvers, most = (1, 1) if jax.default_backend() == "cpu" else (SOLVERS, BATCH)
    batch, taking = batch or most, threading.Lock()
    out: list[SessionFit | PblError | None] = [None] * len(sessions)
    results: list[Future[None]] = []

    def finish(packed: _Packed, solution: Solution | PblError) -> None:
        try:
            if isinstance(solution, PblError):
                raise solution
            out[packed.index] = _session_fit(packed, solution, method.paramset, sessions[packed.index])
        except PblError as error:
            out[packed.index] = error

    def solve(parts: Iterator[list[_Packed]]) -> None:
        while True:
            with taking:
                part = next(parts, None)
            if part is None:
                return
            solutions = method.function([p.session for p in part], method.params, [p.start for p in part])
            for each in zip(part, solutions, strict=True):
                results.append(threads.submit(finish, *each))

    # While batches are solved, the results of earlier ones are made and the next one is packed.
    with (
        ThreadPoolExecutor(PACKERS) as threads,
        contextlib.closing(prefetched(_batches(sessions, method.params, batch, out, threads), 1)) as parts,
        ThreadPoolExecutor(solvers) as pool,
    ):
        list(pool.map(solve, [parts] * solvers))  # raises what was raised there
        for result in results:
            result.result()
    return [r for r in out if r is not None]


@dataclasses.dataclass(frozen=True)
class _Packed:
    """A session ready for a solver, with its start; `seconds`: time that packing took."""

    index: int
    session: Session
    start: State
    seconds: float


def _batches(
    sessions: Sequence[SessionInput],
    params: Params,
    batch: int,
    out: list[SessionFit | PblError | None],
    threads: ThreadPoolExecutor,
) -> Iterator[list[_Packed]]:
    """Up to `batch` sessions of the same sizes and terms at a time; errors of the others go to `out`."""
    waiting: dict[tuple, list[_Packed]] = {}
    load_body()  # before the threads, each of which would load its own body and compile for it

    def pack(i: int) -> _Packed | PblError:
        begin, given = time.perf_counter(), sessions[i]
        try:
            check_height(given.height_m)
            session = make_session(given.trials, given.names, params, _motions(given), given.markers)
        except PblError as error:
            return error
        return _Packed(i, session, start_of(session), time.perf_counter() - begin)

    given, full = iter(range(len(sessions))), min(batch, FIRST)
    while some := list(itertools.islice(given, full)):
        for i, packed in zip(some, threads.map(pack, some), strict=True):
            if isinstance(packed, PblError):
                out[i] = packed
                continue
            problem = packed.session.problem
            shapes = tuple(a.shape for a in jax.tree.leaves(problem))
            key = (shapes, pixels_alone(problem), type(packed.session.trials[0]))
            waiting.setdefault(key, []).append(packed)
            if len(waiting[key]) == full:
                yield waiting.pop(key)
        full = min(batch, 2 * full)
    yield from waiting.values()


def _motions(given: SessionInput) -> list[str]:
    motion = given.camera_motion
    return [motion] * len(given.trials) if isinstance(motion, str) else list(motion)


def check_trial(
    trial: Trial,
    name: str,
    paramset: Method[Params] | Paramset | Params | str | None = None,
    markers: MarkerSet | None = None,
) -> tuple[np.ndarray, float]:
    """Frames (T,) bool of a trial that the fit would use, and the share of frames with the whole person in view.

    Raises `PblError` FIT_INPUT, VIEWS_DISAGREE or MARKER_SET_UNKNOWN if the trial cannot be fitted.
    """
    return _check_trial(trial, name, METHODS.find(paramset).params.view, markers)


def _session_fit(packed: _Packed, solution: Solution, paramset: Paramset, given: SessionInput) -> SessionFit:
    begin, session, motions = time.perf_counter(), packed.session, _motions(given)
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
        converged=solution.converged,
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
    )


#: Stands for the camera of a trial that has none.
NO_CAMERA = Camera(np.full((3, 3), np.nan), np.full(5, np.nan), "none: laboratory markers")
