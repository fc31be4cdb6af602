"""The same walk several times: how far the index moves by what means nothing.

    python -m research.benchmarks.same_walk                     # every recording; an hour on two cores
    python -m research.benchmarks.same_walk --clip demo
    python -m research.benchmarks.same_walk --clip demo --params blazepose-measured

Each recording is encoded again mirrored, at half its size, in a tenth of its bytes, and cropped (8 % of each side, 4 %
of top and bottom), and goes through the whole chain: people, keypoints, camera (not calibrated), the default fit,
events, index.
Keypoints are kept in `--keypoints`. Reads the demo recording and `../shared/data/real/{video_mocap,multiview}` (README
there: sources and licences).

Prints of each recording the index of every variant and its standard deviation where there is an index (two steps of a
walk in view), and how far hip, knee and ankle angles are from those of the recording as it is (root mean square, deg;
of the mirrored one with the sides exchanged); below it the index of the curves, without the measurement model that only
the default fit has, and the double support. Then the mean of the standard deviations over the recordings. Exit code 1
where that is over 1.5 points.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import click
import cv2
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, TrialFit
from pbl_pipeline.gait import gait_metrics, score_gdi
from pbl_pipeline.keypoints import METHODS as KEYPOINT_METHODS
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import read_frames
from research.benchmarks.picture_size import fitted, keypoints_option, videos
from research.benchmarks.real_clips import fitted_angles
from research.clip_keypoints import clip_keypoints
from tests.videos import write_video

#: What is cut off each side, and off top and bottom (fractions of the picture).
CUT_SIDE, CUT_TOP = 0.08, 0.04
#: Qualities (CRF) that are tried until a file has a tenth of the bytes.
QUALITIES = (23, 28, 32, 36, 40, 44, 48)
#: Angles that are compared (beginnings of their names).
ANGLES = ("hip_flexion", "knee_flexion", "ankle_angle")
#: Standard deviation of the index over the variants of one recording, mean over the recordings.
MOST_POINTS = 1.5


def own(image: np.ndarray) -> np.ndarray:
    """Return the picture as it is."""
    return image


def mirrored(image: np.ndarray) -> np.ndarray:
    """Return the picture with left and right exchanged."""
    return np.ascontiguousarray(image[:, ::-1])


def halved(image: np.ndarray) -> np.ndarray:
    """Return the picture at half its size, of even sides."""
    height, width = image.shape[:2]
    return cv2.resize(image, (2 * round(width / 4), 2 * round(height / 4)), interpolation=cv2.INTER_AREA)


def cropped(image: np.ndarray) -> np.ndarray:
    """Return the picture without its borders, of even sides."""
    height, width = image.shape[:2]
    x, y = 2 * round(width * CUT_SIDE / 2), 2 * round(height * CUT_TOP / 2)
    return np.ascontiguousarray(image[y : height - y, x : width - x])


VARIANTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": own,
    "mirrored": mirrored,
    "half size": halved,
    "a tenth": own,
    "cropped": cropped,
}


def encoded(video: Path, variant: str, out: Path) -> Path:
    """Write a variant of a recording. "a tenth": the best of `QUALITIES` with at most a tenth of the file's bytes."""
    change = VARIANTS[variant]
    times = [f.time_s for f in read_frames(video)]
    for quality in QUALITIES if variant == "a tenth" else (16,):
        write_video(out, (change(f.image) for f in read_frames(video)), times, crf=quality)
        if out.stat().st_size <= 0.1 * video.stat().st_size:
            break
    return out


def keypoints_of(name: str, variant: str, folder: Path, method: str | None = None) -> Keypoints:
    """Return the keypoints of a variant of a recording, detected or taken from `folder`."""
    detector = KEYPOINT_METHODS.find(method)
    kept = folder / f"{name}.{variant.replace(' ', '_')}.{detector.key}.npz"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            video = videos()[name]
            if variant != "as it is":
                video = encoded(video, variant, Path(scratch) / "video.mp4")
            clip_keypoints(video, Path(scratch) / "people.png", detector).save(kept)
    return Keypoints.load(kept)


def measured(fit: TrialFit) -> tuple[float, float, float]:
    """Return index, index of the curves and double support (%) of one recording, NaN where it has none."""
    found = gait_metrics([fit])
    curves = score_gdi([dataclasses.replace(c, error_model="") for c in found.cycles])
    support = found.spatiotemporal.measures.get("double_support_percent")
    values = (found.gdi.mean, curves.mean, support and support.mean)
    index, of_curves, percent = (float("nan") if v is None else float(v) for v in values)
    return index, of_curves, percent


def spread_of(values: Sequence[float]) -> float:
    """Return the standard deviation of the values that are there: one that is withheld does not spread."""
    shown = [v for v in values if np.isfinite(v)]
    return float(np.std(shown, ddof=1)) if len(shown) > 1 else float("nan")


def angles_apart(first: TrialFit, other: TrialFit, sides_exchanged: bool) -> float:
    """Root mean square of the differences of `ANGLES` (deg) over both sides and the frames that both fits have."""
    (time, angles), (other_time, other_angles) = fitted_angles(first), fitted_angles(other)
    inside = (time >= other_time[0]) & (time <= other_time[-1])
    off = []
    for name, values in angles.items():
        if name.startswith(ANGLES):
            base, side = name[:-2], name[-2:]
            theirs = base + {"_r": "_l", "_l": "_r"}[side] if sides_exchanged else name
            off.append(np.interp(time[inside], other_time, other_angles[theirs]) - values[inside])
    return float(np.sqrt(np.mean(np.square(off))))


@click.command()
@keypoints_option
@click.option("--clip", "clips", multiple=True, help="Name of a recording; all of them where none is named.")
@click.option("--params", default=METHODS.default, show_default=True, help="Name of a paramset.")
@click.option("--method", help="Of the keypoints; default: the project's.")
def main(folder: Path, clips: Sequence[str], params: str, method: str | None) -> None:
    """Print index and angles of every variant; exit code 1 where the index spreads by more than the bar."""
    spreads = []
    click.echo(f"{'':10}" + "".join(f"{v:>16}" for v in VARIANTS) + f"{'sd':>7}")
    for name in clips or videos():
        cells, found, first = [], [], None
        for variant in VARIANTS:
            try:
                fit = fitted(name, keypoints_of(name, variant, folder, method), METHODS.find(params))
            except PblError as error:
                cells.append((f"{error.code:>16}", *[" " * 16] * 2))
                continue
            first = first or fit
            found.append(measured(fit))
            index, of_curves, support = found[-1]
            apart = angles_apart(first, fit, variant == "mirrored")
            cells.append((f"{index:8.1f} {apart:4.1f} deg", f"{of_curves:8.1f}{'':8}", f"{support:14.1f} %"))
        for i, title in enumerate((name, "  curves", "  support")):
            click.echo(f"{title:10}" + "".join(c[i] for c in cells) + f"{spread_of([f[i] for f in found]):7.2f}")
        spreads.append(spread_of([f[0] for f in found]))
    known = [s for s in spreads if np.isfinite(s)]
    if not known:
        click.echo("no recording has an index")
        sys.exit(1)
    mean = float(np.mean(known))
    good = mean <= MOST_POINTS
    click.echo(f"sd of the index, mean over {len(known)} recordings: {mean:.2f}")
    click.echo(f"bar {MOST_POINTS}: {'PASS' if good else 'FAIL'}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
