"""Results of a session fit and the file formats `<name>.fit.npz` and `<name>.angles.csv`."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.body import SCALE_NAMES, SLIDES
from pbl_pipeline.bounded import parse_json
from pbl_pipeline.errors import unread_file
from pbl_pipeline.files import check_numbers, load_npz, picture_size, text_of, texts_of
from pbl_pipeline.qc import Check
from pbl_pipeline.records import from_json, plain, record
from pbl_pipeline.results.fits import DepthFit, Residuals, SensorFit, Solution, TrialFigures
from pbl_pipeline.video import Camera, check_lens

#: Median standard deviation of a joint angle from which on the joint counts as not observed.
SD_WARN_DEG = 20.0


@dataclasses.dataclass(frozen=True)
class TrialFit:
    """The fitted movement of one trial. World frame: z up, origin at the camera, metres.

    time_s (T,); joint_names (40,); qpos (T, 40) in m and rad, NaN in frames outside the time the person is in view;
    qpos_sd (T, 40), NaN where the solver computes none; marker_names (J,); markers_world_m (T, J, 3);
    phone_quat_wxyz (T, 4) camera to world; scale (8,) multipliers of the groups in `body.SCALE_NAMES` (1 = the
    unscaled body; a group's bodies have this scale, all others that of "overall"); site_offset_m (J, 3) in the
    marker's body frame; residual_2d_px (T, J) and residual_3d_m (T, J), NaN where nothing was seen. Of several cameras
    residual_2d_px is the mean over them, and camera, phone_quat_wxyz and camera_position_m (3,) are the first one's;
    laboratory markers have none (NaN). phone_clock_offset_s: the sensor's clock minus the video's, NaN where not
    estimated. orientation_source: source of the world's vertical. height_m: the person's stated body height, which sets
    the scale of a fit to one camera (`known_height.py`), NaN if it was not stated. confidence_curve: that of the
    keypoints, which tells their detector, "" if they have none or the file is from before it was kept. sensors: what
    was found of each wearable sensor, depth: of the trial's depth recording, if it has one. with_depths: depth
    recordings set the scale, this trial's or another's. frame (T,): number of each frame in the video, None: all of it.
    """

    name: str
    time_s: np.ndarray
    joint_names: tuple[str, ...]
    qpos: np.ndarray
    qpos_sd: np.ndarray
    marker_set: str
    marker_names: tuple[str, ...]
    markers_world_m: np.ndarray
    phone_quat_wxyz: np.ndarray
    scale: np.ndarray
    site_offset_m: np.ndarray
    residual_2d_px: np.ndarray
    residual_3d_m: np.ndarray
    camera: Camera
    image_size_px: tuple[int, int]
    camera_motion: str  # "static" or "handheld"
    camera_position_m: np.ndarray
    orientation_source: str
    phone_clock_offset_s: float
    solver: str
    params_hash: str
    body_sha256: str
    loss: float
    seconds: float
    height_m: float = float("nan")
    confidence_curve: str = ""
    sensors: tuple[SensorFit, ...] = ()
    with_depths: bool = False
    depth: DepthFit | None = None
    frame: np.ndarray | None = None

    @property
    def frame_numbers(self) -> np.ndarray:
        """Number (T,) of each frame in the video."""
        return np.arange(len(self.time_s)) if self.frame is None else self.frame

    @property
    def sized(self) -> bool:
        """True if the person's stated height or depth recordings set the scale of one camera."""
        return bool(np.isfinite(self.height_m)) or self.with_depths

    @functools.cached_property
    def not_observed(self) -> frozenset[str]:
        """Joints whose standard deviation is `SD_WARN_DEG` and more in the median over the frames: something must hold
        them in `qpos`, but their angles are not measured."""
        sd = np.rad2deg(self.qpos_sd[np.isfinite(self.qpos_sd).all(axis=1)])
        unknown = ~(np.median(sd, axis=0) < SD_WARN_DEG) if len(sd) else np.zeros(len(self.joint_names), bool)
        return frozenset(n for n, u in zip(self.joint_names, unknown, strict=True) if u and n not in SLIDES)

    @property
    def observed_qpos(self) -> np.ndarray:
        """`qpos` (T, 40) with NaN for joints that were not observed: for all that gives out angles."""
        return np.where([n in self.not_observed for n in self.joint_names], np.nan, np.asarray(self.qpos, float))

    @property
    def figures(self) -> TrialFigures:
        """The trial in figures."""
        fitted, source = int(np.isfinite(self.qpos).all(axis=1).sum()), self.orientation_source
        return TrialFigures(self.name, fitted, Residuals.of([self]), source, self.phone_clock_offset_s)

    def save(self, path: str | Path) -> None:
        """Write `<name>.fit.npz`."""
        arrays = {k: np.asarray(getattr(self, k)) for k in _ARRAYS}
        if self.sensors:
            arrays["sensors"] = np.asarray(json.dumps(plain(self.sensors)))
        if self.depth is not None:
            arrays["depth"] = np.asarray(json.dumps(plain(self.depth)))
        if self.frame is not None:
            arrays["frame"] = np.asarray(self.frame)
        arrays["camera_matrix"] = np.asarray(self.camera.matrix)
        arrays["distortion"] = np.asarray(self.camera.distortion)
        arrays["camera_source"] = np.asarray(self.camera.source)
        np.savez(path, allow_pickle=False, **arrays)  # packing saves a tenth of the bytes and costs 16 times the time

    @classmethod
    def load(cls, path: str | Path) -> TrialFit:
        """Read `<name>.fit.npz`. Raises `PblError` FILE_MISSING, FILE_FORMAT, CAMERA_INVALID. Never unpickles."""
        # Older files lack what could not be stated or was not kept then, others have no sensors or depths.
        later: dict[str, Any] = {
            "height_m": np.asarray(np.nan),
            "confidence_curve": np.asarray(""),
            "with_depths": np.asarray(False),
            "sensors": np.asarray("[]"),
            "depth": np.asarray("null"),
        }
        needed = [k for k in (*_ARRAYS, "camera_matrix", "distortion", "camera_source") if k not in later]
        next_step = "see docs/files.md, section fit.npz"
        data = later | load_npz(path, (*later, "frame"), needed, next_step)
        shapes = _shapes(data["time_s"].size, data["joint_names"].size, data["marker_names"].size)
        check_numbers(path, data, shapes | ({"frame": shapes["time_s"]} if "frame" in data else {}))
        values: dict[str, Any] = {k: data[k] for k in _ARRAYS} | {"frame": data.get("frame")}
        try:
            values["sensors"] = tuple(from_json(SensorFit, s) for s in parse_json(text_of(path, data, "sensors")))
            depth = parse_json(text_of(path, data, "depth"))
            values["depth"] = None if depth is None else from_json(DepthFit, depth)
        except (ValueError, TypeError, AttributeError) as error:
            raise unread_file(error, "a file that `pbl fit` wrote", next_step, path) from error
        for k in ("joint_names", "marker_names"):
            values[k] = texts_of(path, data, k)
        for k in ("name", "marker_set", "camera_motion", "orientation_source", "solver", "params_hash", "body_sha256"):
            values[k] = text_of(path, data, k)
        values["confidence_curve"] = text_of(path, data, "confidence_curve")
        for k in ("loss", "seconds", "phone_clock_offset_s", "height_m"):
            values[k] = float(values[k])
        values["with_depths"] = bool(values["with_depths"])
        camera = Camera(data["camera_matrix"], data["distortion"], text_of(path, data, "camera_source"))
        values["image_size_px"] = (0, 0)
        if not np.isnan(camera.matrix).all():  # as of markers of a laboratory
            values["image_size_px"] = picture_size(path, data["image_size_px"])
            check_lens(camera.matrix, camera.distortion, values["image_size_px"], str(path))
        return cls(**values, camera=camera)


@record(kw_only=True)
class SessionFit(Solution):
    """All trials of a session with one body."""

    trials: tuple[TrialFit, ...]
    site_offset_m: np.ndarray
    qc: tuple[Check, ...]


#: Fields of a trial that its file has as they are.
_ARRAYS = [f.name for f in dataclasses.fields(TrialFit) if f.name not in ("camera", "sensors", "depth", "frame")]


def _shapes(n: int, q: int, j: int) -> dict[str, tuple[int | None, ...]]:
    """Shapes of the fields of a fit of `n` frames, `q` joints and `j` markers."""
    shapes: dict[str, tuple[int | None, ...]] = dict.fromkeys(("qpos", "qpos_sd"), (n, q))
    shapes |= dict.fromkeys(("residual_2d_px", "residual_3d_m"), (n, j))
    shapes |= {"time_s": (n,), "markers_world_m": (n, j, 3), "phone_quat_wxyz": (n, 4), "site_offset_m": (j, 3)}
    shapes |= {"scale": (len(SCALE_NAMES),), "image_size_px": (2,), "camera_matrix": (3, 3), "distortion": (5,)}
    return shapes | {
        "with_depths": (),
        "loss": (),
        "seconds": (),
        "height_m": (),
        "camera_position_m": (3,),
        "phone_clock_offset_s": (),
    }
