"""One balancing trial seen by four calibrated cameras: fitted together, and from each camera alone.

    python -m research.benchmarks.multiview
    python -m research.benchmarks.multiview --params blazepose --out pictures

Reads `../shared/data/real/multiview`; see the README there for its source and licence: 100 frames at 60 Hz, points of
OpenPose BODY_25B (on a grid of 5 px), and OpenSim's inverse kinematics of what others triangulated from them. There is
no 3D, so a camera alone has pixels and the priors of the paramset, nothing else.

The calibration is Calib_scene.toml: with it the triangulated points lie 8.8 px (median) from the detected ones, with
Calib_qualisys.toml, from which the triangulated .trc and so the .mot were made, 12.6 px. The two worlds differ by 1 deg
and 1 % in size, and triangulated hips by 5 to 8 cm: a bar on agreement with the .mot would measure the calibration.

Prints the reprojection (median, px) of each camera; knee and hip flexion of each camera alone against the four
together, and of the four together against the two .mot. `--out` also draws the fitted bodies over a few frames.
"""

from __future__ import annotations

import sys
from pathlib import Path

import click
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import capsules, load_body, marker_set
from pbl_pipeline.fit import METHODS, TrialFit, fit_session
from pbl_pipeline.keypoints import Keypoints, MultiView
from pbl_pipeline.render import draw_body, draw_keypoints, to_pixels
from pbl_pipeline.video import CameraPose, load_camera, read_frames
from research.benchmarks.marker_ik import JUDGED, agreement, expert_angles, fitted_angles
from research.benchmarks.real_clips import changed
from research.paths import SHARED

FOLDER = SHARED / "real" / "multiview"
CALIBRATION = FOLDER / "Calib_scene.toml"
#: Key in the .npz, stem of the video, and the camera in the calibration.
CAMERAS = {f"cam0{i}": f"int_cam0{i}_img" for i in (1, 2, 3, 4)}
REFERENCES = {
    "43 augmented markers": "S00_P00_T01_BalancingTrial_filt_butterworth_0-100_LSTM.mot",
    "the 21 points": "S00_P00_T01_BalancingTrial_filt_butterworth_0-100_body25b.mot",
}
#: As calibrated; the first two videos are 8 px narrower, cut at the right or by an encoder.
IMAGE_SIZE_PX = (1088, 1920)
RATE_HZ = 60.0
#: The subject is the first person of each frame; others are the detector's second.
SUBJECT = 0
MAX_MEDIAN_PX = 12.0


def view_of(camera: str) -> Keypoints:
    """The subject's 2D points from one camera; 3D is all NaN."""
    with np.load(FOLDER / "openpose_body25b_2d.npz") as data:
        points = data[camera][:, SUBJECT].astype(np.float64)
    seen = points[..., 2] > 0
    xy = np.where(seen[..., None], points[..., :2], np.nan)
    box = np.concatenate([np.nanmin(xy, axis=1), np.nanmax(xy, axis=1)], axis=1)
    return Keypoints(
        time_s=np.arange(len(points)) / RATE_HZ,
        names=marker_set("body25b").names,
        marker_set="body25b",
        xy_px=xy,
        xyz_cam_m=np.full((*seen.shape, 3), np.nan),
        root_relative=True,
        confidence=np.clip(np.where(seen, points[..., 2], 0.0), 0, 1),
        image_size_px=IMAGE_SIZE_PX,
        camera=load_camera(CALIBRATION, IMAGE_SIZE_PX, CAMERAS[camera]),
        box_px=box,
    )


def multi_view() -> MultiView:
    """The four views with their poses."""
    return MultiView.from_calibration([view_of(c) for c in CAMERAS], CALIBRATION, list(CAMERAS.values()))


def pose_alone(fit: TrialFit) -> CameraPose:
    """The pose of a camera that was fitted alone: it stands at the world's origin and does not turn."""
    return CameraPose(Rotation.from_quat(fit.phone_quat_wxyz[0], scalar_first=True).as_matrix(), np.zeros(3))


def reprojection_px(fit: TrialFit, view: Keypoints, pose: CameraPose) -> np.ndarray:
    """Distance (T, J) of fitted and detected points in the picture, lens distortion included; NaN where not seen."""
    in_camera = (fit.markers_world_m - pose.p_nc) @ pose.R_nc
    return np.linalg.norm(to_pixels(in_camera, view.camera) - view.xy_px, axis=-1)


