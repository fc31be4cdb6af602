"""`python -m research.reliability`: the stated confidence of a detector's points against their measured error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

_FILE = click.Path(path_type=Path, readable=False)


@click.command(epilog="Example: python -m research.reliability walk.keypoints.npz --truth mocap.json.gz --out errors")
@click.argument("keypoints", nargs=-1, required=True, type=_FILE)
@click.option(
    "--truth",
    "truths",
    multiple=True,
    required=True,
    type=_FILE,
    metavar="FILE",
    help="True points, once for each of KEYPOINTS, in their order: truth.npz of pbl synth, bodies of a marker mocap "
    "(.json.gz), or markers of several cameras (.trc). Where the camera stood is found from the points.",
)
@click.option(
    "--calibration", type=_FILE, metavar="FILE", help="Take the poses of the cameras of .trc files from there."
)
@click.option(
    "--camera",
    "cameras",
    multiple=True,
    metavar="NAME",
    help="The camera of each .trc, in their order.",
)
@click.option("--dataset", default="files", show_default=True, help="Name to report them under.")
@click.option("--detector", metavar="NAME", help="Name to report them under (else: the marker set).")
@click.option("--bins", type=click.IntRange(2, 50), default=10, show_default=True, help="Of equally many points.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write reliability.csv and .html there.")
def main(
    keypoints: tuple[Path, ...],
    truths: tuple[Path, ...],
    calibration: Path | None,
    cameras: tuple[str, ...],
    dataset: str,
    detector: str | None,
    bins: int,
    out: Path | None,
) -> None:
    """Stated confidence of the points in KEYPOINTS against their measured error (research/reports).

    Prints bins of stated confidence: the error in the picture as a share of the trunk's length (median, 90 percent) and
    how many points lie within 20 percent of it, measured and by the stored curve of the detector, where it has one.
    """
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.keypoints import Keypoints, confidence_curve
    from research.reliability.page import write_reliability
    from research.reliability.point_errors import point_errors, reliability_table

    if len(truths) != len(keypoints):
        raise click.UsageError(f"{len(truths)} of --truth for {len(keypoints)} KEYPOINTS: one for each")
    if out is not None:
        check_out_folder(out)
    names = iter(_cameras(truths, calibration, cameras))
    errors, curves = [], set()
    for path, file in zip(keypoints, truths, strict=True):
        seen = Keypoints.load(path)
        curves.add(seen.confidence_curve)
        truth = _truth(seen, file, calibration, next(names) if file.suffix == ".trc" else "")
        click.echo(f"{path.name}: {truth.note}")
        stem = path.name.removesuffix(".npz").removesuffix(".keypoints")
        errors.append(point_errors(seen, truth, detector or seen.marker_set, dataset, stem))
    known = curves.pop() if len(curves) == 1 else ""
    curve = confidence_curve(known) if known else None
    table = reliability_table(errors, curve, bins)
    click.echo(
        f"\n{'stated':>14}{'points':>8}{'median':>9}{'90 %':>7} of the trunk{'within 20 %':>13}"
        + (f"{'curve':>7}" if curve else "")
    )
    for r in table.to_dict("records"):
        click.echo(
            f"{r['stated_low']:6.2f} to {r['stated_high']:4.2f}{r['n']:8d}{r['error_median_trunk']:9.3f}"
            f"{r['error_90_trunk']:7.3f}{'':13}{r['within_bound']:13.2f}"
            + (f"{r['probability_mean']:7.2f}" if curve else "")
        )
    if out is not None:
        paths = write_reliability(errors, out, curve, bins)
        click.echo(f"table and page: {paths[0]}, {paths[-1]}")


def _cameras(truths: Sequence[Path], calibration: Path | None, cameras: Sequence[str]) -> Sequence[str]:
    """The camera of each .trc file, "" where it is to be found. Raises `click.UsageError` where they do not belong."""
    n = sum(t.suffix == ".trc" for t in truths)
    if calibration is None and not cameras:
        return [""] * n
    if calibration is None or len(cameras) != n or not n:
        raise click.UsageError(f"--calibration and --camera go together: --camera once for each .trc file, here {n}")
    return cameras


def _truth(keypoints, file: Path, calibration: Path | None, camera: str):
    from pbl_pipeline.errors import PblError
    from pbl_pipeline.synthetic import Truth
    from pbl_pipeline.video import load_camera, load_camera_poses
    from research.reliability.point_truth import truth_of_bodies, truth_of_synthetic, truth_of_trc

    if file.suffix == ".npz":
        return truth_of_synthetic(keypoints, Truth.load(file))
    if file.suffix != ".trc":
        return truth_of_bodies(keypoints, file)
    if calibration is None:
        return truth_of_trc(keypoints, file)
    poses = load_camera_poses(calibration)
    if camera not in poses:
        raise PblError(
            "CAMERA_INVALID",
            found=f"camera {camera!r}",
            expected=f"one of {', '.join(poses)}",
            next_step="name the camera as the calibration does",
            key=str(calibration),
        )
    return truth_of_trc(keypoints, file, load_camera(calibration, keypoints.image_size_px, camera), poses[camera])


if __name__ == "__main__":
    main()
