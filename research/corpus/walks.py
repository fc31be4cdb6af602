"""A corpus of walks whose joint angles are known, as a phone's detector would see them.

Synthetic people, healthy and with each impairment, and recorded walks of other laboratories on our body. Half of the
persons are held out by a rule that never changes: parameters may be chosen on the others only.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from pbl_pipeline.body import load_body
from pbl_pipeline.body import marker_set as load_markers
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import detect_events, feet_from_fit
from pbl_pipeline.gait.events import GaitEvent
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.progress import track
from pbl_pipeline.synthetic import IMPAIRMENTS, NO_NOISE, Impairment, Noise, SynthSpec, lens, physique, synthesise
from research.corpus.motions import Motion, read_motions
from research.corpus.true_fit import fit_of_qpos
from research.walker.detectors import DETECTORS, DetectorModel
from research.walker.observe import observe, resized, zoomed
from research.walker.turns import turned

#: A trial of the corpus (s, frames a second).
SECONDS, RATE_HZ = 6.0, 30.0
VIEWS = ("frontal", "rear", "sagittal", "sagittal_right", "oblique")
#: Further views of passes: from a direction that is drawn for each recording; from the left on the way there and from
#: the right on the way back, of a walk that turns round (`there_and_back`).
ANYWHERE, THERE_AND_BACK = "anywhere", "there_and_back"
#: Length (s) of a walk that turns round, when it begins to turn, and how long the turn lasts.
LONG_SECONDS, TURN_FROM_S, TURN_S = 15.0, 8.0, 1.5
CAMERAS = ("static", "handheld")
HEALTHY = "healthy"
#: Severities of an impairment at two visits.
SEVERITIES = (0.3, 0.8)
#: How long a walking stride can be (s).
_STRIDES_S = (0.8, 1.8)
#: A recorded walk that turns by more has no view (deg).
_STRAIGHT_DEG = 45.0
#: Shorter sides of the pictures (px), and how much of a picture's height a person takes where she is largest: one of
#: each is drawn for every case.
PICTURES_PX, BODY_SHARE = (480, 720, 1080, 2160), (0.2, 0.9)
#: Half of what a standing phone sees beside its line of sight, as a fraction of the distance, with a margin (m).
_HALF_WIDTH, _MARGIN_M = 0.62, 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Walk:
    """A walk that is known: `time_s` (T,), `qpos` (T, 40), `scale` (8,) of the person, `events`.

    `source` is "synthetic" or "recorded"; `condition` "healthy", an impairment's name, or "recorded".
    """

    person: str
    source: str
    condition: str
    severity: float
    time_s: Float[np.ndarray, " T"]
    qpos: Float[np.ndarray, "T 40"]
    scale: Float[np.ndarray, " 8"]
    events: tuple[GaitEvent, ...]

    @property
    def held_out(self) -> bool:
        """True if this person may not influence any choice."""
        return is_held_out(self.person)

    def fit(self) -> TrialFit:
        """The truth in the form of a fit."""
        return fit_of_qpos(self.person, self.time_s, self.qpos, self.scale)


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A walk as one phone with one detector sees it: from one view, or, with "+" between them (`joined`), from several,
    each a trial of one session."""

    walk: Walk
    view: str
    camera: str
    detector: str
    #: Which recording of the walk: the picture's size belongs to a visit, the detector's errors to a recording.
    visit: int = 0
    recording: int = 0

    @property
    def name(self) -> str:
        """Name of the case in a corpus."""
        w = self.walk
        return f"{w.person}|{w.condition}|{w.severity:g}|{self.view}|{self.camera}|{self.detector}" + (
            f"|visit {self.visit}" if self.visit else ""
        )

    def trials(self) -> dict[str, Keypoints]:
        """Return the detector's output in each view."""
        return {v: dataclasses.replace(self, view=v).keypoints() for v in self.view.split("+")}

    def keypoints(self, noise: Noise | None = None) -> Keypoints:
        """Return the detector's output in the only view of a case, by its error model of `DETECTORS` or another noise.

        The same at each call. Cases of one visit and recording have the same random errors for person, view, camera and
        detector, so that they differ by the walk alone; those of another are drawn anew, but for where the points lie
        on this person's body.
        """
        model = detector_model(self.detector)
        drawn = f"|{self.visit}|{self.recording}" if self.visit or self.recording else ""
        seed = _number(f"{self.walk.person}|{self.view}|{self.camera}|{self.detector}{drawn}")
        view: str | float = "sagittal" if self.view == THERE_AND_BACK else self.view
        passing, lens_view = float("sagittal" in view), view
        if view == ANYWHERE:
            view, lens_view = float(np.random.default_rng([seed, 41]).uniform(-180.0, 180.0)), "oblique"
            passing = abs(np.sin(np.radians(view)))
        reach = np.ptp(self.walk.qpos[:, _columns("pelvis_tx", "pelvis_tz")], axis=0)
        aside = passing * float(np.hypot(*reach)) if self.camera == "static" else 0.0
        look = functools.partial(
            observe,
            self.walk.qpos,
            self.walk.time_s,
            view=view,
            distance_m=max(4.5, (0.5 * aside + _MARGIN_M) / _HALF_WIDTH),
            marker_set=model.marker_set,
            root_relative=model.root_relative,
            scale=self.walk.scale,
            site_offset_m=physique(_number(self.walk.person), load_markers(model.marker_set))[1],
            seed=seed,
            camera_motion=self.camera,
        )
        camera, size = lens(lens_view, self.camera)
        rng = np.random.default_rng([_number(self.name), 31])
        short_px, share = int(rng.choice(PICTURES_PX)), rng.uniform(*BODY_SHARE)
        truth = look(noise=NO_NOISE, camera=camera, image_size_px=size).keypoints.xy_px
        camera, size = resized(zoomed(camera, _zoom(truth, size, share)), size, short_px)
        return look(noise=noise or model.noise, camera=camera, image_size_px=size, only_in_picture=True).keypoints


