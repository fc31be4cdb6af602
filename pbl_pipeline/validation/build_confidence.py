"""Fit the curve of the embedded detector's confidence: `python -m pbl_pipeline.validation.build_confidence DATA`.

DATA is the folder of the development recordings (`real/multiview`, `real/video_mocap`; its README has sources and
licences). Detects the points in the six videos with the default parameters (or takes them from `--keypoints`, where
they were detected by the same parameters), compares them with what is true, fits a curve, says how well a curve fitted
without a recording speaks of it, and adds it to `pbl_pipeline/keypoints/data/confidence_curves.json`. Nothing is drawn
at random, so the same recordings and parameters give the same curve.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from pbl_pipeline.keypoints import DEFAULT, PARAMSETS, KeypointParams, Keypoints
from pbl_pipeline.pipeline import detect_trial
from pbl_pipeline.video import load_camera, load_camera_poses

from ._point_truth import PointTruth, truth_of_bodies, truth_of_trc
from ._reliability import PointErrors, fit_curve, leave_one_out, point_errors, save_curve
from ._reliability_page import write_reliability

CURVES = Path(__file__).parents[1] / "keypoints" / "data" / "confidence_curves.json"
MOCAP_CLIPS = ("walk", "STS")
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
_TRC = "S00_P00_T01_BalancingTrial_0-100.trc"
#: That of the TRC; as calibrated (two of the videos are 8 px narrower). Only its lenses are used, and where the cameras
#: stood is found from the points: by its poses even the points that the TRC was triangulated from (OpenPose's) lie
#: 20 px off in cam03, 14 to the right and 13 down in the median, and the embedded detector's with them.
_CALIBRATION, _CALIBRATED_SIZE_PX = "Calib_qualisys.toml", (1088, 1920)


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


def measured(data: Path, keypoints_folder: Path) -> list[PointErrors]:
    """The errors of the embedded detector on all recordings; its keypoints are kept in `keypoints_folder`."""
    errors = []
    for name, video in recordings(data).items():
        kept = keypoints_folder / f"{name}.keypoints.npz"
        if not kept.exists():
            keypoints_folder.mkdir(parents=True, exist_ok=True)
            detect_trial(video, kept.with_suffix(".png")).keypoints.save(kept)
        keypoints = Keypoints.load(kept)
        truth, dataset = truth_of(name, keypoints, data)
        click.echo(f"{name}: {truth.note}")
        errors.append(point_errors(keypoints, truth, KeypointParams().detector, dataset, name))
    return errors


def curve_params(params: KeypointParams) -> dict:
    """What the confidence depends on: the parameters less the curve's own name."""
    return {k: v for k, v in dataclasses.asdict(params).items() if k != "confidence_curve"}


@click.command()
@click.argument("data", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--version", type=click.IntRange(1), required=True, help="Of the curve; one that is there never changes.")
@click.option(
    "--keypoints",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("confidence_keypoints"),
    show_default=True,
    help="Folder of keypoints: taken from there, or detected and kept there.",
)
@click.option("--out", type=click.Path(path_type=Path), default=CURVES, show_default=True, help="File of curves.")
@click.option("--plots", type=click.Path(path_type=Path, file_okay=False), help="Folder for table and page.")
def main(data: Path, version: int, keypoints: Path, out: Path, plots: Path | None) -> None:
    """Fit the curve and add it to the file of curves."""
    errors = measured(data, keypoints)
    curve = fit_curve(errors, f"blazepose-v{version}", curve_params(PARAMSETS[DEFAULT].to(KeypointParams)))
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
