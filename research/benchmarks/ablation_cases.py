"""Factors of the ablation, changed one at a time, and its walks.

A `Setup` says how a session is observed and fitted; `Setup()` is the benchmark's default (research/reports). A
`Factor` is a setup that differs from it in one thing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pbl_pipeline.body import SCALE_NAMES
from pbl_pipeline.fit import METHODS, SessionInput
from pbl_pipeline.fit.params import POSE_PRIOR_DEG
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.synthetic import NO_NOISE, Noise, Seen
from research.walker.observe import observe
from research.walker.walk import person, walk_qpos

#: Walks: `source(time_s, seed, trial)` gives qpos (T, 40) of a person's trial in the world of `pbl_pipeline.synthetic`.
WalkSource = Callable[[np.ndarray, int, int], np.ndarray]


def walker(time_s: np.ndarray, seed: int, trial: int) -> np.ndarray:
    """Walks as `pbl bench fit` has them: trial k of person i walks with seed 1000 k + i."""
    return walk_qpos(time_s, 1000 * trial + seed)


#: Where walks may come from; `--walks` of the command names one.
WALKS: dict[str, WalkSource] = {"walker": walker}
#: The detector of the benchmark.
NOISE = Noise()


#: Places of the segments on both sides in the scales.
LEFT_SCALES, RIGHT_SCALES = (
    [i for i, n in enumerate(SCALE_NAMES) if n.startswith(side)] for side in ("left_", "right_")
)


@dataclasses.dataclass(frozen=True)
class Setup:
    """Observation and fit of a session.

    noise
        Of the detector.
    constant_px, slow_px
        Added to the pixels: one error per marker and trial that does not change; noise with the memory of the 3D noise.
        The walker's own pixel noise has neither. Standard deviations per axis (px).
    doubted_share
        Share of the points (marker and frame) whose confidence is 0.001: as good as not found, but in the picture, so
        that the frame counts as one with the whole person in view.
    site, size
        Factor of the person's marker offsets and of the deviations of the eight scales from 1.
    sides_alike
        A left segment's scale is that of the right one. The walker draws the two apart, each with its own 5 %.
    squash, lean_deg
        What the detector gets wrong in 3D at all times: depth along the line of sight multiplied by this, and all
        points turned so that the head comes towards the camera by this angle. Pixels are as they were.
    focal
        The focal length that the fit is told, over the true one.
    motion, tilt_deg, with_phone
        Of the camera, as in `observe`.
    with_3d
        False: pixels only.
    n_trials, fps
        Of the session; a trial lasts as long as `session` is asked for.
    marker_set, params
        The set that is seen and the name of the fit's paramset.
    times, values
        Parameters of the paramset by their path ("cost.weight_2d"): multiplied by a number; set to one.
    """

    noise: Noise = NOISE
    constant_px: float = 0.0
    slow_px: float = 0.0
    doubted_share: float = 0.0
    site: float = 1.0
    size: float = 1.0
    sides_alike: bool = False
    squash: float = 1.0
    lean_deg: float = 0.0
    focal: float = 1.0
    motion: str = "static"
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    with_phone: bool | None = None
    with_3d: bool = True
    n_trials: int = 1
    fps: float = 30.0
    marker_set: str = "bml_movi_87"
    params: str = "gauss-newton"
    times: Mapping[str, float] = dataclasses.field(default_factory=dict)
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Factor:
    """One row of the table."""

    group: str
    name: str
    setup: Setup


#: The benchmark's default, the row that all others are compared with.
DEFAULT = Factor("default", "as the benchmark", Setup())


def factors() -> tuple[Factor, ...]:
    """Return all rows but the default."""
    rows: list[Factor] = []

    def add(group: str, name: str, **changes: Any) -> None:
        rows.append(Factor(group, name, Setup(**changes)))

    base = NOISE

    def noise(**changes: Any) -> Noise:
        return dataclasses.replace(base, **changes)

    for k in (0.0, 0.5, 2.0):
        add("detector", f"3D noise across the sight x{k:g}", noise=noise(across_m=k * base.across_m))
    for k in (0.0, 2.0, 4.0):
        add("detector", f"3D noise along the sight x{k:g}", noise=noise(along_m=k * base.along_m))
    for k in (0.0, 2.0):
        add("detector", f"constant 3D error of each marker x{k:g}", noise=noise(constant_m=k * base.constant_m))
    for k in (0.0, 2.0):
        add("detector", f"pixel noise x{k:g}", noise=noise(xy_px=k * base.xy_px))
    add("detector", "pixels also err slowly, 3 px", slow_px=3.0)
    add("detector", "pixels also err constantly, 3 px", constant_px=3.0)
    add("detector", "pixels also err both ways, 3 px each", slow_px=3.0, constant_px=3.0)
    for share in (0.0, 0.10, 0.30):
        add("detector", f"outliers {share:.0%}", noise=noise(outlier_share=share))
    for share in (0.0, 0.30):
        add("detector", f"points missing {share:.0%}", noise=noise(drop_share=share))
    add("detector", "points of confidence 0.001, 30 %", doubted_share=0.30)
    add("detector", "3D depth x0.8", squash=0.8)
    add("detector", "3D leans to the camera by 10 deg", lean_deg=10.0)
    for k in (0.0, 2.0):
        add("body", f"marker offsets x{k:g}", site=k)
    for k in (0.0, 2.0):
        add("body", f"spread of the scales x{k:g}", size=k)
    add("body", "left and right scales alike", sides_alike=True)
    add("body", "offsets and scales 0", site=0.0, size=0.0)
    add("camera", "focal length told 5 % too long", focal=1.05)
    add("camera", "focal length told 5 % too short", focal=0.95)
    add("camera", "tilted up 5 deg, not known", tilt_deg=(5.0, 0.0))
    add("camera", "rolled 5 deg, not known", tilt_deg=(0.0, 5.0))
    add("camera", "handheld, with the phone's log", motion="handheld")
    for k in (0.1, 10.0):
        add("fit", f"smoothness weight x{k:g}", times={"smooth_per_rad2": k, "smooth_per_m2": k})
    for name, path in (("2D", "weight_2d"), ("3D", "weight_3d"), ("offset", "weight_offset_per_m2")):
        for k in (0.1, 10.0):
            add("fit", f"{name} weight x{k:g}", times={f"cost.{path}": k})
    # A detector whose 3D leans and that is not believed.
    for k in (0.3, 0.1, 0.03):
        add("fit", f"3D leans 10 deg, 3D weight x{k:g}", lean_deg=10.0, times={"cost.weight_3d": k})
    both = {"slow_px": 3.0, "constant_px": 3.0}
    for k in (0.3, 0.1):
        add("fit", f"pixels err both ways, 2D weight x{k:g}", times={"cost.weight_2d": k}, **both)
    hard = {**both, "lean_deg": 5.0, "noise": noise(along_m=2 * base.along_m)}
    add("detector", "hard: pixels both ways, lean 5 deg, depth noise x2", **hard)
    prior = {"cost.weight_pose": 0.1, "cost.pose_prior_deg": POSE_PRIOR_DEG}
    for name, seen in (("", {}), ("pixels err both ways, ", both), ("hard, ", hard)):
        add("fit", f"{name}pose prior 0.1", values=prior, **seen)
        add("fit", f"{name}pose prior 0.1, 2D x0.3", values=prior, times={"cost.weight_2d": 0.3}, **seen)
    add("fit", "depth counts 0.3", values={"cost.depth_ratio": 0.3})
    add("fit", "pixels only", with_3d=False)
    for n in (3, 10):
        add("fit", f"{n} trials in the session", n_trials=n)
    # Markers and proportions that the fit need not find: what it would gain if it knew them.
    add("fit", "offsets 0 and known", site=0.0, values={"cost.weight_offset_per_m2": 1e6})
    add(
        "fit",
        "offsets 0, proportions 0, both known",
        site=0.0,
        size=0.0,
        values={"cost.weight_offset_per_m2": 1e6, "cost.weight_scale": 1e4},
    )
    for name in ("blazepose_33", "mpi_inf_3dhp_17", "body25b"):
        add("markers", name, marker_set=name, params="blazepose")
    add("markers", "blazepose_33, paramset gauss-newton", marker_set="blazepose_33")
    add("markers", "blazepose_33, sides alike", marker_set="blazepose_33", params="blazepose", sides_alike=True)
    add("markers", "blazepose_33, offsets 0", marker_set="blazepose_33", params="blazepose", site=0.0)
    add("markers", "blazepose_33, leans 10 deg", marker_set="blazepose_33", params="blazepose", lean_deg=10.0)
    for fps in (15.0, 60.0):
        add("frames", f"{fps:g} Hz", fps=fps)
    add("alone", "no noise, offsets and scales 0", noise=NO_NOISE, site=0.0, size=0.0)
    add("alone", "no noise", noise=NO_NOISE)
    for name in ("across_m", "along_m", "constant_m", "xy_px", "outlier_share", "drop_share"):
        add("alone", f"no noise but {name}", noise=dataclasses.replace(NO_NOISE, **{name: getattr(base, name)}))
    return tuple(rows)


def paramset_of(setup: Setup) -> Paramset:
    """The setup's paramset with its parameters changed. Raises `KeyError` where a path names none."""
    given = METHODS[setup.params]
    params: Any = given.params
    for path, factor in setup.times.items():
        params = _replaced(params, path, lambda old, factor=factor: old * factor)
    for path, value in setup.values.items():
        params = _replaced(params, path, lambda _, value=value: value)
    return Paramset.of(given.stage, given.name, given.version, params)


