"""A simple synthetic walker with known joint angles, seen by a level static camera. For tests only."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.synthetic import LEVEL_R_NC, true_markers
from pbl_pipeline.video import Camera

CAMERA = Camera(np.array([[1500.0, 0, 960], [0, 1500.0, 540], [0, 0, 1]]), np.zeros(5), "measured: synthetic")
SIZE = (1920, 1080)


def walking_qpos(
    time_s: np.ndarray,
    stride_s: float = 1.1,
    heading_rad: float = np.pi / 2,
    start_m=(6.0, -1.8),
    speed_m_s: float = 1.2,
) -> np.ndarray:
    """qpos (T, 40): sinusoidal hips, knees, ankles and arms; the pelvis moves along the heading, 0.95 m above ground,
    the camera 1.2 m above ground."""
    body = load_body()
    i = {n: k for k, n in enumerate(body.joint_names)}
    q = np.zeros((len(time_s), len(body.joint_names)))
    phase = 2 * np.pi * time_s / stride_s
    for side, shift in (("r", 0.0), ("l", np.pi)):
        p = phase + shift
        q[:, i[f"hip_flexion_{side}"]] = np.deg2rad(8 + 22 * np.cos(p))
        q[:, i[f"hip_adduction_{side}"]] = np.deg2rad(4 * np.sin(p))
        q[:, i[f"knee_angle_{side}"]] = -np.deg2rad(30 + 27 * np.sin(p - np.pi * 1.1))
        q[:, i[f"ankle_angle_{side}"]] = np.deg2rad(8 * np.sin(p))
        q[:, i[f"arm_flex_{side}"]] = np.deg2rad(-18 * np.cos(p))
        q[:, i[f"elbow_flex_{side}"]] = np.deg2rad(25)
        q[:, i[f"arm_add_{side}"]] = np.deg2rad(-8)
    along = speed_m_s * time_s
    x = start_m[0] + along * np.cos(heading_rad)
    y = start_m[1] + along * np.sin(heading_rad)
    z = 0.95 - 1.2 + 0.015 * np.cos(2 * phase)
    # The pelvis slides in OpenSim's axes: x forward, y up, z right (= world -y); rest height 0.975 m.
    q[:, i["pelvis_tx"]], q[:, i["pelvis_ty"]], q[:, i["pelvis_tz"]] = x, z - 0.975, -y
    q[:, i["pelvis_rotation"]] = heading_rad
    return q


def observe(
    qpos: np.ndarray,
    time_s: np.ndarray,
    marker_set_name: str = "blazepose_33",
    noise_px: float = 0.0,
    noise_m: float = 0.0,
    scale: np.ndarray | None = None,
    seed: int = 0,
    confidence: float = 0.9,
) -> Keypoints:
    """Project the walker into the camera and add noise."""
    markers = marker_set(marker_set_name)
    rng = np.random.default_rng(seed)
    x_cam = true_markers(qpos, markers, scale) @ LEVEL_R_NC
    uv = x_cam @ CAMERA.matrix.T
    xy = uv[..., :2] / uv[..., 2:] + rng.normal(0, noise_px, (*x_cam.shape[:2], 2))
    relative = x_cam - x_cam.mean(axis=1, keepdims=True) + rng.normal(0, noise_m, x_cam.shape)
    box = np.concatenate([xy.min(axis=1), xy.max(axis=1)], axis=1)
    return Keypoints(
        time_s=time_s,
        names=tuple(markers.names),
        marker_set=markers.name,
        xy_px=xy,
        xyz_cam_m=relative,
        root_relative=True,
        confidence=np.full(x_cam.shape[:2], confidence),
        image_size_px=SIZE,
        camera=CAMERA,
        box_px=box,
    )
