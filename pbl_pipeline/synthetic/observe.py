"""Observation of the walker by one phone: keypoints with noise, and the camera's true orientation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import SCALE_NAMES, MarkerSet, body_frames, load_body, marker_set
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import Camera

from .camera import PhoneSensor, phone_log, picture_px
from .noise import Noise


def true_markers(
    qpos: Float[np.ndarray, "T 40"],
    markers: str | MarkerSet,
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
) -> Float[np.ndarray, "T J 3"]:
    """Markers in the world (m), in double precision by C MuJoCo, which the fit does not use."""
    body, markers = load_body(), as_marker_set(markers)
    scale = np.ones(len(SCALE_NAMES)) if scale is None else np.asarray(scale, np.float64)
    offset = 0.0 if site_offset_m is None else np.asarray(site_offset_m, np.float64)
    frames, at = body_frames(body, qpos, scale), markers.body_index
    local = scale[body.scale_index[at]][:, None] * (markers.position_m + offset)
    return frames.position_m[:, at] + np.einsum("tjab,jb->tja", frames.rotation[:, at], local)


def as_marker_set(markers: str | MarkerSet) -> MarkerSet:
    """Return the marker set of a name, or the one that is given."""
    return marker_set(markers) if isinstance(markers, str) else markers


@dataclasses.dataclass(frozen=True)
class Seen:
    """Keypoints of a trial and its truth."""

    keypoints: Keypoints
    R_nc: Float[np.ndarray, "T 3 3"]  # camera to world
    clock_offset_s: float  # of the phone's clock to the video's, NaN without a log
    markers_world_m: Float[np.ndarray, "T J 3"]  # the true points
    outlier: np.ndarray  # (T, J) bool
    outside: np.ndarray  # (T, J) bool: missing because they are not in the picture
    qpos: Float[np.ndarray, "T 40"]


def film(
    qpos: Float[np.ndarray, "T 40"],
    time_s: Float[np.ndarray, " T"],
    R_nc_at: Callable[[np.ndarray], Float[np.ndarray, "P 3 3"]],
    *,
    markers: MarkerSet,
    scale: Float[np.ndarray, " 8"] | None,
    site_offset_m: Float[np.ndarray, "J 3"] | None,
    noise: Noise,
    rng: np.random.Generator,
    camera: Camera,
    image_size_px: tuple[int, int],
    sensor: PhoneSensor | None,
    sensor_rng: np.random.Generator,
    root_relative: bool,
    only_in_picture: bool,
) -> Seen:
    """Make the keypoints of a motion that is seen by a phone at the world's origin.

    `R_nc_at` maps times (P,) to the phone's orientation; `sensor` None: no log; `only_in_picture`: points outside the
    picture are missing.
    """
    R_nc = R_nc_at(time_s)
    x_world = true_markers(qpos, markers, scale, site_offset_m)
    keypoints, outlier = seen_by(
        rng, noise, time_s, x_world, R_nc, np.zeros(3), markers, camera, image_size_px, root_relative
    )
    outside = np.zeros(outlier.shape, bool)
    if only_in_picture:
        outside = outside_picture(x_world, R_nc, camera, image_size_px)
        keypoints, outlier = hide(keypoints, outside), outlier & ~outside
    if sensor is not None:
        stamps, quat = phone_log(sensor_rng, sensor, R_nc_at, float(time_s[0]), float(time_s[-1]))
        keypoints = dataclasses.replace(keypoints, phone_time_s=stamps, phone_quat_wxyz=quat)
    clock = sensor.clock_offset_s if sensor is not None else float("nan")
    return Seen(keypoints, R_nc, clock, x_world, outlier, outside, qpos)


def outside_picture(
    x_world: Float[np.ndarray, "T J 3"], R_nc: Float[np.ndarray, "T 3 3"], camera: Camera, size_px: tuple[int, int]
) -> np.ndarray:
    """(T, J) bool: points outside the picture of a phone at the origin, or behind it."""
    x_cam = np.einsum("tba,tjb->tja", R_nc, x_world)
    behind = x_cam[..., 2] < 0.2
    px = picture_px(np.where(behind[..., None], [0.0, 0.0, 1.0], x_cam), camera)
    return behind | np.any((px < 0) | (px > np.array(size_px) - 1), axis=-1)


def seen_by(
    rng: np.random.Generator,
    noise: Noise,
    time_s: np.ndarray,
    x_world: Float[np.ndarray, "T J 3"],
    R_nc: Float[np.ndarray, "T 3 3"],
    p_nc: Float[np.ndarray, " 3"],
    markers: MarkerSet,
    camera: Camera,
    image_size_px: tuple[int, int],
    root_relative: bool,
) -> tuple[Keypoints, np.ndarray]:
    """Make the keypoints of true points seen by a camera at `p_nc`, and return the outliers (T, J)."""
    x_cam = np.einsum("tba,tjb->tja", R_nc, x_world - p_nc)
    d = noise.disturb(rng, time_s, x_cam, markers, float(camera.matrix[0, 0]), max(image_size_px))
    true_px = picture_px(x_cam, camera)
    root = x_cam.mean(axis=1, keepdims=True) if root_relative else 0.0
    low, high = true_px.min(axis=1), true_px.max(axis=1)
    keypoints = Keypoints(
        time_s=time_s,
        names=tuple(markers.names),
        marker_set=markers.name,
        xy_px=true_px + d.xy_px,
        xyz_cam_m=x_cam - root + d.xyz_m,
        root_relative=root_relative,
        confidence=d.confidence,
        image_size_px=image_size_px,
        camera=camera,
        box_px=np.concatenate([low, high], axis=1),
    )
    return hide(keypoints, d.dropped), d.outlier & ~d.dropped


def hide(keypoints: Keypoints, hidden: np.ndarray) -> Keypoints:
    """Remove the keypoints of `hidden` (T, J)."""
    gone = hidden[..., None]
    return dataclasses.replace(
        keypoints,
        xy_px=np.where(gone, np.nan, keypoints.xy_px),
        xyz_cam_m=np.where(gone, np.nan, keypoints.xyz_cam_m),
        confidence=np.where(hidden, 0.0, keypoints.confidence),
    )


def pelvis_positions(qpos: Float[np.ndarray, "T 40"]) -> Float[np.ndarray, "T 3"]:
    """Origin of the pelvis in the world (m)."""
    body = load_body()
    x, right, up = (qpos[:, body.joint_names.index(n)] for n in ("pelvis_tx", "pelvis_tz", "pelvis_ty"))
    return np.column_stack([x, -right, up]) + body.mj_model.body("pelvis").pos
