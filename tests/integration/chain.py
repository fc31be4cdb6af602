"""Stand-ins for the slow stages, so that the tables are tested with a whole chain in seconds.

The probe, the choice of the subject, events, cycles, measures and index are the library's own. Detection, keypoints
and the fit give a synthetic walker; the real ones run in tests/end_to_end.
"""

import dataclasses
import functools
import importlib
import json
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import pbl_pipeline.pipeline  # noqa: F401 - binds the real functions now, not the stand-ins at its first import later
from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import SessionFit, TrialFit, session_fit
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.kinetics import compute
from pbl_pipeline.qc import Check
from pbl_pipeline.results import DepthFit
from pbl_pipeline.synthetic import plain_walk
from pbl_pipeline.tracking import PersonTrack, Tracking
from pbl_pipeline.video import VideoInfo, check_lens, probe, read_frames
from tests.exported import with_markers
from tests.remembered import remembered
from tests.videos import constant_rate, numbered_frames, write_video
from tests.walker import observe
from tests.walking_fit import walking_fit

N_FRAMES = 240
_FILES = "pbl_pipeline.pipeline"
#: The stages that a test may replace, by name, and where the library looks for them, over tables and on files.
STAGES = {
    "probe": ("pbl_pipeline.video",),
    "track_people": ("pbl_pipeline.tracking", _FILES),
    "detect_keypoints": ("pbl_pipeline.keypoints", _FILES),
    "check_trial": (_FILES,),
    "fit_session": ("pbl_pipeline.fit", _FILES),
    "fit_sessions": ("pbl_pipeline.fit",),
    "detect_events": ("pbl_pipeline.gait",),
    "accepted_cadence": ("pbl_schemas.gait",),
    "find_heads": ("pbl_pipeline.deidentify.video_copy",),
    "deidentify": ("pbl_pipeline.deidentify.video_copy",),
    "Framing": ("pbl_pipeline.keypoints.framing",),
    "render_overlay": (_FILES,),
    "overlay_frames": (_FILES,),
    "report_indices": (_FILES,),
    "write_report": (_FILES,),
    "_pictures": (_FILES,),
    "run_visit": (_FILES,),
    "check_keypoints": ("pbl_pipeline.visit.types",),
    "placed_poses": ("pbl_pipeline.fit.per_frame",),
    "fetch": ("pbl_pipeline.assets",),
    "share_of_memory": ("pbl_pipeline.video.kept",),
}
#: For `stand_in`: results on files without overlay and pictures.
NO_PICTURES: dict[str, Callable[..., Any]] = {"render_overlay": lambda *_, **__: None, "_pictures": lambda *_: ()}


def small_video(folder: Path, name: str, n: int = N_FRAMES, people: str = "walker and bystander") -> Path:
    """A real video of coloured frames; the stand-in detector reads who is in it from the file's name."""
    suffix = {"walker and bystander": "", "two alike": "_alike", "nobody": "_nobody"}[people]
    path = folder / f"{name}{suffix}.mp4"
    path.write_bytes(_film(zlib.crc32(name.encode()) % 127, n))  # other bytes for other names
    return path


@functools.cache
def _film(shift: int, n: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        frames = (np.roll(f, shift, axis=1) for f in numbered_frames(n, 72, 128))
        return write_video(Path(folder) / "film.mp4", frames, constant_rate(n)).read_bytes()


def camera_file(folder: Path, **more: float) -> Path:
    """A calibrated lens for small videos, with these fields beside; `k1` of its distortion."""
    content = {"camera_matrix": [[900, 0, 64], [0, 900, 36], [0, 0, 1]], "image_size_px": [128, 72]}
    path = folder / "camera.json"
    path.write_text(json.dumps({**content, "distortion": [more.pop("k1", 0), 0, 0, 0, 0], **more}))
    return path


def track_people(video_path: Path, params: object = None, info: VideoInfo | None = None) -> Tracking:
    """Two people: one walks across the picture, one stands at its edge (or both walk alike, or nobody is there)."""
    info = info or probe(video_path)
    time, size = info.time_s, (1920, 1080)
    stem = Path(video_path).stem
    walks = _person(1, 300 + 1200 * time / time[-1], 500.0)
    stands = _person(2, np.full_like(time, 1800.0), 250.0)
    alike = _person(2, 320 + 1200 * time / time[-1], 500.0)
    people = () if stem.endswith("_nobody") else (walks, alike if stem.endswith("_alike") else stands)
    return Tracking(time, size, people, "stand-in", "0" * 64)


def _person(number: int, x: np.ndarray, height: float) -> PersonTrack:
    box = np.stack([x - height / 5, np.full_like(x, 300.0), x + height / 5, np.full_like(x, 300.0 + height)], axis=1)
    roi = np.full((len(x), 4), np.nan)
    return PersonTrack(number, box, roi, np.full(len(x), 0.9), np.ones(len(x), bool))


def detect_keypoints(video_path, tracking, person_id, camera, params=None) -> Keypoints:
    """The synthetic walker, seen without noise; person 2 is another height in the picture."""
    time = tracking.time_s
    found = observe(plain_walk(time, start_m=(7.0 if person_id == 1 else 9.0, -3.0)), time)
    # The small video's lens, at the same place of the walker's picture.
    (first,), matrix = read_frames(video_path, stop=1), camera.matrix.copy()
    matrix[:2, 2] *= np.array(found.image_size_px) / first.image.shape[1::-1]
    camera = dataclasses.replace(camera, matrix=matrix)
    try:
        check_lens(camera.matrix, camera.distortion, found.image_size_px)
    except PblError:  # the lens of a small video: over the walker's picture its distortion cannot be
        camera = dataclasses.replace(camera, distortion=np.zeros(5))
    return dataclasses.replace(found, camera=camera)


def depth_pictures(folder: Path, metres: float = 3.0, n: int = N_FRAMES) -> Path:
    """16-bit pictures in mm of a wall, one for each frame of a small video."""
    folder.mkdir()
    for i in range(n):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((18, 32), 1000 * metres, np.uint16))
    return folder


