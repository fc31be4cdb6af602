"""A session to fit: trials of every kind, validated and packed into arrays."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import MARKER_SETS, Body, MarkerSet, load_body, marker_set
from pbl_pipeline.depth.points import PointDepths
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.keypoints import (
    SEEN_SHARE,
    Keypoints,
    MultiView,
    WorldMarkers,
    blind_runs,
    bridge_gaps,
    check_views_agree,
    longest_run_s,
    visibility,
)
from pbl_pipeline.sensors.worn import Worn
from pbl_pipeline.video import undistort_px

from .params import CostParams, Params, ViewParams
from .problem import CLOCK_RANGE_S, Problem, TrialArrays, pack
from .rotations import rotation_matrices
from .units import BODY, body_metres, check_units, pixel_px
from .world_checks import Turned, explained, in_upright_world

#: R_nc of a level camera that looks along world +x: columns are the camera's x (right), y (down), z (forward).
LEVEL_CAMERA_R_NC = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

#: Kinds of trials.
Trial = Keypoints | MultiView | WorldMarkers

#: Sources of the camera's orientation (`TrialFit.orientation_source`).
MEASURED, CALIBRATED, LEVEL, GAIT = "measured: phone", "measured: calibration", "assumed: level", "estimated: gait"

#: Share of a trial's used time that the phone's log must cover.
PHONE_COVERAGE = 0.9


@dataclasses.dataclass(frozen=True)
class Session:
    """One session. `orientation`: source of each camera's; `metre`: metres of the fit in one of the detector's
    (`units.body_metres`)."""

    body: Body
    markers: MarkerSet
    names: tuple[str, ...]
    trials: tuple[Trial, ...]
    arrays: tuple[TrialArrays, ...]
    in_view_share: tuple[float, ...]
    orientation: tuple[str, ...]
    problem: Problem
    metre: float = 1.0
    turned: tuple[Turned, ...] = ()  # trials whose vertical was wrong (`world_checks`)
    worn: Worn | None = None
    depths: tuple[PointDepths | None, ...] = ()  # of each trial; empty without any

    @property
    def plain(self) -> bool:
        """True if keypoints and the phone's orientation are all that was measured."""
        return self.worn is None and not self.depths

    def frames(self, i: int) -> slice:
        """Position of trial `i` in the packed frames."""
        start = sum(len(a.time_s) for a in self.arrays[:i])
        return slice(start, start + len(self.arrays[i].time_s))


def make_session(
    trials: Sequence[Trial],
    names: Sequence[str],
    params: Params,
    camera_motion: Sequence[str] = (),
    markers: MarkerSet | None = None,
) -> Session:
    """Validate the trials of one session and pack them, in the units of the paramset.

    Raises `PblError` FIT_INPUT (no trial, too few frames in view, time stamps out of order, nothing seen, values not
    finite where confidence is positive, trials of different kinds, a paramset in unknown units), VIEWS_DISAGREE,
    MARKER_SET_UNKNOWN, PHONE_LOG.
    """
    cost: CostParams = getattr(params, "cost", CostParams())  # a laboratory's own solver may have none
    check_units(cost)
    if not trials or len(trials) != len(names):
        raise _input_error(f"{len(trials)} trials and {len(names)} names", "at least one trial and a name for each")
    kinds = {type(t) for t in trials}
    sets = {t.marker_set for t in trials}
    if len(kinds) > 1 or len(sets) > 1:
        what = ", ".join(sorted([k.__name__ for k in kinds] + list(sets)))
        raise _input_error(what, "one kind of trial and one marker set in a session")
    if len({len(t.views) for t in trials if isinstance(t, MultiView)}) > 1:
        raise _input_error("trials with different numbers of cameras", "the same cameras in all trials of a session")
    table = markers or marker_set(trials[0].marker_set)
    motions = list(camera_motion) or ["static"] * len(trials)
    if len(motions) != len(trials) or not set(motions) <= {"static", "handheld"}:
        raise _input_error(f"camera motions {', '.join(motions)}", "'static' or 'handheld' for each trial")
    checked = [check_trial(t, n, params.view, table) for t, n in zip(trials, names, strict=True)]
    worlds = [c.world for c in checked if c.world is not None]
    trials = [w.trial for w in worlds] or trials
    table = _measured(table) if isinstance(trials[0], WorldMarkers) else table
    arrays, orientation = [], []
    for trial, name, motion, seen in zip(trials, names, motions, checked, strict=True):
        packed, source = _arrays(trial, name, motion, seen.used, cost.pixel)
        arrays.append(packed)
        orientation.append(source)
    body, metre = load_body(), 1.0
    if cost.metre == BODY and isinstance(trials[0], Keypoints):
        metre = body_metres(body, table, [a.x_cam for a in arrays], [a.c_3d * a.used[:, None, None] for a in arrays])
        arrays = [dataclasses.replace(a, x_cam=metre * a.x_cam) for a in arrays]
    return Session(
        body=body,
        markers=table,
        names=tuple(names),
        trials=tuple(trials),
        arrays=tuple(arrays),
        in_view_share=tuple(c.whole_share for c in checked),
        orientation=tuple(orientation),
        problem=pack(arrays, body, table),
        metre=metre,
        turned=tuple(w for w in worlds if w.axis),
    )


