"""The walker as a laboratory sees it: several calibrated cameras, or markers on the skin."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import MarkerSet
from pbl_pipeline.synthetic import Noise, pelvis_positions, true_markers
from pbl_pipeline.synthetic.camera import camera_turn
from pbl_pipeline.synthetic.observe import as_marker_set, seen_by
from pbl_pipeline.video import Camera

if TYPE_CHECKING:
    from pbl_pipeline.keypoints import MultiView, WorldMarkers

#: Cameras of a laboratory: level pictures, wide lenses with some distortion (OpenCV: k1 k2 p1 p2 k3).
VIEW_SIZE_PX = (1920, 1080)
VIEW_CAMERA = Camera(
    np.array([[1100.0, 0, 959.5], [0, 1100.0, 539.5], [0, 0, 1]]),
    np.array([-0.12, 0.05, 0.0008, -0.0005, 0.0]),
    "measured: a synthetic laboratory",
)
#: They stand this far from the middle of the walk and this high above the phone's height (m).
RING_M, RAISED_M = 6.5, 0.6


def observe_views(
    qpos: Float[np.ndarray, "T 40"],
    time_s: Float[np.ndarray, " T"],
    *,
    n_views: int = 4,
    marker_set: str | MarkerSet = "bml_movi_87",
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
    noise: Noise | None = None,
    seed: int = 0,
    with_3d: bool = False,
    camera: Camera = VIEW_CAMERA,
) -> MultiView:
    """Look at a walk with `n_views` calibrated cameras that stand around it and look at its middle.

    Without `with_3d` all `xyz_cam_m` are NaN, as of a 2D detector. Each camera has its own noise, outliers and missing
    points; other parameters as in `observe`.
    """
    from pbl_pipeline.keypoints import MultiView
    from pbl_pipeline.video import CameraPose

    markers, noise = as_marker_set(marker_set), noise or Noise()
    x_world = true_markers(qpos, markers, scale, site_offset_m)
    path = pelvis_positions(qpos)
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    views, poses = [], []
    for i in range(n_views):
        # Not symmetric: no two cameras look along one line.
        around = 2 * np.pi * i / n_views + np.radians(35.0 + 4.0 * i)
        x, y = RING_M * np.cos(around), RING_M * np.sin(around)
        p_nc = np.array([middle[0] + x, middle[1] + y, RAISED_M + 0.1 * i])
        down = np.arctan2(p_nc[2] - middle[2], RING_M)
        R_nc = camera_turn(np.array(around + np.pi), np.array(-down), np.array(0.0))[0]
        keypoints, _ = seen_by(
            np.random.default_rng([seed, 6, i]),
            noise,
            np.asarray(time_s, np.float64),
            x_world,
            np.tile(R_nc, (len(qpos), 1, 1)),
            p_nc,
            markers,
            camera,
            VIEW_SIZE_PX,
            root_relative=True,
        )
        if not with_3d:
            keypoints.xyz_cam_m[:] = np.nan
        views.append(keypoints)
        poses.append(CameraPose(R_nc, p_nc))
    return MultiView(views=tuple(views), poses=tuple(poses))


def observe_markers(
    qpos: Float[np.ndarray, "T 40"],
    time_s: Float[np.ndarray, " T"],
    *,
    marker_set: str | MarkerSet = "bml_movi_87",
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
    noise_m: float = 0.001,
    drop_share: float = 0.02,
    seed: int = 0,
) -> WorldMarkers:
    """Markers of a laboratory on a walk: white noise of `noise_m` per axis, `drop_share` of the points missing."""
    from pbl_pipeline.keypoints import WorldMarkers

    markers = as_marker_set(marker_set)
    rng = np.random.default_rng([seed, 7])
    x_world = true_markers(qpos, markers, scale, site_offset_m)
    seen = rng.random(x_world.shape[:2]) >= drop_share
    x_world = x_world + noise_m * rng.standard_normal(x_world.shape)
    return WorldMarkers(
        time_s=np.asarray(time_s, np.float64),
        names=tuple(markers.names),
        marker_set=markers.name,
        xyz_world_m=np.where(seen[..., None], x_world, np.nan),
        confidence=np.where(seen, 1.0, 0.0),
    )
