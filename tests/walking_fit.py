"""A walking body with known joint angles, in the form of a fit: for drawing, export and report."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.fit import TrialFit
from pbl_pipeline.video import Camera

LEVEL_CAMERA_QUAT_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])
CYCLE_S, STANCE = 1.1, 0.61


def _bump(phase: np.ndarray, centre: float, width: float) -> np.ndarray:
    distance = (phase - centre + 0.5) % 1.0 - 0.5
    return np.exp(-0.5 * (distance / width) ** 2)


def joint_angles_deg(phase: np.ndarray) -> dict[str, np.ndarray]:
    """Angles of one side over the phase 0..1 of its gait cycle: sums of bumps with the shape of normal gait."""
    turn = 2 * np.pi * phase
    return {
        "hip_flexion": 12 + 22 * np.cos(turn - 0.2) - 3 * np.cos(2 * turn),
        "hip_adduction": 1 + 5 * np.sin(turn - 0.4),
        "hip_rotation": 2 + 4 * np.cos(turn + 1.0),
        "knee_flexion": 5 + 13 * _bump(phase, 0.14, 0.06) + 55 * _bump(phase, 0.72, 0.085),
        "ankle_angle": 8 * _bump(phase, 0.45, 0.14) - 16 * _bump(phase, 0.64, 0.05) - 5 * _bump(phase, 0.06, 0.04),
    }


def walking_fit(
    joint_names: tuple[str, ...],
    body_sha256: str,
    *,
    name: str = "walk",
    n_frames: int = 150,
    fps: float = 30.0,
    seen: tuple[int, int] | None = None,
    image_size_px: tuple[int, int] = (640, 360),
    focal_px: float = 600.0,
    start_m: tuple[float, float, float] = (6.0, -2.2, -0.2),
    speed_m_s: float = 1.2,
    walks: bool = True,
    marker_names: tuple[str, ...] = ("nose",),
) -> TrialFit:
    """A person who walks across the picture from right to left.

    `start_m` is the pelvis in the world at time 0; frames outside `seen` are NaN; `walks=False` stands still.
    """
    time = np.arange(n_frames) / fps
    first, last = (0, n_frames) if seen is None else seen
    qpos = np.zeros((n_frames, len(joint_names)))
    column = {n: i for i, n in enumerate(joint_names)}
    noise = np.random.default_rng(0)
    path = (time - time[min(first, n_frames - 1)]) * speed_m_s * walks
    qpos[:, column["pelvis_tx"]] = start_m[0]
    qpos[:, column["pelvis_tz"]] = -(start_m[1] + path)  # the pelvis' z points to the right of the person: world -y
    qpos[:, column["pelvis_ty"]] = start_m[2] - 0.975 + 0.02 * np.cos(4 * np.pi * time / CYCLE_S)
    qpos[:, column["pelvis_rotation"]] = np.pi / 2
    for side, shift in (("r", 0.0), ("l", 0.5)):
        phase = (time / CYCLE_S + shift) % 1.0 if walks else np.full(n_frames, 0.3)
        angles = joint_angles_deg(phase)
        tired = 1 - 0.12 * (side == "l")
        for joint, deg in angles.items():
            wobble = np.interp(time, time[::20], noise.normal(0, 1.2, len(time[::20]))) if walks else 0.0
            if joint == "knee_flexion":
                qpos[:, column[f"knee_angle_{side}"]] = -np.radians(deg * tired + wobble)
            else:
                qpos[:, column[f"{joint}_{side}"]] = np.radians(deg + wobble)
        arm = 22 * np.cos(2 * np.pi * (phase + 0.5))
        qpos[:, column[f"arm_flex_{side}"]] = np.radians(arm)
        qpos[:, column[f"elbow_flex_{side}"]] = np.radians(22)
    away = np.ones(n_frames, bool)
    away[first:last] = False
    qpos[away] = np.nan
    j = len(marker_names)
    return TrialFit(
        name=name,
        time_s=time,
        joint_names=tuple(joint_names),
        qpos=qpos,
        qpos_sd=np.full_like(qpos, np.nan),
        marker_set="blazepose_33",
        marker_names=marker_names,
        markers_world_m=np.full((n_frames, j, 3), np.nan),
        phone_quat_wxyz=np.tile(LEVEL_CAMERA_QUAT_WXYZ, (n_frames, 1)),
        scale=np.ones(8),
        site_offset_m=np.zeros((j, 3)),
        residual_2d_px=np.full((n_frames, j), 4.0),
        residual_3d_m=np.full((n_frames, j), 0.03),
        camera=Camera(
            np.array([[focal_px, 0, image_size_px[0] / 2], [0, focal_px, image_size_px[1] / 2], [0, 0, 1]], float),
            np.zeros(5),
            "guess: a test",
        ),
        image_size_px=image_size_px,
        camera_motion="static",
        camera_position_m=np.zeros(3),
        orientation_source="assumed: level",
        phone_clock_offset_s=float("nan"),
        solver="gauss-newton",
        params_hash="0123456789abcdef",
        body_sha256=body_sha256,
        loss=9.5,
        seconds=12.0,
    )


def foot_events(stop_s: float, start_s: float = 0.0) -> list[tuple[float, str, str]]:
    """The foot contacts (time_s, side, event) that belong to `walking_fit`."""
    rows = []
    for side, shift in (("right", 0.0), ("left", 0.5)):
        for n in range(-1, int(stop_s / CYCLE_S) + 2):
            down = (n - shift) * CYCLE_S
            rows += [(down, side, "foot_down"), (down + STANCE * CYCLE_S, side, "foot_up")]
    return sorted(r for r in rows if start_s <= r[0] <= stop_s)