@functools.cache
def _measured(markers: MarkerSet) -> MarkerSet:
    """Return an included set for markers in the world: its `weight_3d` is of a detector's depth, which has no part."""
    included = markers.name in MARKER_SETS and markers is marker_set(markers.name)
    return dataclasses.replace(markers, weight_3d=np.ones(len(markers))) if included else markers


class CheckedTrial(NamedTuple):
    """Frames (T,) bool of a trial that a fit would use, the share of frames with the whole person in view, and the
    trial in a world whose z is up (None for one camera)."""

    used: np.ndarray
    whole_share: float
    world: Turned | None


def check_trial(trial: Trial, name: str, view: ViewParams, markers: MarkerSet | None = None) -> CheckedTrial:
    """Check a trial before a fit.

    Raises `PblError` FIT_INPUT, VIEWS_DISAGREE, MARKER_SET_UNKNOWN or PHONE_LOG if the trial cannot be fitted.
    """
    table = markers or marker_set(trial.marker_set)
    table.check_names(trial.names)
    step = np.diff(trial.time_s)
    if len(trial.time_s) < 2 or not np.all(np.isfinite(trial.time_s)) or np.any(step <= 0):
        bad = int(np.sum(~(step > 0)))
        raise _input_error(
            said(
                "trial {name}: {n} time stamps, {bad} of the steps not positive",
                name=name,
                n=len(trial.time_s),
                bad=bad,
            ),
            "at least two, finite and strictly increasing",
            name,
        )
    if isinstance(trial, Keypoints):
        _check_finite(name, trial.confidence, trial.xy_px)
        if has_3d(trial):
            _check_finite(name, trial.confidence, trial.xyz_cam_m)
        shown = visibility(trial, view.min_confidence, view.max_gap_s, view.max_blind_s)
        used = _long_enough(shown.counts, trial.time_s, name, view)
        _check_phone(trial, name, used)
        return CheckedTrial(used, shown.whole_share, None)
    if isinstance(trial, MultiView):
        for k in trial.views:
            _check_finite(name, k.confidence, k.xy_px)
        try:
            check_views_agree(trial, name)
        except PblError as error:
            if (explanation := explained(trial, name, table)) is not None:
                raise explanation from error
            raise
        confidence = np.max([k.confidence for k in trial.views], axis=0)
    else:
        _check_finite(name, trial.confidence, trial.xyz_world_m)
        confidence = trial.confidence
    enough = np.mean(confidence > 0, axis=1) >= SEEN_SHARE
    in_view = enough & (_mean_seen(confidence) >= view.min_confidence)
    used = bridge_gaps(in_view, trial.time_s, view.max_gap_s) & ~blind_runs(enough, trial.time_s, view.max_blind_s)
    world = in_upright_world(trial, name, table)
    return CheckedTrial(_long_enough(used, trial.time_s, name, view), float(np.mean(in_view)), world)


def _long_enough(used: np.ndarray, time_s: np.ndarray, name: str, view: ViewParams) -> np.ndarray:
    """Return `used` (T,) if it has a run that can be fitted. Raises `PblError` FIT_INPUT."""
    longest = longest_run_s(used, time_s)
    if longest < view.min_in_view_s:
        raise _input_error(
            said("trial {name}: the whole person is in view for {s:.2f} s at a stretch", name=name, s=longest),
            said("at least {s:.1f} s", s=view.min_in_view_s),
            name,
            "film so that head and feet stay in the picture for a few steps, or pick another person with --person",
        )
    return used


def _mean_seen(confidence: np.ndarray) -> np.ndarray:
    """Mean confidence of the markers seen in each frame: a missing marker does not make the others less certain."""
    count = np.maximum(np.sum(confidence > 0, axis=1), 1)
    return np.sum(confidence, axis=1) / count


def has_3d(trial: Keypoints) -> bool:
    """True if the trial has any 3D points."""
    frames = zip(trial.xyz_cam_m, trial.confidence, strict=True)  # one by one: mostly the first one decides
    return any(np.isfinite(x[c > 0]).any() for x, c in frames)


def _check_finite(name: str, confidence: np.ndarray, points: np.ndarray) -> None:
    if not np.isfinite(points).all() and np.any((confidence > 0) & ~_finite(points)):
        raise _input_error(
            said("trial {name}: NaN or infinite points with confidence above 0", name=name), "confidence 0 there", name
        )


def _finite(points: np.ndarray) -> np.ndarray:
    """(...) bool: points (..., D) without a NaN or infinite coordinate. A product: sums of 2 or 3 numbers are slow."""
    return np.isfinite(points @ np.ones(points.shape[-1]))


