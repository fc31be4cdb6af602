"""`fit_session` and `fit_sessions`: the functions that tables and commands call."""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax
import numpy as np

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers
from pbl_pipeline.methods import Method
from pbl_pipeline.names import check_height
from pbl_pipeline.paramset import Paramset
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

#: Sessions of the same sizes that are enough for a solver to begin: it takes more as they are packed, of which at most
#: twice as many wait.
FIRST = 16
#: Solvers at a time on a GPU: while the host works for one, the device iterates for the other; and threads that pack
#: sessions and make their results. More of them hold the interpreter when the solvers need it.
THREADS = 2


T = TypeVar("T")


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
    threads: int = THREADS,
) -> list[SessionFit | PblError]:
    """Fit many sessions; those packed to the same sizes go through the device together, with the same results.

    A session that cannot be fitted has its `PblError` in its place. `batch`: most sessions in one call of the solver
    (default: all on a GPU; 1 on a CPU, which gains nothing by more); `implicit-adam` takes one at a time. `threads`:
    that solve on a GPU, and as many that pack; fewer where other calls fit on it at the same time.

    Raises `PblError` SOLVER_UNKNOWN.
    """
    on_cpu = jax.default_backend() == "cpu"
    work = _Work(sessions, METHODS.find(paramset), max(batch or (1 if on_cpu else len(sessions)), 1))
    load_body()  # before the threads, each of which would load its own body and compile for it
    jobs = [work.solve] * (1 if on_cpu else threads) + [work.pack_and_finish] * threads
    with ThreadPoolExecutor(len(jobs)) as pool, work.ends_with_error():
        for ended in [pool.submit(work.guarded, job) for job in jobs]:
            ended.result()  # raises what was raised there
    return [r for r in work.out if r is not None]


@dataclasses.dataclass(frozen=True)
class _Packed:
    """A session ready for a solver, with its start; `seconds`: time that packing took; `kind`: the same for sessions of
    the same sizes and terms, which a solver can take together."""

    index: int
    session: Session
    start: State
    seconds: float
    kind: Hashable


class _Work:
    """The sessions of a call on their way through its threads: those that pack also make the results of what the
    others have solved."""

    def __init__(self, sessions: Sequence[SessionInput], method: Method[Params], most: int) -> None:
        self.sessions, self.method, self.most = sessions, method, most
        self.enough = min(most, FIRST)
        self.out: list[SessionFit | PblError | None] = [None] * len(sessions)
        #: Guards what follows.
        self.changed = threading.Condition()
        self.to_pack = deque(range(len(sessions)))
        self.packing = 0
        self.packed = dict[Hashable, list[_Packed]]()
        self.taken_by = Counter[Hashable]()  # solvers that take sessions of a kind
        self.solved = deque[tuple[_Packed, Solution | PblError]]()
        self.left = len(sessions)  # without a result
        self.failed = False

    @contextlib.contextmanager
    def ends_with_error(self) -> Iterator[None]:
        """An error inside ends all threads."""
        try:
            yield
        except BaseException:
            with self.changed:
                self.failed = True
                self.changed.notify_all()
            raise

    def guarded(self, job: Callable[[], None]) -> None:
        with self.ends_with_error():
            job()

    @property
    def _over(self) -> bool:
        return self.failed or not self.left

    @property
    def _full(self) -> bool:
        return sum(map(len, self.packed.values())) + self.packing >= 2 * self.enough

    def pack_and_finish(self) -> None:
        """Make results where a solution waits, else pack the next session."""
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self._over or self.solved or (self.to_pack and not self._full))
                if self._over:
                    return
                given = self.solved.popleft() if self.solved else None
                self.packing += given is None
                i = given[0].index if given else self.to_pack.popleft()
            done = self._pack(i) if given is None else self._finish(*given)
            with self.changed:
                self.packing -= given is None
                if isinstance(done, _Packed):
                    # In their order, not that in which the threads are done with them.
                    bisect.insort(self.packed.setdefault(done.kind, []), done, key=lambda packed: packed.index)
                else:
                    self.out[i] = done
                    self.left -= 1
                self.changed.notify_all()

    def solve(self) -> None:
        """Give the solver sessions of one kind after the other."""
        while (begin := self._begin_kind()) is not None:
            self._solve_kind(begin)

    def _begin_kind(self) -> _Packed | None:
        """One of the kind of which most are packed, once these are enough; or all there will be, of a kind that no
        other solver is taking. None at the end."""

        def kinds() -> list[Hashable]:
            last = self._full or not (self.to_pack or self.packing)
            return [k for k, p in self.packed.items() if len(p) >= self.enough or (last and not self.taken_by[k])]

        with self.changed:
            self.changed.wait_for(lambda: self._over or kinds())
            if self._over:
                return None
            kind = max(kinds(), key=lambda k: len(self.packed[k]))
            self.taken_by[kind] += 1
            return self._take(kind)

    def _take(self, kind: Hashable) -> _Packed | None:
        """One that is packed now."""
        with self.changed:
            waiting = self.packed.get(kind)
            if not waiting or self.failed:
                return None
            out = waiting.pop(0)
            if not waiting:
                del self.packed[kind]
            self.changed.notify_all()
            return out

    def _solve_kind(self, begin: _Packed) -> None:
        """Give the solver a session, and others of its kind as long as it asks and they are packed."""
        kind, taken, unsolved, starts = begin.kind, 0, deque[_Packed](), deque[State]()

        def take() -> Session | None:
            nonlocal taken
            packed = begin
            if taken == self.most:
                return None
            if taken and (packed := self._take(kind)) is None:
                return None
            taken += 1
            unsolved.append(packed)
            starts.append(packed.start)
            return packed.session

        sessions = _Ready(take, min(self.most, len(self.sessions)))
        beside = _Ready(lambda: starts.popleft() if starts else None)
        try:
            for solution in self.method.function(sessions, self.method.params, beside):
                with self.changed:
                    if not unsolved:
                        raise self._miscounted()
                    self.solved.append((unsolved.popleft(), solution))
                    self.changed.notify_all()
        finally:
            with self.changed:
                self.taken_by[kind] -= 1
                self.changed.notify_all()
        if (unsolved or not taken) and not self.failed:
            raise self._miscounted()

    def _miscounted(self) -> ValueError:
        return ValueError(f"{self.method.key} did not return a solution or an error for each session that it took")

    def _pack(self, i: int) -> _Packed | PblError:
        begin, given = time.perf_counter(), self.sessions[i]
        try:
            check_height(given.height_m)
            session = make_session(given.trials, given.names, self.method.params, _motions(given), given.markers)
        except PblError as error:
            return error
        shapes = tuple(a.shape for a in jax.tree.leaves(session.problem))
        kind = shapes, pixels_alone(session.problem), type(session.trials[0])
        return _Packed(i, session, start_of(session), time.perf_counter() - begin, kind)

    def _finish(self, packed: _Packed, solution: Solution | PblError) -> SessionFit | PblError:
        if isinstance(solution, PblError):
            return solution
        try:
            return _session_fit(packed, solution, self.method.paramset, self.sessions[packed.index])
        except PblError as error:
            return error


class _Ready(Iterator[T]):
    """What is ready: ends where nothing is, and may have more when it is asked again, up to `most`."""

    def __init__(self, take: Callable[[], T | None], most: int = 0) -> None:
        self._take, self._most = take, most

    def __next__(self) -> T:
        if (item := self._take()) is None:
            raise StopIteration
        return item

    def __length_hint__(self) -> int:
        return self._most


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