def _zoom(xy_px: Float[np.ndarray, "T J 2"], size_px: tuple[int, int], share: float) -> float:
    """Return the factor of a focal length that shows the person as so large a share of the picture's height where she
    is largest; at most such that no point leaves the picture that was in it."""
    height = np.ptp(xy_px[..., 1], axis=1).max() / size_px[1]
    from_middle = np.abs(xy_px - (np.array(size_px) - 1) / 2) / (np.array(size_px) / 2)
    return float(min(share / height, max(1.0, 1.0 / from_middle.max())))


def is_held_out(person: str) -> bool:
    """The rule by which persons are held out: an odd last digit of the SHA-256 of the name."""
    return int(hashlib.sha256(person.encode()).hexdigest()[-1], 16) % 2 == 1


def joined(views: Iterable[str]) -> str:
    """The views of one session as a case names them. Raises `PblError` USAGE for an unknown one."""
    names = list(dict.fromkeys(views))
    if unknown := [v for v in names if v not in VIEWS]:
        raise PblError("USAGE", found=f"view {unknown[0]!r}", expected=f"of {', '.join(VIEWS)}", next_step="name these")
    return "+".join(names)


def detector_model(name: str) -> DetectorModel:
    """The error model of a detector. Raises `PblError` USAGE for an unknown name."""
    if name not in DETECTORS:
        raise PblError(
            "USAGE", found=f"detector {name!r}", expected=f"one of {', '.join(DETECTORS)}", next_step="name one"
        )
    return DETECTORS[name]


