"""The package's walker seen by a level camera that stands still and films in landscape: keypoints, white noise."""

import dataclasses

import numpy as np

from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.synthetic import NO_NOISE
from pbl_pipeline.video import Camera
from research.walker.observe import observe as observe_by_phone

CAMERA = Camera(np.array([[1500.0, 0, 960], [0, 1500.0, 540], [0, 0, 1]]), np.zeros(5), "measured: synthetic")
SIZE = (1920, 1080)


def observe(
    qpos: np.ndarray,
    time_s: np.ndarray,
    marker_set: str = "blazepose_33",
    noise_px: float = 0.0,
    noise_m: float = 0.0,
    scale: np.ndarray | None = None,
    seed: int = 0,
) -> Keypoints:
    """Keypoints with independent noise of every frame, point and axis."""
    noise = dataclasses.replace(NO_NOISE, across_m=noise_m, along_m=noise_m, correlation=0.0, xy_px=noise_px)
    return observe_by_phone(
        qpos,
        time_s,
        marker_set=marker_set,
        scale=scale,
        noise=noise,
        seed=seed,
        camera=CAMERA,
        image_size_px=SIZE,
    ).keypoints
