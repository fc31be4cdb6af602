"""Effect of the size of the picture: units of the detector's error, and results at several sizes.

    python -m research.benchmarks.picture_size unit         # the detector's error against what may be its unit
    python -m research.benchmarks.picture_size scaled       # keypoints, camera and picture multiplied: a change of unit
    python -m research.benchmarks.picture_size encoded      # the recordings encoded at other sizes, and detected there
    python -m research.benchmarks.picture_size encoded --set cost.pixel="'file'" --set cost.metre="'detector'" \\
      --set cost.weight_2d=0.2 --set cost.huber_2d_px=5.0 --set cost.weight_3d=0.5  # as `blazepose` version 6

Reads `../shared/data/real/{video_mocap,multiview}` (README there: sources and licences) and the demo recording. A
recording is resized (averaged where smaller, cubic where larger), encoded as H.264 and detected anew; its keypoints are
kept in `--keypoints`. The truth at another size is that of the recording as it is, multiplied.

`unit`: errors of the points against the truth, their part that does not change and the rest, divided by each candidate
for their unit. "spread" is the standard deviation of the logarithm of a recording's median quotient over recordings and
sizes: a unit that explained everything would have 0.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import cv2
import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.fit import METHODS, TrialFit, fit_session
from pbl_pipeline.fit.initial_pose import root_positions
from pbl_pipeline.fit.units import box_side_px, crop_px
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.keypoints import METHODS as KEYPOINT_METHODS
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.methods import Method
from pbl_pipeline.video import load_camera, read_frames
from research.benchmarks.real_clips import CLIPS, changed, fitted_angles, recorded_angles, score
from research.clip_keypoints import clip_keypoints
from research.confidence import recordings, truth_of
from research.paths import SHARED
from tests.videos import write_video

#: Shorter sides (px) at which recordings are encoded; 0: as it is.
SIZES = (0, 480, 720, 1080, 2160)
#: Sizes at which a person is looked at enlarged.
SMALL = (180, 240, 360)
FACTORS = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
DEMO, CALIBRATED = "demo", "demo, calibrated"
#: Bars: angles (deg), index and intervals (relative) of a mere change of unit; spread over encoded sizes.
SCALED_DEG, SCALED_INDEX, SCALED_SD, ENCODED_DEG, ENCODED_INDEX = 0.05, 0.3, 0.01, 0.15, 1.5

keypoints_option = click.option(
    "--keypoints",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path(tempfile.gettempdir()) / "pbl_picture_size",
    show_default=True,
    help="Folder of keypoints: taken from there, or detected and kept there.",
)


def videos() -> dict[str, Path]:
    """Name and file of every recording."""
    return {**recordings(SHARED), DEMO: Path(assets.fetch("demo_video"))}


def keypoints_at(name: str, short_px: int, folder: Path) -> Keypoints:
    """Keypoints of a recording encoded with a shorter side of so many px (0: as it is)."""
    kept = folder / f"{name}.{short_px}.npz"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            video = videos()[name]
            if short_px:
                video = encoded(video, short_px, Path(scratch) / "video.mp4")
            found = clip_keypoints(video, Path(scratch) / "people.png", keypoints=KEYPOINT_METHODS.find())
        found.save(kept)
    return Keypoints.load(kept)


def encoded(video: Path, short_px: int, out: Path) -> Path:
    """The recording at another size."""
    height, width = next(iter(read_frames(video))).image.shape[:2]
    factor = short_px / min(height, width)
    size = (2 * round(width * factor / 2), 2 * round(height * factor / 2))
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    times = [f.time_s for f in read_frames(video)]
    images = (cv2.resize(f.image, size, interpolation=how) for f in read_frames(video))
    return write_video(out, images, times, crf=16)


def multiplied(k: Keypoints, factor: float) -> Keypoints:
    """The same points in a picture of another size."""
    matrix = k.camera.matrix.copy()
    matrix[:2] *= factor
    width, height = (round(factor * side) for side in k.image_size_px)
    return dataclasses.replace(
        k,
        xy_px=factor * np.asarray(k.xy_px, float),
        box_px=factor * k.box_px,
        crop_px=None if k.crop_px is None else factor * np.asarray(k.crop_px, float),
        camera=dataclasses.replace(k.camera, matrix=matrix),
        image_size_px=(width, height),
    )


def calibrated(k: Keypoints) -> Keypoints:
    """The demo recording with its own calibration."""
    file = assets.fetch("demo_camera")
    return dataclasses.replace(k, camera=load_camera(file, k.image_size_px))


def index_of(fit: TrialFit) -> float:
    """GDI of one recording, NaN where it has none."""
    mean = gait_metrics([fit]).gdi.mean
    return float("nan") if mean is None else float(mean)


def result(name: str, fit: TrialFit) -> float:
    """Mean error of five angles (deg) of a clip with a truth, the index of the demo."""
    if name not in CLIPS:
        return index_of(fit)
    truth = recorded_angles(SHARED / "real" / "video_mocap" / name / "sample_mocap.json.gz")
    return score(fitted_angles(fit), truth).mean_deg


# --- the unit of the detector's error


def candidates(k: Keypoints) -> dict[str, np.ndarray]:
    """Return sizes of which a detector's error may be a fraction, (T,) each in px of the file."""
    frames = len(k.time_s)
    xyz, xy = (np.nan_to_num(np.asarray(a, float)) for a in (k.xyz_cam_m, k.xy_px))
    root = root_positions(xyz, xy, k.confidence, np.tile(k.camera.matrix, (frames, 1, 1)))
    return {
        "pixel of the file": np.ones(frames),
        "shorter side of the picture": np.full(frames, float(min(k.image_size_px))),
        "box of the points": box_side_px(k),
        "metre at the person's distance": k.camera.focal_px / root[:, 2],
        "crop": crop_px(k),
    }