def corpus(
    detector: str = "blazepose-heavy",
    motions: str | Path | None = None,
    *,
    quick: bool = False,
    seconds: float = SECONDS,
    together: Sequence[str] = (),
) -> list[Case]:
    """The cases: synthetic people, and the recorded walks of the folder `motions` (`read_motions`) where one is given.

    Each synthetic person is seen healthy in every view, and with each impairment at two severities: in every view, or
    `quick`, in one view that changes with the impairment. Eight people, four of them held out, or `quick` two,
    one held out. Recorded walks are seen in every view by both cameras, or `quick` in two views. `together`: views that
    make one session, instead of a session for each view.

    Raises
    ------
    PblError
        USAGE for an unknown detector or view; what `read_motions` raises.
    """
    detector_model(detector)
    seen = [joined(together)] if together else VIEWS
    cases: list[Case] = []
    seeds = synthetic_seeds(1 if quick else 4)
    for p, seed in enumerate(track(seeds, "walkers", unit="person")):
        healthy = synthetic_walk(seed, seconds=seconds)
        for v, view in enumerate(seen):
            cameras = [CAMERAS[(p + v) % 2]] if quick else CAMERAS
            cases += [Case(healthy, view, camera, detector) for camera in cameras]
        for i, name in enumerate(IMPAIRMENTS):
            views = [(p + i) % len(seen)] if quick else range(len(seen))
            for severity in SEVERITIES:
                walk = synthetic_walk(seed, name, severity, seconds)
                cases += [Case(walk, seen[v], CAMERAS[(p + v) % 2], detector) for v in views]
    for p, walk in enumerate(recorded_walks(motions, seconds) if motions is not None else ()):
        for v, view in enumerate(seen):
            if quick and v not in (p % len(seen), (p + 2) % len(seen)):
                continue
            cameras = [CAMERAS[(p + v) % 2]] if quick else CAMERAS
            cases += [Case(walk, view, camera, detector) for camera in cameras]
    return cases


def synthetic_seeds(each: int) -> list[int]:
    """The first seeds of `each` people who are held out and of as many who are not, alternating."""
    by_kind: dict[bool, list[int]] = {False: [], True: []}
    seed = 0
    while min(map(len, by_kind.values())) < each:
        by_kind[is_held_out(f"synthetic {seed}")].append(seed)
        seed += 1
    return [s for pair in zip(*(by_kind[k][:each] for k in (False, True)), strict=True) for s in pair]


@functools.lru_cache(maxsize=512)
def synthetic_walk(seed: int, impairment: str = "", severity: float = 0.0, seconds: float = SECONDS) -> Walk:
    """The walk of a seed's person, healthy or with an impairment."""
    impairments = (Impairment(impairment, severity),) if impairment else ()
    spec = SynthSpec(
        seed=seed,
        impairments=impairments,
        camera="panned",
        marker_set="mpi_inf_3dhp_17",
        noise="none",
        seconds=seconds,
        fps=RATE_HZ,
    )
    truth = synthesise(spec).truth
    return Walk(
        person=f"synthetic {seed}",
        source="synthetic",
        condition=impairment or HEALTHY,
        severity=severity,
        time_s=truth.time_s,
        qpos=truth.qpos,
        scale=truth.scale,
        events=truth.events,
    )


def recorded_walks(motions: str | Path | Iterable[Motion], seconds: float = SECONDS) -> list[Walk]:
    """A walk of each person who was recorded walking straight: as long as asked for, a short one repeated by strides.

    Events are those that are detected on the true motion. A person without a cycle of each side is left out.
    """
    read = read_motions(motions, ["walk"]) if isinstance(motions, str | Path) else motions
    by_person: dict[str, list[Motion]] = {}
    for motion in read:
        by_person.setdefault(motion.person, []).append(motion)
    walks = []
    for person, recorded in by_person.items():
        for motion in sorted(recorded, key=lambda m: -m.time_s[-1]):
            walk = _recorded_walk(person, motion, seconds)
            if walk is not None:
                walks.append(walk)
                break
    return walks


def there_and_back(walk: Walk) -> Walk:
    """A walk of `LONG_SECONDS` that turns round on the way: the same joint angles and events on another path."""
    after = np.clip((walk.time_s - TURN_FROM_S) / TURN_S, 0.0, 1.0)
    heading = np.pi * after**2 * (3.0 - 2.0 * after)
    qpos, place = turned(walk.qpos, heading), _columns("pelvis_tx", "pelvis_tz")
    ahead, aside = np.diff(walk.qpos[:, place], axis=0).T
    c, s = np.cos(heading[1:]), np.sin(heading[1:])
    qpos[1:, place] = np.cumsum(np.stack([c * ahead + s * aside, -s * ahead + c * aside], axis=1), axis=0)
    qpos[0, place] = 0.0
    return dataclasses.replace(walk, qpos=qpos)