def _replaced(params: Any, path: str, change: Callable[[Any], Any]) -> Any:
    first, _, rest = path.partition(".")
    if first not in {f.name for f in dataclasses.fields(params)}:
        raise KeyError(path)
    old = getattr(params, first)
    return dataclasses.replace(params, **{first: _replaced(old, rest, change) if rest else change(old)})


def session(
    setup: Setup, seed: int, duration_s: float, source: WalkSource = walker
) -> tuple[SessionInput, list[np.ndarray]]:
    """A session of person `seed` and the true qpos (T, 40) of each of its trials."""
    time_s = np.arange(round(duration_s * setup.fps)) / setup.fps
    scale, offset = person(seed, setup.marker_set)
    scale, offset = 1 + setup.size * (scale - 1), setup.site * offset
    if setup.sides_alike:
        scale[LEFT_SCALES] = scale[RIGHT_SCALES]
    trials, truth = [], []
    for trial in range(setup.n_trials):
        qpos = source(time_s, seed, trial)
        seen = observe(
            qpos,
            time_s,
            marker_set=setup.marker_set,
            scale=scale,
            site_offset_m=offset,
            noise=setup.noise,
            seed=1000 * trial + seed,
            camera_motion=setup.motion,
            tilt_deg=setup.tilt_deg,
            with_phone=setup.with_phone,
        )
        trials.append(worsened(setup, seen, np.random.default_rng([seed, trial, 10])))
        truth.append(qpos)
    names = [f"person {seed}, trial {k}" for k in range(setup.n_trials)]
    return SessionInput(trials, names, setup.motion), truth