def draw(image: np.ndarray, fit: TrialFit, frame: int, view: Keypoints, pose: CameraPose) -> None:
    """The fitted body and the detected points over one frame, in place."""
    if np.isfinite(fit.qpos[frame]).all():
        shape = capsules(load_body(), fit.qpos[frame : frame + 1], fit.scale)
        quat = Rotation.from_matrix(pose.R_nc).as_quat(scalar_first=True)
        ends = shape.start[0], shape.end[0]
        draw_body(image, shape.body_names, *ends, shape.radius_m, quat, pose.p_nc, view.camera, opacity=0.5)
    draw_keypoints(image, view.xy_px[frame], view.confidence[frame])


def picture(rows: dict[str, dict[str, tuple[TrialFit, CameraPose]]], frame: int, views: dict[str, Keypoints]):
    """One frame: a row for each kind of fit, a column for each camera, cut to the person's surroundings."""
    images = {c: next(read_frames(FOLDER / f"{c}.mp4", start=frame, stop=frame + 1)).image for c in views}
    lines = []
    for fits in rows.values():
        cells = []
        for camera, view in views.items():
            image = images[camera].copy()
            if camera in fits:
                draw(image, fits[camera][0], frame, view, fits[camera][1])
            cells.append(cv2.resize(image[250:1400], (480, round(1150 * 480 / image.shape[1]) // 2 * 2)))
        height = min(len(c) for c in cells)
        lines.append(np.hstack([c[:height] for c in cells]))
    width = min(line.shape[1] for line in lines)
    return np.vstack([line[:, :width] for line in lines])


def _angles_relative(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A .mot's angles; its first row is the first frame (checked by triangulation) but is stamped 1/60 s."""
    time, angles = expert_angles(path)
    return time - time[0], angles


def _print_agreement(title: str, ours, theirs) -> None:
    found = agreement(ours, theirs)
    cells = "".join(f"{a.r:8.2f}{a.offset_deg:7.1f}{a.sd_deg:6.1f}" for a in (found[n] for n in JUDGED))
    click.echo(f"    {title:32}{cells}")


@click.command()
@click.option("--params", default="blazepose", show_default=True, help="Name of a paramset.")
@click.option("--set", "changes", multiple=True, help="A change to it, such as cost.huber_2d_px=15.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Folder for pictures of the fits.")
@click.option("--frame", "frames", type=int, multiple=True, default=(0, 30, 50, 70, 95), help="Frames to draw.")
def main(params: str, changes: tuple[str, ...], out: Path | None, frames: tuple[int, ...]) -> None:
    """Print reprojection and angles; exit code 1 where the bar on the reprojection is missed."""
    if not FOLDER.is_dir():
        sys.exit(f"the recording is absent: {FOLDER}")
    paramset = changed(METHODS[params], changes)
    trial = multi_view()
    views = dict(zip(CAMERAS, trial.views, strict=True))
    poses = dict(zip(CAMERAS, trial.poses, strict=True))
    together = fit_session([trial], ["balancing"], paramset).trials[0]
    every = {c: reprojection_px(together, views[c], poses[c]) for c in CAMERAS}
    median = float(np.nanmedian(np.stack(list(every.values()))))
    good = median <= MAX_MEDIAN_PX
    click.echo(f"four cameras together, {paramset.name}: {together.seconds:.1f} s")
    click.echo(f"  reprojection median {median:.1f} px (bar {MAX_MEDIAN_PX:g}) {'PASS' if good else 'FAIL'}")
    click.echo("  by camera: " + ", ".join(f"{c} {np.nanmedian(e):.1f}" for c, e in every.items()))
    click.echo(f"  scale {' '.join(f'{s:.2f}' for s in together.scale)}")
    alone = {c: fit_session([views[c]], [c], paramset).trials[0] for c in CAMERAS}
    head = "".join(f"{n.replace('_flexion', ''):>21}" for n in JUDGED)
    click.echo(f"\n  {'flexion: r, offset, sd (deg)':34}{head}")
    click.echo("  against the four together")
    for camera, fit in alone.items():
        own = np.nanmedian(reprojection_px(fit, views[camera], pose_alone(fit)))
        title = f"{camera} alone ({own:.1f} px, size {fit.scale[0]:.2f})"
        _print_agreement(title, fitted_angles(fit), fitted_angles(together))
    click.echo("  the four together against")
    for name, file in REFERENCES.items():
        _print_agreement(f"OpenSim, {name}", fitted_angles(together), _angles_relative(FOLDER / file))
    if out:
        out.mkdir(parents=True, exist_ok=True)
        rows = {
            "together": {c: (together, poses[c]) for c in CAMERAS},
            "alone": {c: (fit, pose_alone(fit)) for c, fit in alone.items()},
        }
        for frame in frames:
            cv2.imwrite(str(out / f"multiview_{frame:03d}.png"), picture(rows, frame, views))
        click.echo(f"pictures in {out}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
