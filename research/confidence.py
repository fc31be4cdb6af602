"""Fit the curve of a BlazePose network's confidence: `python -m research.confidence DATA [--method blazepose-heavy]`.

DATA is the folder of the development recordings (`real/multiview`, `real/video_mocap`; its README has sources and
licences). Detects the points in the six videos with the method (or takes them from `--keypoints`, where
they were detected by the same parameters), compares them with what is true, fits a curve, says how well a curve fitted
without a recording speaks of it, and adds it to `pbl_pipeline/keypoints/data/confidence_curves.json`. Nothing is drawn
at random, so the same recordings and parameters give the same curve.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import click
import numpy as np
from scipy.optimize import isotonic_regression

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import BOUND_TRUNK, METHODS, ConfidenceCurve, KeypointParams, Keypoints
from pbl_pipeline.methods import Method
from pbl_pipeline.video import load_camera, load_camera_poses
from research.clip_keypoints import clip_keypoints
from research.paths import PACKAGE
from research.reliability.page import write_reliability
from research.reliability.point_errors import PointErrors, point_errors
from research.reliability.point_truth import PointTruth, truth_of_bodies, truth_of_trc

CURVES = PACKAGE / "keypoints" / "data" / "confidence_curves.json"
MOCAP_CLIPS = ("walk", "STS")
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
_TRC = "S00_P00_T01_BalancingTrial_0-100.trc"
#: That of the TRC; as calibrated (two of the videos are 8 px narrower). Only its lenses are used, and where the cameras
#: stood is found from the points: by its poses even the points that the TRC was triangulated from (OpenPose's) lie
#: 20 px off in cam03, 14 to the right and 13 down in the median, and the embedded detector's with them.
_CALIBRATION, _CALIBRATED_SIZE_PX = "Calib_qualisys.toml", (1088, 1920)
#: Points a knot of a curve stands for at least, in fractions of all, and what is added to either outcome of each knot.
_KNOTS, _PRIOR = 24, 1.0


def recordings(data: Path) -> dict[str, Path]:
    """Name and video of the recordings with truth."""
    mocap = {name: data / "real" / "video_mocap" / name / "video.mp4" for name in MOCAP_CLIPS}
    return mocap | {name: data / "real" / "multiview" / f"{name}.mp4" for name in CAMERAS}


def truth_of(name: str, keypoints: Keypoints, data: Path) -> tuple[PointTruth, str]:
    """The truth of one of `recordings`, and the dataset it belongs to: one movement of one person."""
    if name in MOCAP_CLIPS:
        folder = data / "real" / "video_mocap" / name
        return truth_of_bodies(keypoints, folder / "sample_mocap.json.gz"), f"phone clip with marker mocap, {name}"
    folder = data / "real" / "multiview"
    camera = list(load_camera_poses(folder / _CALIBRATION))[CAMERAS.index(name)]
    lens = load_camera(folder / _CALIBRATION, _CALIBRATED_SIZE_PX, camera)
    return truth_of_trc(keypoints, folder / _TRC, lens), "Pose2Sim balancing trial"


def detected(data: Path, folder: Path, method: Method[KeypointParams]) -> Iterator[tuple[str, Keypoints]]:
    """Name and keypoints by the method of each of the recordings; what is not yet in `folder` is kept there."""
    for name, video in recordings(data).items():
        kept = folder / f"{name}.{method.key}.keypoints.npz"
        if not kept.exists():
            folder.mkdir(parents=True, exist_ok=True)
            clip_keypoints(video, kept.with_suffix(".png"), keypoints=method).save(kept)
        yield name, Keypoints.load(kept)


def measured(data: Path, keypoints_folder: Path, method: Method[KeypointParams]) -> list[PointErrors]:
    """The method's errors on all recordings; its keypoints are kept in `keypoints_folder`."""
    errors = []
    for name, keypoints in detected(data, keypoints_folder, method):
        truth, dataset = truth_of(name, keypoints, data)
        click.echo(f"{name}: {truth.note}")
        errors.append(point_errors(keypoints, truth, method.params.detector, dataset, name))
    return errors


def curve_params(method: Method[KeypointParams]) -> dict:
    """Return the dependencies of the confidence: the parameters less the curve's own name, less the grid of the crops,
    which moves them by less than the next frame does, and less the interval of the frames: a recording at 60 frames/s
    of which every second one is used is like one at 30."""
    params = json.loads(method.paramset.canonical_json)
    return {
        name: value for name, value in params.items() if name not in ("confidence_curve", "crop_step_px", "interval_s")
    }


