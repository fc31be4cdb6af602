"""A walking body with known joint angles, in the form of a fit: for drawing, export and report."""

import dataclasses

import numpy as np

from pbl_pipeline.body import load_body
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.synthetic import plain_walk
from pbl_pipeline.video import Camera

LEVEL_CAMERA_QUAT_WXYZ = np.array([0.5, -0.5, 0.5, -0.5])
CYCLE_S, STANCE = 1.1, 0.61


def walking_fit(
    joint_names: tuple[str, ...] | None = None,
    body_sha256: str | None = None,
    *,
    name: str = "walk",
    n_frames: int = 150,
    fps: float = 30.0,
    seen: tuple[int, int] | None = None,
    image_size_px: tuple[int, int] = (640, 360),
    start_m: tuple[float, float, float] = (6.0, -2.2, -0.2),
    speed_m_s: float = 1.2,
    walks: bool = True,
    marker_names: tuple[str, ...] = ("nose",),
) -> TrialFit:
    """A person who walks across the picture from right to left, in the installed body where no other is named.

    `start_m` is the pelvis in the world at time 0; frames outside `seen` are NaN; `walks=False` stands still.
    """
    time = np.arange(n_frames) / fps
    first, last = (0, n_frames) if seen is None else seen
    # Standing still: one moment of the stance.
    at_s = time if walks else np.full(n_frames, 0.3 * CYCLE_S)
    started = start_m[1] - speed_m_s * (time[min(first, n_frames - 1)] if walks else at_s[0])
    qpos = plain_walk(
        at_s,
        stride_s=CYCLE_S,
        speed_m_per_s=speed_m_s,
        start_m=(start_m[0], started),
        camera_height_m=0.95 - start_m[2],
    )
    away = np.ones(n_frames, bool)
    away[first:last] = False
    qpos[away] = np.nan
    j = len(marker_names)
    return TrialFit(
        name=name,
        time_s=time,
        joint_names=joint_names or load_body().joint_names,
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
            np.array([[600.0, 0, image_size_px[0] / 2], [0, 600.0, image_size_px[1] / 2], [0, 0, 1]]),
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
        body_sha256=body_sha256 or load_body().sha256,
        loss=9.5,
        seconds=12.0,
    )


def with_level_pelvis(fit: TrialFit) -> TrialFit:
    """The fit without tilt and obliquity of the pelvis, so that its rotation is a turn about the vertical alone."""
    qpos = fit.qpos.copy()
    qpos[:, [fit.joint_names.index(n) for n in ("pelvis_tilt", "pelvis_list")]] *= 0
    return dataclasses.replace(fit, qpos=qpos)


def foot_events(stop_s: float, start_s: float = 0.0) -> list[tuple[float, str, str]]:
    """The foot contacts (time_s, side, event) that belong to `walking_fit`."""
    rows = []
    for side, shift in (("right", 0.0), ("left", 0.5)):
        for n in range(-1, int(stop_s / CYCLE_S) + 2):
            down = (n - shift) * CYCLE_S
            rows += [(down, side, "foot_down"), (down + STANCE * CYCLE_S, side, "foot_up")]
    return sorted(r for r in rows if start_s <= r[0] <= stop_s)
