"""`synthesise`: a walker with known joint angles, events, body and camera, and the keypoints of a phone's video."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.bounded import parse_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import check_numbers, check_out_folder, load_npz, text_of, texts_of
from pbl_pipeline.gait.events import GaitEvent, GaitEvents
from pbl_pipeline.gait.normative import gait_norm
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import Camera

from . import tasks
from .camera import CAMERAS, PHONE_CAMERA, PHONE_SIZE_PX, VIEWS_DEG, PhoneSensor, orientation, phone_path, place
from .impair import Impairment, style_of
from .noise import CORRELATED_NOISE, NO_NOISE, Noise
from .observe import film, pelvis_positions
from .physique import leg_length_m, physique
from .plan import Plan
from .reference import reference
from .solve import solve

#: task -> plan of a walker and a time (None: the task's own, or `DEFAULT_SECONDS`).
TASKS: dict[str, Callable[[tasks.Walker, float | None], Plan]] = {
    "walk": lambda w, s: tasks.walk(w, DEFAULT_SECONDS if s is None else s),
    "standing": lambda w, s: tasks.standing(w, DEFAULT_SECONDS if s is None else s),
    "sit_to_stand": lambda w, s: tasks.sit_to_stand(w, 2 * DEFAULT_SECONDS if s is None else s),
    "squat": lambda w, s: tasks.squat(w, 2 * DEFAULT_SECONDS if s is None else s),
    "tug": tasks.timed_up_and_go,
    "four_square": tasks.four_square,
}
DEFAULT_SECONDS = 5.0
NOISES = {"benchmark": Noise(), "memory": CORRELATED_NOISE, "none": NO_NOISE}
GROUNDS = ("overground", "treadmill")
#: Size of a landscape picture, for a phone that stands and sees people from the side.
LANDSCAPE_PX = (1920, 1080)
#: Largest fraction of the points outside the picture.
OUTSIDE_SHARE = 0.2


#: Fields that appear in the name of a trial if they are not the default, so that files of other trials are kept.
_IN_NAME: dict[str, Callable[[Any], str]] = {
    "ground": str,
    "speed_m_per_s": "{:g}mps".format,
    "seconds": "{:g}s".format,
    "fps": "{:g}fps".format,
    "marker_set": str,
    "noise": "noise-{}".format,
    "sensor": lambda sensor: f"sensor-{hashlib.sha256(repr(sensor).encode()).hexdigest()[:6]}",
    "root_relative": lambda _: "absolute",
}
_usage = functools.partial(PblError, "USAGE", next_step="correct it; docs/synth.md lists all")


@dataclasses.dataclass(frozen=True)
class SynthSpec:
    """Options of a trial; equal options have equal results.

    Raises `PblError` USAGE or MARKER_SET_UNKNOWN for impossible values.
    """

    task: str = "walk"  # one of `TASKS`
    seed: int = 0  # of the person, the motion, the camera and the noise
    impairments: tuple[Impairment, ...] = ()
    view: str = "frontal"  # one of `VIEWS_DEG`
    camera: str = "static"  # "static", "panned" (turned after the person) or "handheld" (with a hand's tremor)
    marker_set: str = "bml_movi_87"
    seconds: float | None = None  # None: the duration of the task (walk, standing: 5 s)
    fps: float = 30.0
    speed_m_per_s: float | None = None  # None: the person's
    ground: str = "overground"  # or "treadmill" (walk only: the person stays in place and the belt runs back)
    noise: str = "benchmark"  # or "memory" (the same, but errors in the picture are correlated in time) or "none"
    #: The phone's orientation log; None: no log with a static camera, the default one otherwise.
    sensor: PhoneSensor | None = None
    root_relative: bool = True  # the points' distance is lost, as with most detectors

    def __post_init__(self) -> None:
        for what, value, known in (
            ("task", self.task, TASKS),
            ("view", self.view, VIEWS_DEG),
            ("camera", self.camera, CAMERAS),
            ("ground", self.ground, GROUNDS),
            ("noise", self.noise, NOISES),
        ):
            if value not in known:
                raise _usage(f"{what} {value!r}", f"one of {', '.join(known)}")
        marker_set(self.marker_set)
        if not self.seed >= 0:
            raise _usage(f"seed {self.seed}", "a whole number from 0")
        if not 5 <= self.fps <= 1000:
            raise _usage(f"{self.fps:g} frames a second", "5 to 1000")
        if self.seconds is not None and not 1 <= self.seconds <= 600:
            raise _usage(f"{self.seconds:g} s", "1 to 600 s")
        if self.speed_m_per_s is not None and not 0.3 <= self.speed_m_per_s <= 2.4:
            raise _usage(f"a speed of {self.speed_m_per_s:g} m/s", "0.3 to 2.4 m/s: the norm is of walking")
        if self.ground == "treadmill" and (self.task != "walk" or self.view == "follow"):
            raise _usage("a treadmill with another task than walk, or with a phone that follows", "task walk")
        repeated = {i.name for i in self.impairments if [j.name for j in self.impairments].count(i.name) > 1}
        if repeated:
            raise _usage(f"{', '.join(sorted(repeated))} more than once", "each impairment once")

    @property
    def name(self) -> str:
        """Name of the files: task, impairments, view, camera, other options that are not the default, seed."""
        words = [self.task, *(f"{i.name}{round(100 * i.severity)}" for i in self.impairments), self.view, self.camera]
        fields = {f.name: f.default for f in dataclasses.fields(self)}
        for field, form in _IN_NAME.items():
            value = getattr(self, field)
            if value != fields[field]:
                words.append(form(value))
        return "_".join([*words, f"seed{self.seed}"])


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """Truth of a synthetic trial. World: z up, metres, its origin at the phone in each frame."""

    time_s: Float[np.ndarray, " T"]
    joint_names: tuple[str, ...]
    #: Joint values (m, rad). With a carried phone, the pelvis is relative to the phone of that frame.
    qpos: Float[np.ndarray, "T 40"]
    events: tuple[GaitEvent, ...]  # all initial contacts and toe-offs within the time, with probability 1
    scale: Float[np.ndarray, " 8"]  # of the person
    site_offset_m: Float[np.ndarray, "J 3"]
    R_nc: Float[np.ndarray, "T 3 3"]  # camera to world
    #: Path of the phone from its first position, in the axes of the world: add it to positions relative to the phone
    #: for those in the room. Zeros except in view "follow". It is not observed.
    phone_position_m: Float[np.ndarray, "T 3"]
    pelvis_m: Float[np.ndarray, "T 3"]  # relative to the phone, as `qpos`
    markers_world_m: Float[np.ndarray, "T J 3"]  # likewise
    floor_height_m: Float[np.ndarray, " T"]  # of the floor relative to the phone
    heel_on_floor: Bool[np.ndarray, "T 2"]  # [left, right]
    ball_on_floor: Bool[np.ndarray, "T 2"]
    belt_m_per_s: Float[np.ndarray, " 2"]  # velocity of the floor, zero except on a treadmill: feet in stance have it
    clock_offset_s: float  # of the phone's clock to the video's, NaN without a log
    outlier: np.ndarray  # (T, J) bool
    spec: SynthSpec  # options of the trial

    def save(self, path: str | Path) -> None:
        """Write `truth.npz` (docs/files.md)."""
        arrays: dict[str, Any] = {k: getattr(self, k) for k in _ARRAYS}
        events, spec = self.events, self.spec
        np.savez_compressed(
            path,
            joint_names=np.array(self.joint_names),
            clock_offset_s=np.array(self.clock_offset_s),
            **arrays,
            event_time_s=np.array([e.time_s for e in events]),
            event_side=np.array([e.side for e in events], dtype="<U8"),
            event=np.array([e.event for e in events], dtype="<U9"),
            seed=np.array(spec.seed),
            spec=np.array(json.dumps(dataclasses.asdict(spec))),
        )

    @classmethod
    def load(cls, path: str | Path) -> Truth:
        """Read `truth.npz`. Raises `PblError` FILE_MISSING, FILE_FORMAT."""
        data = load_npz(path, needed=_FIELDS, next_step="make one with `pbl synth`")
        try:
            n, j = data["time_s"].size, data["outlier"].shape[-1]
            check_numbers(
                path,
                data,
                {k: tuple(n if d == "T" else j if d == "J" else int(d) for d in s) for k, s in _ARRAYS.items()},
            )
            joint_names = texts_of(path, data, "joint_names")
            if len(joint_names) != data["qpos"].shape[1]:
                raise ValueError(f"{len(joint_names)} joint_names")
            raw = parse_json(text_of(path, data, "spec"))
            raw["impairments"] = tuple(Impairment(**i) for i in raw["impairments"])
            raw["sensor"] = None if raw["sensor"] is None else PhoneSensor(**raw["sensor"])
            rows = zip(data["event_time_s"], data["event_side"], data["event"], strict=True)
            return cls(
                events=tuple(GaitEvent(float(t), str(s), str(e), 1.0) for t, s, e in rows),
                spec=SynthSpec(**raw),
                joint_names=joint_names,
                clock_offset_s=float(data["clock_offset_s"]),
                **{k: data[k] for k in _ARRAYS},
            )
        except (KeyError, ValueError, TypeError, IndexError, PblError) as error:
            raise PblError(
                "FILE_FORMAT",
                found=error.found if isinstance(error, PblError) else f"{type(error).__name__}: {error}",
                expected="a truth.npz as docs/files.md describes it",
                next_step="make one with `pbl synth`",
                key=str(path),
            ) from error


_ARRAYS: dict[str, tuple[int | str, ...]] = {
    "time_s": ("T",),
    "qpos": ("T", 40),
    "scale": (8,),
    "site_offset_m": ("J", 3),
    "R_nc": ("T", 3, 3),
    "phone_position_m": ("T", 3),
    "pelvis_m": ("T", 3),
    "markers_world_m": ("T", "J", 3),
    "floor_height_m": ("T",),
    "heel_on_floor": ("T", 2),
    "ball_on_floor": ("T", 2),
    "belt_m_per_s": (2,),
    "outlier": ("T", "J"),
}
_FIELDS = (*_ARRAYS, "event_time_s", "event_side", "event", "spec", "joint_names", "clock_offset_s")


@dataclasses.dataclass(frozen=True, eq=False)
class Synthetic:
    """A synthetic trial: the keypoints of its phone video, and the truth."""

    keypoints: Keypoints
    truth: Truth

    def save(self, folder: str | Path, name: str | None = None) -> tuple[Path, ...]:
        """Write `<name>.keypoints.npz`, `<name>.truth.npz` and `<name>.events.csv`, and return their paths.

        Raises `PblError` FILE_UNWRITABLE.
        """
        folder, name = Path(folder), name or self.truth.spec.name
        check_out_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = tuple(folder / f"{name}.{end}" for end in ("keypoints.npz", "truth.npz", "events.csv"))
        self.keypoints.save(paths[0])
        self.truth.save(paths[1])
        GaitEvents("PASS", self.truth.events, "", "truth", "", "synthetic").save(paths[2])
        return paths


def synthesise(spec: SynthSpec) -> Synthetic:
    """Make the trial of these options.

    Normal curves by speed (Schwartz et al. 2008) and impairments determine the target angles; footprints and the path
    of the pelvis are planned; the least-squares solution keeps the standing feet in place.

    Raises `PblError` USAGE: more seconds than the task lasts, or a walk that leaves the picture of a static camera.
    """
    markers = marker_set(spec.marker_set)
    style = style_of(spec.impairments)
    scale, site_offset = physique(spec.seed, markers)
    leg = leg_length_m(scale)
    walker = tasks.Walker(leg, HEEL_AHEAD_M * float(scale[0]), spec.seed, style, spec.speed_m_per_s)
    plan = TASKS[spec.task](walker, spec.seconds)
    seconds = spec.seconds if spec.seconds is not None else tasks.duration_s(plan)
    treadmill = spec.ground == "treadmill"
    time_s = np.arange(int(np.floor(seconds * spec.fps + 1e-9))) / spec.fps
    scene = place(plan, spec.view, spec.seed, stays=treadmill)
    aim, sway = reference(scene.plan, style, spec.seed, leg, walker.foot_off(), walker.base()[1])
    on_grid = solve(scene.plan, aim, sway, scale)

    body = load_body()
    column = [body.joint_names.index(f"pelvis_t{axis}") for axis in "xzy"]
    phone = phone_path(scene, pelvis_positions(on_grid), spec.seed)
    belt = np.zeros(2)
    if treadmill:
        heading = float(scene.plan.heading_rad[0])
        belt = -walker.speed() * np.array([np.cos(heading), np.sin(heading)])
        on_grid[:, column[0]] += belt[0] * (scene.plan.grid_s - 0.5 * seconds)
        on_grid[:, column[1]] -= belt[1] * (scene.plan.grid_s - 0.5 * seconds)
    # From the room to the phone: x, right (-y), up.
    on_grid[:, column] -= np.column_stack([phone[:, 0], -phone[:, 1], phone[:, 2] + scene.height_m])
    qpos = CubicSpline(scene.plan.grid_s, on_grid)(time_s)
    phone_m = CubicSpline(scene.plan.grid_s, phone)(time_s)
    pelvis = pelvis_positions(qpos)

    camera, size_px = lens(spec.view, spec.camera)
    sensor = spec.sensor or (PhoneSensor() if spec.camera != "static" else None)
    seen = film(
        qpos,
        time_s,
        orientation(spec.camera, scene.carried, time_s, pelvis, spec.seed),
        markers=markers,
        scale=scale,
        site_offset_m=site_offset,
        noise=NOISES[spec.noise],
        rng=np.random.default_rng([spec.seed, 4]),
        camera=camera,
        image_size_px=size_px,
        sensor=sensor,
        sensor_rng=np.random.default_rng([spec.seed, 23]),
        root_relative=spec.root_relative,
        only_in_picture=True,
    )
    _check_in_view(seen.outside, spec)
    truth = Truth(
        time_s=time_s,
        joint_names=body.joint_names,
        qpos=qpos,
        events=_events(scene.plan, float(time_s[-1])),
        scale=scale,
        site_offset_m=site_offset,
        R_nc=seen.R_nc,
        phone_position_m=phone_m,
        pelvis_m=pelvis,
        markers_world_m=seen.markers_world_m,
        floor_height_m=-scene.height_m - phone_m[:, 2],
        heel_on_floor=_on_floor(scene.plan, time_s, "heel_s"),
        ball_on_floor=_on_floor(scene.plan, time_s, "ball_s"),
        belt_m_per_s=belt,
        clock_offset_s=seen.clock_offset_s,
        outlier=seen.outlier,
        spec=spec,
    )
    return Synthetic(seen.keypoints, truth)


#: From the pelvis' origin to the origin of the calcaneus, standing upright (m, unscaled).
HEEL_AHEAD_M = -0.128


def lens(view: str, camera: str) -> tuple[Camera, tuple[int, int]]:
    """An upright picture, or one on its side where a standing phone sees a person go by."""
    if camera != "static" or view not in ("sagittal", "sagittal_right", "oblique"):
        return PHONE_CAMERA, PHONE_SIZE_PX
    matrix = PHONE_CAMERA.matrix.copy()
    matrix[:2, 2] = (LANDSCAPE_PX[0] - 1) / 2, (LANDSCAPE_PX[1] - 1) / 2
    return Camera(matrix, PHONE_CAMERA.distortion, PHONE_CAMERA.source), LANDSCAPE_PX


def _check_in_view(outside: np.ndarray, spec: SynthSpec) -> None:
    if outside.mean() <= OUTSIDE_SHARE:
        return
    raise _usage(
        f"{100 * outside.mean():.0f} % of the points outside of the picture",
        f"at most {100 * OUTSIDE_SHARE:.0f} %: the person stays in front of the {spec.camera} camera",
        next_step="take fewer --seconds, --camera panned or handheld, --view follow, or --ground treadmill",
    )


def _on_floor(plan: Plan, time_s: np.ndarray, part: str) -> np.ndarray:
    out = np.zeros((len(time_s), 2), bool)
    for step in plan.steps:
        start, stop = getattr(step, part)
        out[:, "lr".index(step.side)] |= (time_s >= start) & (time_s <= stop)
    return out


def _events(plan: Plan, until_s: float) -> tuple[GaitEvent, ...]:
    out = []
    for step in plan.steps:
        side = "right" if step.side == "r" else "left"
        for kind, at in (("foot_down", step.down_s), ("foot_up", step.up_s)):
            if 0 <= at <= until_s:
                out.append(GaitEvent(at, side, kind, 1.0))
    return tuple(sorted(out, key=lambda e: e.time_s))


def speed_of_group(group: str, seed: int = 0) -> float:
    """Walking speed (m/s) of one of the norm's five groups for the person of a seed. Raises `PblError` USAGE."""
    norm = gait_norm()
    if group not in norm.groups:
        raise _usage(f"speed {group!r}", f"m/s, or one of {', '.join(norm.groups)}")
    scale, _ = physique(seed, marker_set("bml_movi_87"))
    return float(norm.speed[norm.groups.index(group)] * np.sqrt(9.81 * leg_length_m(scale)))