def _arrays(trial: Trial, name: str, motion: str, used: np.ndarray, pixel: str) -> tuple[TrialArrays, str]:
    """The arrays of a trial and the source of its camera's orientation."""
    t, j = len(trial.time_s), len(trial.names)
    if isinstance(trial, WorldMarkers):
        seen = trial.confidence > 0
        none = np.zeros((t, 0, j))
        return TrialArrays(
            time_s=np.asarray(trial.time_s, float),
            used=used,
            x_cam=np.zeros((t, 0, j, 3)),
            c_3d=none,
            xy_px=np.zeros((t, 0, j, 2)),
            c_2d=none,
            x_world=np.where(seen[..., None], trial.xyz_world_m, 0.0),
            c_world=np.asarray(trial.confidence, float),
            R_nc=np.zeros((t, 0, 3, 3)),
            p_nc=np.zeros((t, 0, 3)),
            camera_matrix=np.zeros((t, 0, 3, 3)),
            pixel_px=np.zeros((t, 0)),
        ), CALIBRATED
    phone = None
    if isinstance(trial, MultiView):
        views = trial.views
        R = np.tile(np.stack([p.R_nc for p in trial.poses]), (t, 1, 1, 1))
        p = np.tile(np.stack([p.p_nc for p in trial.poses]), (t, 1, 1))
        source = CALIBRATED
    else:
        views = (trial,)
        p = np.zeros((t, 1, 3))
        R, phone, source = _orientation(trial, name, motion, used)
        R = R[:, None]
    per_view = [_view(k) for k in views]
    xy, c_2d, x_cam, c_3d = (np.stack(a, axis=1) for a in zip(*per_view, strict=True))
    return TrialArrays(
        time_s=np.asarray(trial.time_s, float),
        used=used,
        x_cam=x_cam,
        c_3d=c_3d,
        xy_px=xy,
        c_2d=c_2d,
        x_world=np.zeros((t, 0, 3)),
        c_world=np.zeros((t, 0)),
        R_nc=R,
        p_nc=p,
        camera_matrix=np.tile(np.stack([k.camera.matrix for k in views]), (t, 1, 1, 1)),
        pixel_px=np.stack([pixel_px(k, pixel) for k in views], axis=1),
        phone_time_s=None if phone is None else phone[0],
        phone_quat_wxyz=None if phone is None else phone[1],
        phone_clock_sd_s=views[0].phone_clock_sd_s,
    ), source


def _view(trial: Keypoints) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Undistorted pixels, their confidence, 3D points, theirs."""
    c = np.asarray(trial.confidence, float)
    seen = c > 0
    known = seen & _finite(trial.xyz_cam_m)
    xy, x_cam = np.array(trial.xy_px, order="C"), np.array(trial.xyz_cam_m, order="C")  # views are written below
    for x, known_there in ((xy, seen), (x_cam, known)):
        x.reshape(-1, x.shape[-1])[np.flatnonzero(~known_there)] = 0.0
    return undistort_px(xy, trial.camera), c, x_cam, np.where(known, c, 0.0)


def _orientation(
    trial: Keypoints, name: str, motion: str, used: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray] | None, str]:
    """R_nc (T, 3, 3) to start from, the phone's log where the camera moves, and the source."""
    t = len(trial.time_s)
    if trial.phone_time_s is None or trial.phone_quat_wxyz is None:
        return np.tile(LEVEL_CAMERA_R_NC, (t, 1, 1)), None, LEVEL
    turned = rotation_matrices(trial.phone_time_s, trial.phone_quat_wxyz, trial.time_s)
    if motion == "static":
        return np.tile(Rotation.from_matrix(turned[used]).mean().as_matrix(), (t, 1, 1)), None, MEASURED
    return turned, (np.asarray(trial.phone_time_s), np.asarray(trial.phone_quat_wxyz)), MEASURED


def _check_phone(trial: Keypoints, name: str, used: np.ndarray) -> None:
    """The phone's log must cover the time that is used. Raises `PblError` PHONE_LOG."""
    if trial.phone_time_s is None:
        return
    first, last = trial.time_s[np.flatnonzero(used)[[0, -1]]]
    covered = min(last, trial.phone_time_s[-1]) - max(first, trial.phone_time_s[0])
    if covered < PHONE_COVERAGE * (last - first) - CLOCK_RANGE_S:
        raise PblError(
            "PHONE_LOG",
            found=said(
                "trial {name}: orientation from {start:.2f} to {end:.2f} s",
                name=name,
                start=trial.phone_time_s[0],
                end=trial.phone_time_s[-1],
            ),
            expected=said(
                "the time in which the person is in view, {start:.2f} to {end:.2f} s of the video",
                start=first,
                end=last,
            ),
            next_step="pass the log of this video, on its clock (docs/phone_capture.md), or leave it out",
            key=name,
        )


def _input_error(found: str, expected: str, key: str | None = None, next_step: str = "") -> PblError:
    return PblError(
        "FIT_INPUT",
        found=found,
        expected=expected,
        next_step=next_step or "look at the keypoints file (docs/files.md) and detect again",
        key=key,
    )