def errors_at(name: str, short_px: int, folder: Path) -> tuple[Keypoints, np.ndarray, np.ndarray]:
    """Keypoints, and the (T, J) errors in px: all, and less each point's mean over time."""
    own = keypoints_at(name, 0, folder)
    k = keypoints_at(name, short_px, folder)
    factor = np.array(k.image_size_px) / np.array(own.image_size_px)
    true = (truth_of(name, own, SHARED)[0].xy_px + 0.5) * factor - 0.5
    off = np.where((k.confidence > 0)[..., None], k.xy_px - true, np.nan)
    return k, np.linalg.norm(off, axis=-1), np.linalg.norm(off - np.nanmean(off, axis=0), axis=-1)


def sizes_of(name: str) -> Iterator[int]:
    """The sizes at which a recording is looked at: as it is, and those that differ from it."""
    height, width = next(iter(read_frames(videos()[name]))).image.shape[:2]
    return (s for s in SIZES if s == 0 or abs(s / min(height, width) - 1) > 0.02)


@click.group()
def main() -> None:
    """Effects of the size of the picture."""


@main.command()
@keypoints_option
def unit(folder: Path) -> None:
    """Print the spread of the detector's error in each candidate for its unit."""
    quotients: dict[tuple[str, str], dict[str, float]] = {}
    for name in recordings(SHARED):
        for size in sizes_of(name):
            k, whole, rest = errors_at(name, size, folder)
            for label, px in candidates(k).items():
                for kind, error in (("all", whole), ("changing", rest)):
                    quotient = float(np.nanmedian(error / px[:, None]))
                    quotients.setdefault((label, kind), {})[f"{name} {size}"] = quotient
            shown = ", ".join(
                f"{kind} {256 * quotients['crop', kind][f'{name} {size}']:.2f}" for kind in ("all", "changing")
            )
            click.echo(f"{name:6}{size or 'own':>6}: error in pixels of a crop of 256: {shown}")
    click.echo(f"\n{'unit':34}{'spread, all':>14}{'changing':>10}")
    for label in dict.fromkeys(label for label, _ in quotients):
        cells = [np.std(np.log(list(quotients[label, kind].values())), ddof=1) for kind in ("all", "changing")]
        click.echo(f"{label:34}{cells[0]:14.3f}{cells[1]:10.3f}")
    click.echo("\nin small pictures, changing part in pixels of a crop of 256 (side of the crop, px)")
    more = []
    for name in recordings(SHARED):
        large = float(
            np.median([256 * q for key, q in quotients["crop", "changing"].items() if key.split()[0] == name])
        )
        cells = []
        for size in SMALL:
            k, _, rest = errors_at(name, size, folder)
            side = crop_px(k)
            error, crop = 256 * float(np.nanmedian(rest / side[:, None])), float(np.median(side))
            # A median length is 1.18 standard deviations of an axis.
            more.append(np.sqrt(max(error**2 - large**2, 0.0)) * crop / 256 / 1.18)
            cells.append(f"{error:7.2f} ({crop:3.0f})")
        click.echo(f"{name:6}{'large':>7} {large:.2f}{''.join(cells)}")
    click.echo(f"beside the fraction of the crop, of each axis: {np.sqrt(np.mean(np.square(more))):.2f} px of the file")


