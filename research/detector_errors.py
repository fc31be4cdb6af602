"""Errors of a keypoint method, as `research.corpus` draws them: `python -m research.detector_errors DATA`.

DATA is the folder of the development recordings, as for `research.confidence`, whose truth is taken. Prints a line for
each recording and, of all of them, the fields of `pbl_pipeline.synthetic.Noise` that they tell.

In the picture an error is a length at the person's distance: the part of each point that does not change, and the rest.
In 3D a similarity (turn, size) takes the found points to the true ones in each frame: its mean over the recording is
the lean, its change the wander; the remainder is again a constant for each point and the rest, across the line of sight
and along it. Gross points (further than `_GROSS_M` from where the point's median error puts them) count apart.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from pbl_pipeline.fit.units import crop_px
from pbl_pipeline.keypoints import METHODS, Keypoints
from pbl_pipeline.keypoints.blazepose import INPUT_SIZE
from research.confidence import detected, keypoints_option, truth_of
from research.reliability.point_truth import PointTruth

_GROSS_M = 0.2
_AXES = ("right", "down", "ahead")


def errors_of(keypoints: Keypoints, truth: PointTruth) -> dict[str, float]:
    """Return for one recording standard deviations per axis in m, turns in degrees about the camera's axes,
    correlations over 1/30 s. Points and frames that one of the two lacks do not count."""
    known = (keypoints.confidence > 0) & np.isfinite(truth.xyz_cam_m[..., 0])
    step = max(1, round(1 / 30 / float(np.median(np.diff(keypoints.time_s)))))
    x, _, z = np.moveaxis(truth.xyz_cam_m[known], -1, 0)
    focal_px = float(np.polyfit(x / z, truth.xy_px[known][:, 0], 1)[0])
    px_per_m = focal_px / truth.xyz_cam_m[..., 2]
    xy = np.where(known[..., None], (keypoints.xy_px - truth.xy_px) / px_per_m[..., None], np.nan)
    off = np.linalg.norm(xy - np.nanmedian(xy, axis=0), axis=-1)
    gross = float(np.mean(off[known] > _GROSS_M))
    xy[~(off <= _GROSS_M)] = np.nan
    xy_constant, xy_rest = _parts(xy)
    crop_m = crop_px(keypoints)[:, None] / px_per_m
    turn, size, left = _similarity(np.asarray(keypoints.xyz_cam_m, float), truth.xyz_cam_m, known & (off <= _GROSS_M))
    ray = truth.xyz_cam_m / np.linalg.norm(truth.xyz_cam_m, axis=-1, keepdims=True)
    along = np.sum(left * ray, axis=-1, keepdims=True)
    across = left - along * ray
    along_constant, along_rest = _parts(along)
    across_constant, across_rest = _parts(across)
    depth = truth.xyz_cam_m[..., 2] - np.nanmean(truth.xyz_cam_m[..., 2], axis=1, keepdims=True)
    far, near = (np.sqrt(np.nanmean(xy_rest[where] ** 2)) for where in (depth > 0.05, depth < -0.05))
    return {
        "xy_constant_m": _rms(xy_constant),
        "xy_m": _rms(xy_rest),
        "xy_crop_px": float(np.nanmedian(np.linalg.norm(xy_rest, axis=-1) / crop_m) * INPUT_SIZE),
        "xy_correlation": _correlation(xy_rest, step),
        "gross": gross,
        **{f"lean_{axis}_deg": float(v) for axis, v in zip(_AXES, np.nanmean(turn, axis=0), strict=True)},
        **{f"wander_{axis}_deg": float(v) for axis, v in zip(_AXES, np.nanstd(turn, axis=0), strict=True)},
        "size": float(np.nanmean(size)),
        # Across the line of sight there are two axes.
        "constant_m": _rms(across_constant) * np.sqrt(1.5),
        "constant_along_m": _rms(along_constant),
        "across_m": _rms(across_rest) * np.sqrt(1.5),
        "along_m": _rms(along_rest),
        "correlation": _correlation(left - np.nanmean(left, axis=0), step),
        "far_over_near": float(far / near),
    }


def _parts(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each point's mean over time, and the rest."""
    constant = np.nanmean(errors, axis=0, keepdims=True)
    return constant, errors - constant


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _correlation(values: np.ndarray, step: int) -> float:
    early, late = values[:-step], values[step:]
    both = np.isfinite(early) & np.isfinite(late)
    return float(np.corrcoef(early[both], late[both])[0, 1])


def _similarity(found: np.ndarray, true: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By how much the found points of each frame are turned (T, 3; rotation vector, degrees) and larger (T,) than the
    true ones, and what is left (T, J, 3) when that is undone, about the middle of the points."""
    turn, size, left = np.full((len(found), 3), np.nan), np.full(len(found), np.nan), np.full(found.shape, np.nan)
    for t in np.flatnonzero(known.sum(axis=1) >= 6):
        k = known[t]
        a, b = found[t, k] - found[t, k].mean(axis=0), true[t, k] - true[t, k].mean(axis=0)
        rotation = Rotation.align_vectors(a, b)[0]
        turned = rotation.apply(b)
        size[t] = np.sum(turned * a) / np.sum(b * b)
        turn[t] = rotation.as_rotvec(degrees=True)
        left[t, k] = a - size[t] * turned
    return turn, size, left


@click.command()
@click.argument("data", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--method", default=METHODS.default, show_default=True, help="Keypoint method.")
@keypoints_option
def main(data: Path, method: str, keypoints: Path) -> None:
    """Print the errors of the method on each recording, and of all of them together."""
    of = METHODS.find(method)
    rows = {name: errors_of(found, truth_of(name, found, data)[0]) for name, found in detected(data, keypoints, of)}
    table = pd.DataFrame.from_dict(rows, orient="index")
    table.loc["rms of all"] = np.sqrt((table**2).mean())
    table.loc["mean", ["size", "xy_correlation", "correlation", "gross", "far_over_near"]] = table.iloc[:-1].mean()
    table.loc["sd", "size"] = table["size"].iloc[: len(rows)].std()
    click.echo(f"{of.name} version {of.version}, {len(rows)} recordings")
    click.echo(table.round(3).T.to_string(na_rep="-"))


if __name__ == "__main__":
    main()
