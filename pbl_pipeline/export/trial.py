"""Data of one trial for export: the fit and further results, in the frames of the formats."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

from pbl_pipeline.body import MarkerSet, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import BodyPoses, TrialMetrics, trial_poses
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.kinetics import TrialKinetics
from pbl_pipeline.sampling import interval_of
from pbl_pipeline.video import PhoneLog
from pbl_pipeline.visit import Recording, Visit

#: Largest difference of stamps (s) from a grid of one rate at which frames are exported as they are.
EVEN_WITHIN_S = 5e-4
#: Longest gap between frames that is interpolated when a trial is brought to an even rate (as for curves of cycles).
MAX_GAP_S = 0.15
#: Distance of the further markers of a body along its axes (m).
BODY_POINT_M = 0.1


@dataclasses.dataclass(frozen=True)
class ExportTrial:
    """Data of one trial for export; None for data that are not known."""

    name: str  # of its folder and files
    fit: TrialFit
    markers: MarkerSet | None = None  # the lab's own marker table of the fit
    keypoints: Keypoints | None = None
    measured: TrialMetrics | None = None
    log: PhoneLog | None = None  # of the phone that filmed
    log_shift_s: float = 0.0  # from the log's times to the video's
    methods: Mapping[str, str] = dataclasses.field(default_factory=dict)  # stage -> method in words
    fitted_with: str = ""  # version and commit of the software
    activity: str = ""
    kinetics: TrialKinetics | None = None
    mass_kg: float | None = None

    @classmethod
    def of(cls, recording: Recording, visit: Visit) -> ExportTrial:
        """Return the data of a fitted recording of a visit. Raises as `Recording.fit`, `keypoints` and `log`."""
        assert recording.fit is not None
        log, shift = recording.log or (None, 0.0)
        forces = () if visit.kinetics is None else visit.kinetics.trials
        return cls(
            name=recording.name,
            fit=recording.fit,
            markers=recording.markers,
            keypoints=recording.keypoints,
            measured=recording.measured,
            log=log,
            log_shift_s=shift,
            methods=visit.methods,
            activity=recording.condition.activity,
            fitted_with="" if visit.solution is None else visit.solution.software,
            kinetics=next((t for t in forces if t.name == recording.name), None),
            mass_kg=None if visit.kinetics is None else visit.kinetics.mass_kg,
        )

    @functools.cached_property
    def poses(self) -> BodyPoses:
        """The bodies in the world, frame by frame."""
        return trial_poses(self.fit)

    @functools.cached_property
    def known(self) -> np.ndarray:
        """(T,) frames with a pose."""
        return np.all(np.isfinite(self.fit.qpos), axis=1)

    @functools.cached_property
    def even(self) -> EvenTrial:
        """The movement at one rate."""
        return _even(self)


@dataclasses.dataclass(frozen=True)
class EvenTrial:
    """A movement at one rate: frame i is at (first + i) / rate_hz on the video's clock. World with z up, NaN where not
    known."""

    rate_hz: float
    first: int
    resampled: bool  # interpolated, because the frames are not evenly spaced
    markers_m: np.ndarray  # (N, J, 3)
    position_m: np.ndarray  # (N, B, 3) of the bodies
    rotation: np.ndarray  # (N, B, 3, 3) body to world

    @property
    def time_s(self) -> np.ndarray:
        """(N,) on the video's clock."""
        return (self.first + np.arange(len(self.markers_m))) / self.rate_hz


def wanted_markers(trial: ExportTrial) -> MarkerSet:
    """Positions of the fit's markers on the body.

    Raises `PblError` MARKER_SET_UNKNOWN if the body has no such markers or they have other names.
    """
    try:
        found = marker_set(trial.fit.marker_set) if trial.markers is None else trial.markers
        found.check_names(trial.fit.marker_names)
    except PblError as error:
        raise PblError(
            error.code,
            found=error.found,
            expected=error.expected,
            next_step="pass the table that the fit was made with, --marker-set TABLE.csv; --markers-only writes a .trc "
            "without the positions of the markers on the body",
            key=trial.name,
        ) from error
    return found