def fit_session(trials, names, paramset=None, camera_motion="static", height_m=None, depths=()) -> SessionFit:
    """The movement that was put in; as many time stamps as the keypoints have. Depths make the body larger."""
    body, metre = load_body(), np.nanmedian([np.nanmedian(d.m) for d in depths if d] or [1.0])
    found = [d and DepthFit(d.name, d.sha256, 0.6, 0.95, 1.1, 0.93, float(metre)) for d in depths] or [None] * len(
        names
    )
    fits = tuple(
        dataclasses.replace(
            walking_fit(body.joint_names, body.sha256, name=name, n_frames=len(k.time_s)),
            height_m=height_m or np.nan,
            with_depths=bool(depths),
            depth=depth,
        )
        for name, k, depth in zip(names, trials, found, strict=True)
    )
    return SessionFit(
        trials=fits,
        scale=np.full(8, metre),
        site_offset_m=np.zeros((1, 3)),
        loss_trace=np.array([[0.0, 20.0], [7.0, 2.0]]),
        iterations=7,
        converged=True,
        result="small_step",
        solver="gauss-newton",
        params_hash=paramset.hash if paramset is not None else "",
        seconds=0.1,
        compile_seconds=0.0,
        device="cpu",
        qc=(Check("residual_3d_cm", "WARN", 7.0, 6.0, "look at the overlay"), Check("scale", "PASS", None, None)),
    )


def fit_upright(trials, names, paramset=None, camera_motion="static", height_m=None) -> SessionFit:
    """As `fit_session`, with a vertical that is known and with errors: what forces need. In the precision in which the
    tables store movements, because accelerations would turn that rounding into other forces."""
    session = fit_session(trials, names, paramset, camera_motion, height_m)

    def upright(fit):
        qpos, sd = np.float32(fit.qpos), np.full(fit.qpos.shape, 0.005, np.float32)
        return dataclasses.replace(fit, orientation_source="measured: phone", qpos=qpos, qpos_sd=sd)

    return dataclasses.replace(session, trials=tuple(map(upright, session.trials)))


def with_all_markers(session: SessionFit) -> SessionFit:
    """The fit with the markers of its set, which exports need, and the parameters it was given."""
    points, seen = marker_set("blazepose_33"), {"residual_2d_px": 4.0, "residual_3d_m": 0.03}
    offset = np.zeros((len(points), 3))
    places = {"marker_set": points.name, "marker_names": points.names, "site_offset_m": offset}
    places |= {"params_hash": session.params_hash, "solver": session.solver}

    def marked(fit: TrialFit) -> TrialFit:
        residuals = {k: np.full((len(fit.time_s), len(points)), v) for k, v in seen.items()}
        return with_markers(dataclasses.replace(fit, **places, **residuals))

    return dataclasses.replace(session, trials=tuple(map(marked, session.trials)), site_offset_m=offset)


def fit_either(trials, names, paramset=None, camera_motion="static", markers=None) -> SessionFit:
    """Markers and trials of several cameras are fitted by the library, videos of one by the stand-in."""
    if isinstance(trials[0], Keypoints):
        return fit_session(trials, names, paramset, camera_motion)
    return session_fit.fit_session(trials, names, paramset, camera_motion, markers)


#: The library's own, once for each walk: the walker of the stand-ins is the same in most tests.
trial_kinetics = remembered(compute.trial_kinetics)


def install(patch: pytest.MonkeyPatch) -> None:
    """Use the stand-ins instead of the library's functions, over tables and on files."""
    patch.setattr(compute, "trial_kinetics", trial_kinetics)
    replace(patch, track_people=track_people, detect_keypoints=detect_keypoints, fit_session=fit_session)


def replace(patch: Any, **functions: Any) -> None:
    """Put these functions instead of the stages of their names."""
    for name, function in functions.items():
        for module in STAGES[name]:
            patch.setattr(importlib.import_module(module), name, function)


def change_fits(patch: pytest.MonkeyPatch, change: Callable[[SessionFit], SessionFit]) -> None:
    """Let the library fit what `change` makes of the fits of the stand-in."""
    replace(patch, fit_session=lambda *given, **named: change(fit_session(*given, **named)))


def computed_once(build: Callable[[Path], Any]) -> Any:
    """A fixture of this name: empty tables, filled by `build(folder)` as `fill` does it."""

    @pytest.fixture(name=build.__name__)
    def filled(tables: None, fill: Callable[[Callable[[Path], Any]], Any]) -> Any:
        return fill(build)

    return filled
