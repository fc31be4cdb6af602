"""A fit with markers, as exports want it: a walk of a body with scales and marker offsets of its own."""

import dataclasses

import numpy as np

from pbl_pipeline.body import load_body, marker_positions, marker_set
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import Camera
from tests.walking_fit import walking_fit


def marked_fit(
    markers: str = "blazepose_33", *, n_frames: int = 150, seen: tuple[int, int] | None = None, seed: int = 0
) -> TrialFit:
    """`walking_fit` in a scaled body with displaced markers; every joint moves."""
    body, places, rng = load_body(), marker_set(markers), np.random.default_rng(seed)
    fit = walking_fit(n_frames=n_frames, seen=seen, marker_names=places.names)
    scale, offset = rng.uniform(0.9, 1.1, 8), rng.normal(0, 0.005, (len(places), 3))
    time = np.asarray(fit.time_s)[:, None]
    sway = np.radians(4.0) * np.sin(2 * np.pi * time * rng.uniform(0.3, 0.9, 40) + rng.uniform(0, 6, 40))
    qpos = fit.qpos + sway * body.is_hinge
    return with_markers(dataclasses.replace(fit, qpos=qpos, marker_set=markers, scale=scale, site_offset_m=offset))


def with_markers(fit: TrialFit) -> TrialFit:
    """The fit with the markers that belong to its joint values."""
    known = np.isfinite(fit.qpos).all(axis=1)
    x = np.full((len(fit.time_s), len(fit.marker_names), 3), np.nan)
    x[known] = marker_positions(load_body(), marker_set(fit.marker_set), fit.qpos[known], fit.scale, fit.site_offset_m)
    return dataclasses.replace(fit, markers_world_m=x)


def keypoints_of(fit: TrialFit) -> Keypoints:
    """Points seen anywhere in the picture, with the stamps and names of a fit."""
    rng, (n, j) = np.random.default_rng(1), fit.markers_world_m.shape[:2]
    return Keypoints(
        time_s=fit.time_s,
        names=fit.marker_names,
        marker_set=fit.marker_set,
        xy_px=rng.uniform(0, 300, (n, j, 2)).astype(np.float32),
        xyz_cam_m=np.full((n, j, 3), np.nan),
        root_relative=True,
        confidence=rng.uniform(0.3, 1.0, (n, j)).astype(np.float32),
        image_size_px=(640, 360),
        camera=Camera(fit.camera.matrix, np.zeros(5), "guess: a test"),
        box_px=np.zeros((n, 4)),
        origin="a detector, licence Apache-2.0",
    )