# --- what becomes of a fit


def method_options(command: Callable) -> Callable:
    """Options that name a method of the fit and change it."""
    command = click.option("--set", "changes", multiple=True, help="A change, such as cost.weight_2d=0.3.")(command)
    return click.option("--params", default=METHODS.default, show_default=True, help="Name of a paramset.")(command)


def fitted(name: str, k: Keypoints, method: Method) -> TrialFit:
    """The fit of one recording."""
    return fit_session([k], [name], method).trials[0]


@main.command()
@keypoints_option
@method_options
def scaled(folder: Path, params: str, changes: tuple[str, ...]) -> None:
    """Fit the same keypoints multiplied; exit code 1 where a mere change of unit changes a result."""
    method, good = changed(METHODS.find(params), changes), True
    click.echo(f"{'':20}{'factor':>7}{'result':>9}{'angle, deg':>12}{'interval':>10}")
    for name in (*CLIPS, DEMO, CALIBRATED):
        own = keypoints_at(name.split(",")[0], 0, folder)
        own = calibrated(own) if name == CALIBRATED else own
        first = fitted(name, own, method)
        used = np.isfinite(first.qpos[:, 0])
        for factor in FACTORS:
            fit = fitted(name, multiplied(own, factor), method)
            turn = np.rad2deg(np.abs(fit.qpos - first.qpos)[used][:, 6:].max())
            sd = np.abs(fit.qpos_sd / first.qpos_sd - 1)[used].max()
            change = abs(result(name, fit) - result(name, first))
            good &= bool(turn <= SCALED_DEG and sd <= SCALED_SD and not change > SCALED_INDEX)
            click.echo(f"{name:20}{factor:7g}{result(name, fit):9.2f}{turn:12.4f}{sd:10.2%}")
    click.echo(f"bars: {SCALED_DEG} deg, {SCALED_INDEX} points, {SCALED_SD:.0%}: {'PASS' if good else 'FAIL'}")
    sys.exit(0 if good else 1)


@main.command(name="encoded")
@keypoints_option
@method_options
def encoded_(folder: Path, params: str, changes: tuple[str, ...]) -> None:
    """Fit what is detected at each size; exit code 1 where results spread by more than the bars."""
    method, good = changed(METHODS.find(params), changes), True
    for name in (*CLIPS, DEMO, CALIBRATED):
        recording = name.split(",")[0]
        found = {}
        for size in sizes_of(recording):
            k = keypoints_at(recording, size, folder)
            k = calibrated(k) if name == CALIBRATED else k
            found[size or "own"] = result(name, fitted(name, k, method))
        spread = float(np.std(list(found.values()), ddof=1))
        good &= spread <= (ENCODED_DEG if name in CLIPS else ENCODED_INDEX)
        cells = "".join(f"{size:>8}{value:8.2f}" for size, value in found.items())
        click.echo(f"{name:20}{cells}   sd {spread:.2f}")
    click.echo(f"bars: sd {ENCODED_DEG} deg, {ENCODED_INDEX} points: {'PASS' if good else 'FAIL'}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