def worsened(setup: Setup, seen: Seen, rng: np.random.Generator) -> Keypoints:
    """The keypoints with what `observe` does not know: errors of all 3D points together, slow pixels, a wrong lens."""
    points, xyz, xy = seen.keypoints, seen.keypoints.xyz_cam_m, seen.keypoints.xy_px
    # From the camera to the person, in the camera frame; the phone is the world's origin.
    ray = np.einsum("tba,tb->ta", seen.R_nc, seen.markers_world_m.mean(axis=1))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    if setup.squash != 1:
        xyz = squashed(xyz, ray, setup.squash)
    if setup.lean_deg:
        xyz = leant(xyz, ray, setup.lean_deg)
    if not setup.with_3d:
        xyz = np.full_like(xyz, np.nan)
    if setup.constant_px:
        xy = xy + setup.constant_px * rng.standard_normal((1, *xy.shape[1:]))
    if setup.slow_px:
        xy = xy + setup.slow_px * slow(rng, points.time_s, xy.shape)
    confidence = points.confidence
    if setup.doubted_share:
        doubted = rng.random(confidence.shape) < setup.doubted_share
        confidence = np.where(doubted & (confidence > 0), 0.001, confidence)
    camera = points.camera
    if setup.focal != 1:
        matrix = np.array(camera.matrix, np.float64)
        matrix[[0, 1], [0, 1]] *= setup.focal
        camera = dataclasses.replace(camera, matrix=matrix)
    return dataclasses.replace(points, xyz_cam_m=xyz, xy_px=xy, confidence=confidence, camera=camera)


def squashed(xyz_m: np.ndarray, ray: np.ndarray, factor: float) -> np.ndarray:
    """Points (T, J, 3) about their root with their depth along the unit `ray` (T, 3) multiplied."""
    depth = np.einsum("tja,ta->tj", xyz_m, ray)
    return xyz_m + (factor - 1) * depth[..., None] * ray[:, None]


def leant(xyz_m: np.ndarray, ray: np.ndarray, angle_deg: float) -> np.ndarray:
    """Points (T, J, 3) in the camera frame (y down), turned about their root's horizontal so that the top comes near.

    The axis is level in the picture and across the unit `ray` (T, 3). Rodrigues' formula.
    """
    axis = np.cross([0.0, 1.0, 0.0], ray)
    axis = (axis / np.linalg.norm(axis, axis=1, keepdims=True))[:, None]
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    along = np.sum(axis * xyz_m, axis=-1, keepdims=True)
    return cos * xyz_m + sin * np.cross(np.broadcast_to(axis, xyz_m.shape), xyz_m) + (1 - cos) * along * axis


def slow(rng: np.random.Generator, time_s: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Unit normal noise (T, ...) with the memory of the detector's 3D noise (first-order autoregressive)."""
    out = rng.standard_normal(shape)
    for t, step in enumerate(np.diff(time_s), 1):
        rho = NOISE.correlation ** (step / NOISE.correlation_step_s)
        out[t] = rho * out[t - 1] + np.sqrt(1 - rho**2) * out[t]
    return out
