"""The walker as one phone sees it: keypoints with noise, and the camera's true orientation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import Camera

from .camera import PHONE_CAMERA, PHONE_SIZE_PX, HeldPhone, PhoneSensor, camera_turn, phone_log, picture_px
from .noise import Noise, disturb, exchanged
from .markers import _set, true_markers
from .scene import CAMERAS, stage


@dataclasses.dataclass(frozen=True)
class Seen:
    """Keypoints of a trial and what is true of it.

    R_nc (T, 3, 3): camera to world at each frame; clock_offset_s: the phone's clock against the video's, NaN without a
    log; markers_world_m (T, J, 3): the true points; outlier (T, J): which points were thrown far off; outside (T, J):
    which were missing because they are not in the picture; qpos (T, 40): the motion where the phone saw it.
    """

    keypoints: Keypoints
    R_nc: Float[np.ndarray, "T 3 3"]
    clock_offset_s: float
    markers_world_m: Float[np.ndarray, "T J 3"]
    outlier: np.ndarray
    outside: np.ndarray
    qpos: Float[np.ndarray, "T 40"]


def observe(
    qpos: Float[np.ndarray, "T 40"],
    time_s: Float[np.ndarray, " T"],
    *,
    view: str | None = None,
    distance_m: float | None = None,
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
    only_in_picture: bool = False,
    never_seen: Sequence[str] = (),
    unseen_s: Sequence[tuple[float, float]] = (),
) -> Seen:
    """Look at a walk with a phone at the world's origin.

    Parameters
    ----------
    qpos, time_s
        From `walk_qpos`, with the same camera height, or any motion (a recorded one, `validation.read_motions`) with a
        `view`.
    view
        One of `VIEWS_DEG`: the motion, wherever it was, is turned and moved so that the phone sees it from there, the
        phone about 1.2 m above the lowest point of its soles. None: the motion is where it is.
    distance_m
        With a view: from the phone to the middle of the way; None: 4.5 m. No motion comes nearer than 2.5 m.
    marker_set, scale, site_offset_m
        The detector's points and the person, as from `person`.
    noise
        Default: the benchmark's, `Noise()`.
    seed
        Of noise and hand. "static" and "handheld" with one seed have the same noise on the points (turned with the
        camera), the same outliers and the same missing points.
    camera_motion
        "static", "panned" (the phone turns to keep the walker in the picture) or "handheld" (with a hand's tremor).
    tilt_deg
        Of a static camera: up, then clockwise about its line of sight. A held phone looks at the pelvis.
    sensor, with_phone
        The phone's orientation log; None: with one where the phone is held.
    root_relative
        Points relative to the mean of the true ones, or with their true distance.
    only_in_picture
        Points outside of the picture are missing.
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
    if unknown or camera_motion not in CAMERAS:
        raise PblError(
            "FIT_INPUT",
            found=f"camera motion {camera_motion!r}, markers that are not in the set: {', '.join(unknown) or 'none'}",
            expected="'static', 'panned' or 'handheld', and names of the marker set",
            next_step="correct the call",
        )
    if view is not None:
        qpos = stage(qpos, scale, view, seed, distance_m)
    points_rng, phone_rng = np.random.default_rng([seed, 4]), np.random.default_rng([seed, 5])
    if camera_motion != "static":
        tremor = 1.0 if camera_motion == "handheld" else 0.0
        R_nc_at = HeldPhone(phone_rng, time_s, pelvis_positions(qpos), tremor=tremor).R_nc
    else:
        fixed = camera_turn(*np.radians([0.0, *tilt_deg]))[0]

        def R_nc_at(time_s: np.ndarray) -> np.ndarray:
            return np.tile(fixed, (len(time_s), 1, 1))

    log = with_phone if with_phone is not None else camera_motion != "static"
    seen = film(
        qpos,
        time_s,
        R_nc_at,
        markers=markers,
        scale=scale,
        site_offset_m=site_offset_m,
        noise=noise,
        rng=points_rng,
        camera=camera,
        image_size_px=image_size_px,
        sensor=sensor if log else None,
        sensor_rng=phone_rng,
        root_relative=root_relative,
        only_in_picture=only_in_picture,
    )
    hidden = np.isin(markers.names, list(never_seen)) | _within(time_s, unseen_s)[:, None]
    return dataclasses.replace(seen, keypoints=hide(seen.keypoints, hidden))


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
    """What a phone at the origin makes of a motion that is where it is: the one way from joint values to keypoints.

    `R_nc_at` maps times (P,) to the phone's orientation; `sensor` None: no log; `only_in_picture`: points outside of
    the picture are missing.
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
    """(T, J) which points are outside of the picture of a phone at the origin, or behind it."""
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
    """Keypoints of true points seen by a camera at `p_nc`, and which of them are outliers (T, J)."""
    x_cam = np.einsum("tba,tjb->tja", R_nc, x_world - p_nc)
    sides = leg_sides(markers)
    d = disturb(rng, noise, time_s, x_cam, sides, float(camera.matrix[0, 0]), max(image_size_px))
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
    if noise.exchanged_per_s:
        keypoints = _exchange(keypoints, exchanged(rng, noise, time_s), other_leg(markers))
    return hide(keypoints, d.dropped), d.outlier & ~d.dropped


#: Bodies of a leg, without their side.
_LEG_BODIES = ("femur", "tibia", "talus", "calcn", "toes")


def leg_sides(markers: MarkerSet) -> Float[np.ndarray, " J"]:
    """1 for points of the right leg, -1 for those of the left leg, 0 for all others."""
    sides = {f"{b}_{s}": sign for b in _LEG_BODIES for s, sign in (("r", 1.0), ("l", -1.0))}
    return np.array([sides.get(b, 0.0) for b in markers.body_names])


def other_leg(markers: MarkerSet) -> np.ndarray:
    """(J,) index of the same point of the other leg; a point's own index where it has none."""
    out, place = np.arange(len(markers)), markers.position_m * [1, 1, -1]
    for j, body in enumerate(markers.body_names):
        if body[:-2] in _LEG_BODIES:
            other = [k for k, b in enumerate(markers.body_names) if b == body[:-1] + ("l" if body[-1] == "r" else "r")]
            if other:
                out[j] = other[int(np.argmin(np.linalg.norm(markers.position_m[other] - place[j], axis=1)))]
    return out


def _exchange(keypoints: Keypoints, frames: np.ndarray, other: np.ndarray) -> Keypoints:
    at = np.where(frames[:, None], other, np.arange(len(other)))
    return dataclasses.replace(
        keypoints,
        xy_px=np.take_along_axis(keypoints.xy_px, at[..., None], axis=1),
        xyz_cam_m=np.take_along_axis(keypoints.xyz_cam_m, at[..., None], axis=1),
        confidence=np.take_along_axis(keypoints.confidence, at, axis=1),
    )


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
