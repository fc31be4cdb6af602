"""Errors of fits from 2D keypoints of one camera, by the points and the view: the table of docs/models.md.

    python -m research.benchmarks.pixels_2d
    python -m research.benchmarks.pixels_2d --seeds 4 --points COCO_17 --camera guessed

Walks of `pbl synth` with its detector noise, the true focal length or that of a phone's usual lens, no 3D points.
Prints the mean absolute error (deg) of both legs over the frames and walks, the fraction of the samples within 90 %
intervals, and the checks that fail.
"""

from __future__ import annotations

import dataclasses

import click
import numpy as np

from pbl_pipeline.fit import METHODS, fit_session
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.qc import FAIL
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.video import guess_camera

JOINTS = ("hip_flexion", "hip_adduction", "knee_angle", "ankle_angle")
VIEWS = ("sagittal", "oblique", "frontal")
#: Points of `halpe_26` that a program's set lacks.
LACKS = {"BODY_25": ("head",), "COCO_17": ("head", "neck", "hip", "big_toe", "small_toe", "heel")}
Z90 = 1.645


def seen(keypoints: Keypoints, points: str, camera: str) -> Keypoints:
    """The keypoints of a walk with those of a set alone, in pixels."""
    there = np.array([not (n in LACKS[points] or n.partition("_")[2] in LACKS[points]) for n in keypoints.names])
    xy, confidence = np.where(there[:, None], keypoints.xy_px, np.nan), np.where(there, keypoints.confidence, 0.0)
    nothing = np.full_like(keypoints.xyz_cam_m, np.nan)
    lens = guess_camera(keypoints.image_size_px) if camera == "guessed" else keypoints.camera
    return dataclasses.replace(keypoints, xy_px=xy, confidence=confidence, xyz_cam_m=nothing, crop_px=None, camera=lens)


@click.command()
@click.option("--points", type=click.Choice(list(LACKS)), multiple=True, default=("BODY_25",), show_default=True)
@click.option("--camera", type=click.Choice(["true", "guessed"]), default="true", show_default=True)
@click.option("--seeds", type=click.IntRange(1), default=2, show_default=True, help="Walks of each view.")
def main(points: tuple[str, ...], camera: str, seeds: int) -> None:
    """Print the errors of each set of points and view."""
    method = METHODS[METHODS.default]
    click.echo(f"{'points':9} {'view':9} " + " ".join(f"{j:>14}" for j in JOINTS) + "  in 90 %  failed")
    for name in points:
        for view in VIEWS:
            errors, within, failed = [], [], set()
            for seed in range(seeds):
                made = synthesise(SynthSpec(view=view, seed=seed, marker_set="halpe_26", noise="benchmark"))
                fit = fit_session([seen(made.keypoints, name, camera)], ["walk"], method, "static")
                names = list(made.truth.joint_names)
                at = [[names.index(f"{joint}_{side}") for side in "rl"] for joint in JOINTS]
                off = np.degrees(fit.trials[0].qpos - made.truth.qpos)[:, at]
                sd = np.degrees(np.asarray(fit.trials[0].qpos_sd))[:, at]
                errors.append(np.nanmean(np.abs(off), axis=(0, 2)))
                within.append(np.mean((np.abs(off) < Z90 * sd)[np.isfinite(off)]))
                failed |= {c.check for c in fit.qc if c.outcome == FAIL}
            cells = " ".join(f"{e:14.1f}" for e in np.mean(errors, axis=0))
            click.echo(f"{name:9} {view:9} {cells}  {100 * np.mean(within):7.0f}  {', '.join(sorted(failed))}")


if __name__ == "__main__":
    main()
