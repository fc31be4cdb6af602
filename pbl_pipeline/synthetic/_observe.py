"""The walker as one phone sees it: keypoints with noise, and the camera's true orientation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import Camera

from ._camera import PHONE_CAMERA, PHONE_SIZE_PX, HeldPhone, PhoneSensor, camera_turn, phone_log, picture_px
from ._noise import Noise, disturb
from ._person import _set, true_markers


@dataclasses.dataclass(frozen=True)
class Seen:
    """Keypoints of a trial and what is true of it.

    R_nc (T, 3, 3): camera to world at each frame; clock_offset_s: the phone's clock against the video's, NaN without a
    log; markers_world_m (T, J, 3): the true points; outlier (T, J): which points were thrown far off.
    """

    keypoints: Keypoints
    R_nc: Float[np.ndarray, "T 3 3"]
    clock_offset_s: float
    markers_world_m: Float[np.ndarray, "T J 3"]
    outlier: np.ndarray


def observe(
    qpos: Float[np.ndarray, "T 40"],
    time_s: Float[np.ndarray, " T"],
    *,
    marker_set: str | MarkerSet = "bml_movi_87",
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
    noise: Noise | None = None,
    seed: int = 0,
    camera_motion: str = "static",
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    camera: Camera = PHONE_CAMERA,
    image_size_px: tuple[int, int] = PHONE_SIZE_PX,
    sensor: PhoneSensor | None = None,
    with_phone: bool | None = None,
    root_relative: bool = True,
    never_seen: Sequence[str] = (),
    unseen_s: Sequence[tuple[float, float]] = (),
) -> Seen:
    """Look at a walk with a phone at the world's origin.

    Parameters
    ----------
    qpos, time_s
        From `walk_qpos`, with the same camera height.
    marker_set, scale, site_offset_m
        The detector's points and the person, as from `person`.
    noise
        Default: the benchmark's, `Noise()`.
    seed
        Of noise and hand. "static" and "handheld" with one seed have the same noise on the points (turned with the
        camera), the same outliers and the same missing points.
    camera_motion
        "static" or "handheld": the phone turns to keep the walker in the picture, with the tremor of a hand.
    tilt_deg
        Of a static camera: up, then clockwise about its line of sight. A held phone looks at the pelvis.
    sensor, with_phone
        The phone's orientation log; None: with one where the phone is held.
    root_relative
        Points relative to the mean of the true ones, or with their true distance.
    never_seen
        Names of markers that are missing in every frame.
    unseen_s
        Times (from, to) in which nothing is seen.

    Raises
    ------
    PblError
        FIT_INPUT: no such camera motion or marker.
    """
    markers, noise, sensor = _set(marker_set), noise or Noise(), sensor or PhoneSensor()
    time_s = np.asarray(time_s, np.float64)
    unknown = sorted(set(never_seen) - set(markers.names))
    if unknown or camera_motion not in ("static", "handheld"):
        raise PblError(
            "FIT_INPUT",
            found=f"camera motion {camera_motion!r}, markers that are not in the set: {', '.join(unknown) or 'none'}",
            expected="'static' or 'handheld', and names of the marker set",
            next_step="correct the call",
        )
    points_rng, phone_rng = np.random.default_rng([seed, 4]), np.random.default_rng([seed, 5])
    if camera_motion == "handheld":
        R_nc_at = HeldPhone(phone_rng, time_s, pelvis_positions(qpos)).R_nc
    else:
        fixed = camera_turn(*np.radians([0.0, *tilt_deg]))[0]

        def R_nc_at(time_s: np.ndarray) -> np.ndarray:
            return np.tile(fixed, (len(time_s), 1, 1))

    R_nc = R_nc_at(time_s)
    x_world = true_markers(qpos, markers, scale, site_offset_m)
    keypoints, outlier = seen_by(
        points_rng, noise, time_s, x_world, R_nc, np.zeros(3), markers, camera, image_size_px, root_relative
    )
    hidden = np.isin(markers.names, list(never_seen)) | _within(time_s, unseen_s)[:, None]
    keypoints = hide(keypoints, hidden)
    log = with_phone if with_phone is not None else camera_motion == "handheld"
    if log:
        phone_time, quat = phone_log(phone_rng, sensor, R_nc_at, float(time_s[0]), float(time_s[-1]))
        keypoints = dataclasses.replace(keypoints, phone_time_s=phone_time, phone_quat_wxyz=quat)
    return Seen(keypoints, R_nc, sensor.clock_offset_s if log else float("nan"), x_world, outlier)


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
    """Keypoints of true points seen by a camera at `p_nc`, and which of them are outliers (T, J)."""
    x_cam = np.einsum("tba,tjb->tja", R_nc, x_world - p_nc)
    d = disturb(rng, noise, time_s, x_cam)
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
    """The keypoints with those of `hidden` (T, J) missing."""
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


def _within(time_s: np.ndarray, spans_s: Sequence[tuple[float, float]]) -> np.ndarray:
    inside = np.zeros(len(time_s), bool)
    for start, stop in spans_s:
        inside |= (time_s >= start) & (time_s < stop)
    return inside