def fit_curve(
    errors: Sequence[PointErrors], name: str, params: dict | None = None, bound: float = BOUND_TRUNK
) -> ConfidenceCurve:
    """The monotone curve (isotonic regression) through the fractions of points within `bound`.

    Every recording weighs the same, however long it is. The points are pooled into `_KNOTS` bins of equal weight, each
    with one point more on either side of the bound (so nothing is ever certain), and the bins made monotone.

    Raises `PblError` REFERENCE_INPUT for errors of several detectors, or too few points.
    """
    detectors = sorted({e.detector for e in errors})
    n = sum(len(e.stated) for e in errors)
    if len(detectors) != 1 or n < 10 * _KNOTS:
        raise PblError(
            "REFERENCE_INPUT",
            found=f"{n} points of {', '.join(detectors) or 'no detector'}",
            expected=f"one detector and {10 * _KNOTS} points or more",
            next_step="take more recordings",
        )
    stated = np.concatenate([e.stated for e in errors])
    right = np.concatenate([e.error_trunk <= bound for e in errors]).astype(float)
    weight = np.concatenate([np.full(len(e.stated), n / len(errors) / len(e.stated)) for e in errors])
    order = np.argsort(stated, kind="stable")
    stated, right, weight = stated[order], right[order], weight[order]
    part = np.minimum((np.cumsum(weight) - 0.5 * weight) / weight.sum() * _KNOTS, _KNOTS - 1).astype(int)
    total = np.bincount(part, weight, _KNOTS)
    fraction = (np.bincount(part, weight * right, _KNOTS) + _PRIOR) / (total + 2 * _PRIOR)
    middle = np.bincount(part, weight * stated, _KNOTS) / np.maximum(total, 1e-12)
    keep = total > 0
    probability = isotonic_regression(fraction[keep], weights=total[keep]).x
    knots, first = np.unique(np.round(middle[keep], 4), return_index=True)
    source = "; ".join(f"{e.title} ({len(e.stated)} points)" for e in errors)
    return ConfidenceCurve(
        name, detectors[0], bound, knots, np.round(probability[first], 4), n, source, dict(params or {})
    )


@dataclasses.dataclass(frozen=True)
class CurveScore:
    """Score of probabilities against the outcome in a recording; lower is better.

    brier: mean squared difference of probability and outcome (0 or 1). gap: mean probability less the fraction within
    the bound. Of the stated confidence taken as a probability, and of a curve that never saw the recording.
    """

    recording: str
    within: float
    brier_stated: float
    brier_curve: float
    gap_stated: float
    gap_curve: float


def leave_one_out(errors: Sequence[PointErrors], bound: float = BOUND_TRUNK) -> list[CurveScore]:
    """Return for each dataset the score of a curve fitted to the others: recordings of one movement are not
    independent."""
    scores = []
    for dataset in dict.fromkeys(e.dataset for e in errors):
        curve = fit_curve([e for e in errors if e.dataset != dataset], "others", bound=bound)
        for e in (e for e in errors if e.dataset == dataset):
            right, p = (e.error_trunk <= bound).astype(float), curve(e.stated)
            scores.append(
                CurveScore(
                    e.title,
                    float(right.mean()),
                    float(np.mean((e.stated - right) ** 2)),
                    float(np.mean((p - right) ** 2)),
                    float(e.stated.mean() - right.mean()),
                    float(p.mean() - right.mean()),
                )
            )
    return scores


def save_curve(curve: ConfidenceCurve, path: str | Path) -> None:
    """Add the curve to a file of curves.

    Raises `PblError` FILE_FORMAT where the file holds another curve of this name: a curve never changes.
    """
    path = Path(path)
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"curves": {}}
    row = {
        "detector": curve.detector,
        "bound_trunk": curve.bound_trunk,
        "n": curve.n,
        "source": curve.source,
        "params": curve.params,
        "stated": curve.stated.tolist(),
        "probability": curve.probability.tolist(),
    }
    if known["curves"].get(curve.name, row) != row:
        raise PblError(
            "FILE_FORMAT",
            found=f"another curve {curve.name} in the file",
            expected="a curve that never changes once it has a name",
            next_step="give the new one the next version",
            key=str(path),
        )
    known["curves"][curve.name] = row
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


keypoints_option = click.option(
    "--keypoints",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("confidence_keypoints"),
    show_default=True,
    help="Folder of keypoints: taken from there, or detected and kept there.",
)


@click.command()
@click.argument("data", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--version", type=click.IntRange(1), required=True, help="Of the curve; one that is there never changes.")
@click.option("--method", default=METHODS.default, show_default=True, help="Keypoint method whose confidence it is.")
@keypoints_option
@click.option("--out", type=click.Path(path_type=Path), default=CURVES, show_default=True, help="File of curves.")
@click.option("--plots", type=click.Path(path_type=Path, file_okay=False), help="Folder for table and page.")
def main(data: Path, version: int, method: str, keypoints: Path, out: Path, plots: Path | None) -> None:
    """Fit the curve and add it to the file of curves."""
    of = METHODS.find(method)
    errors = measured(data, keypoints, of)
    for e in errors:
        median, most = 100 * np.percentile(e.error_trunk, [50, 90])
        click.echo(f"  {e.title:44} error in the picture: median {median:.1f} %, 90 % within {most:.1f} % of the trunk")
    name = of.params.confidence_curve.rsplit("-v", 1)[0] or of.name
    curve = fit_curve(errors, f"{name}-v{version}", curve_params(of))
    click.echo("\nof a recording, by a curve fitted to the other datasets (stated confidence taken as it is | curve)")
    for s in leave_one_out(errors):
        click.echo(
            f"  {s.recording:44} within {s.within:.2f}; Brier {s.brier_stated:.3f} | {s.brier_curve:.3f}; "
            f"too sure by {s.gap_stated:+.2f} | {s.gap_curve:+.2f}"
        )
    save_curve(curve, out)
    click.echo(f"{curve.name}, {len(curve.stated)} knots, {curve.n} points: {out}")
    if plots:
        click.echo(f"{write_reliability(errors, plots, curve)[-1]}")


if __name__ == "__main__":
    main()