def _recorded_walk(person: str, motion: Motion, seconds: float) -> Walk | None:
    time = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    try:
        qpos = lasting(motion, time)
        if qpos is None:
            return None
        fit = fit_of_qpos(person, time, qpos)
        events = detect_events(feet_from_fit(fit)).events
    except PblError:
        return None
    if len(events) < 8:
        return None
    return Walk(person, "recorded", "recorded", 0.0, time, qpos, np.ones(8), events)


def lasting(motion: Motion, time_s: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 40"] | None:
    """A walk at other times from 0 on: its straightest part where it is long enough, else one stride again and again.

    None where no part is straight.
    """
    place = _columns("pelvis_tx", "pelvis_tz")
    end = float(motion.time_s[-1])
    if motion.cycle:
        stride = end + float(np.median(np.diff(motion.time_s)))
        whole = CubicSpline(np.append(motion.time_s, stride), _closed(motion.qpos, place))
        return _repeated(whole, 0.0, stride, time_s, place)
    spline = CubicSpline(motion.time_s, motion.qpos)
    if end < time_s[-1]:
        return _repeated(spline, *_stride(spline, end), time_s, place)
    starts = np.arange(0, motion.time_s[-1] - time_s[-1] + 1e-9, 0.5)
    turn = _columns("pelvis_rotation")[0]
    straight = [float(np.ptp(spline(s + time_s)[:, turn])) for s in starts]
    best = int(np.argmin(straight))
    return spline(starts[best] + time_s) if np.degrees(straight[best]) < _STRAIGHT_DEG else None


def _repeated(
    spline: CubicSpline, start_s: float, stride_s: float, time_s: np.ndarray, place: Sequence[int]
) -> Float[np.ndarray, "N 40"]:
    """One stride again and again, each as far ahead as the one before went."""
    grid = np.linspace(0, stride_s, 101)
    one = spline(start_s + grid)
    gone = one[-1] - one[0]
    one = one - np.linspace(0, 1, 101)[:, None] * gone
    periodic = CubicSpline(grid, np.concatenate([one[:-1], one[:1]]), bc_type="periodic")
    out = periodic(time_s % stride_s)
    out[:, place] += (time_s / stride_s)[:, None] * gone[place]
    return out


def _stride(spline: CubicSpline, end_s: float) -> tuple[float, float]:
    """Begin (s) and length (s) of the stride whose end is most like its beginning, in all joints that turn."""
    turns = load_body().is_hinge & ~np.isin(load_body().joint_names, ["pelvis_rotation"])
    best: tuple[float, float, float] | None = None
    for length in np.arange(_STRIDES_S[0], min(_STRIDES_S[1], end_s), 0.01):
        starts = np.arange(0, end_s - length + 1e-9, 0.02)
        apart = np.linalg.norm((spline(starts + length) - spline(starts))[:, turns], axis=1)
        i = int(np.argmin(apart))
        if best is None or apart[i] < best[0]:
            best = (float(apart[i]), float(starts[i]), float(length))
    if best is None:
        raise PblError(
            "REFERENCE_INPUT", found=f"{end_s:.2f} s of walking", expected="a stride", next_step="leave it out"
        )
    return best[1:]


def _closed(qpos: np.ndarray, place: Sequence[int]) -> np.ndarray:
    """A cycle with its first moment at its end, as far ahead as it went."""
    end = qpos[0].copy()
    end[place] = qpos[-1, place] + (qpos[-1, place] - qpos[0, place]) / (len(qpos) - 1)
    return np.vstack([qpos, end])


def _columns(*names: str) -> list[int]:
    return [load_body().joint_names.index(n) for n in names]


def _number(text: str) -> int:
    """A seed of a text, the same on every machine."""
    return int(hashlib.sha256(text.encode()).hexdigest()[:8], 16)