def with_body_points(trial: ExportTrial) -> ExportTrial:
    """Add three markers to every body, NAME_o at its origin and NAME_x, NAME_y `BODY_POINT_M` along its axes: they
    determine its orientation also if the marker set does not (a wrist seen as one point).

    Raises `PblError` MARKER_SET_UNKNOWN as `wanted_markers`.
    """
    own, fit, poses = wanted_markers(trial), trial.fit, trial.poses
    body, n = poses.body, len(poses.body.body_names)
    local = np.tile(BODY_POINT_M * np.eye(3)[[2, 0, 1]] * [[0.0], [1.0], [1.0]], (n, 1))
    index = np.repeat(np.arange(n), 3)
    names = tuple(f"{b}_{end}" for b in body.body_names for end in "oxy")
    unscaled = local / np.asarray(fit.scale, float)[body.scale_index[index], None]
    world = poses.position_m[:, index] + np.einsum("tjab,jb->tja", poses.rotation[:, index], local)
    markers = MarkerSet(
        own.name,
        (*own.names, *names),
        (*own.body_names, *(body.body_names[i] for i in index)),
        np.concatenate([own.body_index, index]),
        np.concatenate([own.position_m, unscaled]),
        np.concatenate([own.weight_3d, np.ones(3 * n)]),
    )
    more = dataclasses.replace(
        fit,
        marker_names=markers.names,
        markers_world_m=np.concatenate([fit.markers_world_m, world], axis=1),
        site_offset_m=np.concatenate([fit.site_offset_m, np.zeros((3 * n, 3))]),
    )
    return dataclasses.replace(trial, fit=more, markers=markers)


def site_positions(markers: MarkerSet, fit: TrialFit, scale_index: np.ndarray) -> Float[np.ndarray, "J 3"]:
    """Positions of the fitted markers in the frames of the scaled bodies (m): scale * (position + offset)."""
    own = np.asarray(fit.scale, float)[scale_index[np.asarray(markers.body_index)]]
    return own[:, None] * (markers.position_m + np.asarray(fit.site_offset_m, float))


def _even(trial: ExportTrial) -> EvenTrial:
    fit, time = trial.fit, np.asarray(trial.fit.time_s, float)
    rate = _rate(time)
    first = round(time[0] * rate)
    if np.max(np.abs((first + np.arange(len(time))) / rate - time)) <= EVEN_WITHIN_S:
        markers = np.asarray(fit.markers_world_m, float)
        return EvenTrial(rate, first, False, markers, trial.poses.position_m, trial.poses.rotation)
    rate = 1.0 / interval_of(time)
    first, last = int(np.ceil(time[0] * rate - 1e-6)), int(np.floor(time[-1] * rate + 1e-6))
    at = np.arange(first, last + 1) / rate
    poses = trial_poses(dataclasses.replace(fit, qpos=interpolated(time, np.asarray(fit.qpos, float), at)))
    markers = interpolated(time, np.asarray(fit.markers_world_m, float).reshape(len(time), -1), at)
    return EvenTrial(rate, first, True, markers.reshape(len(at), -1, 3), poses.position_m, poses.rotation)


def _rate(time: np.ndarray) -> float:
    """Frames a second over the whole trial. Raises `PblError` EXPORT_INPUT for fewer than two frames."""
    if len(time) < 2:
        raise PblError(
            "EXPORT_INPUT",
            found="one frame, which has no rate",
            expected="at least two frames",
            next_step="export another format, or fit a longer recording",
        )
    return (len(time) - 1) / float(time[-1] - time[0])


def interpolated(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N, C) of (T, C) at the times `at`: cubic splines over known frames that are not further apart than `MAX_GAP_S`,
    NaN elsewhere."""
    out = np.full((len(at), values.shape[1]), np.nan)
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    for part in np.split(known, np.flatnonzero(np.diff(time[known]) > MAX_GAP_S) + 1):
        if len(part) < 2:
            continue
        inside = (at >= time[part[0]]) & (at <= time[part[-1]])
        spline = make_interp_spline(time[part], values[part], k=min(3, len(part) - 1))
        out[inside] = spline(at[inside])
    return out
